"""What a database says of a camera beside its pixels: sensitivities, sensor, and the charts it saw."""

from __future__ import annotations

from math import isnan
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from levkas.building.charting import Developed
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.core.cube import Band
    from levkas.database.layout import Places
    from levkas.quality.targets.measuring import ChartMeasure

PICTURES = ("levels", "shape", "step", "size")
"""Of a light field: its map, which the camera's page shows."""


def write_sensitivity(folder: Path, campaign: Campaign, capture: Capture) -> list[Path]:
    """Write cameras/CAMERA/sensitivity.csv, where one is declared: wavelength in nm, a column a channel.

    Raises
    ------
    Refused
        Where the declared table cannot be read, or the disk refuses.
    """
    from levkas.building.channels import read_sensitivity
    from levkas.core.files import write_text

    declared = campaign.cameras[capture.camera].sensitivity
    if not declared:
        return []
    labels = [band.label for band in capture.bands]
    wavelengths, table = read_sensitivity(campaign.root / declared, labels)
    lines = [",".join(["wavelength", *labels])]
    for wavelength, row in zip(wavelengths, table, strict=True):
        lines.append(",".join(f"{number:.9g}" for number in (wavelength, *row)))
    path = folder / "sensitivity.csv"
    write_text(path, "\n".join(lines) + "\n")
    return [path]


def describe_camera(
    campaign: Campaign, capture: Capture, learnt: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """Return cameras/CAMERA/camera.json: bands, sensors, and what was learnt of them, by setup."""
    keys = campaign.cameras[capture.camera]
    return {
        "camera": capture.camera,
        "kind": keys.kind,
        "bits": keys.bits,
        "black": keys.black,
        "saturation": keys.saturation,
        "bands": _bands(capture.bands),
        "sensors": [
            {
                "name": s.name,
                "pattern": [list(row) for row in s.pattern] if s.pattern else None,
                "bands": [band.label for band in s.bands],
            }
            for s in capture.sensors
        ],
        "learnt": {setup or "": _without_pictures(told) for setup, told in learnt.items()},
    }


def write_chart(
    places: Places, campaign: Campaign, capture: Capture, made: Developed, measure: ChartMeasure
) -> list[Path]:
    """Write charts/CHART/: calibrated cubes in native pixels, one a sensor, and what was measured."""
    from levkas.building.channels import broad_centroids
    from levkas.core.files import write_json
    from levkas.database.credits import Credits
    from levkas.database.layers import Layer, write_tiffs

    chart, described = capture.object, campaign.campaign
    folder = places.output / "charts" / chart
    credits = Credits(
        title=f"{measure.chart.name}, {capture.layer}",
        creator=described.creator,
        date=made.captured or described.date or "",
        rights=described.licence,
    )
    centroids = broad_centroids(campaign, capture.camera, capture.bands)
    layer = Layer(chart, capture.camera, capture.setup, credits=credits, centroids=centroids)
    written = []
    for sensor, cube in made.cubes.items():
        stem = "_".join(part for part in (layer.stem, sensor) if part)
        written += write_tiffs(folder / stem, layer, cube)
    record = folder / f"{layer.stem}.json"
    write_json(record, {"chart": measure.chart.name, **measure.to_dict()})
    return [*written, record]


def _bands(bands: Sequence[Band]) -> list[dict[str, Any]]:
    return [
        {
            "label": b.label,
            "wavelength_nm": None if isnan(b.wavelength) else b.wavelength,
            "fwhm_nm": None if isnan(b.fwhm) else b.fwhm,
        }
        for b in bands
    ]


def _without_pictures(told: Mapping[str, Any]) -> dict[str, Any]:
    return {
        sensor: {
            **{k: v for k, v in facts.items() if k != "light"},
            "light": {
                band: {k: v for k, v in light.items() if k not in PICTURES}
                for band, light in facts.get("light", {}).items()
            },
        }
        for sensor, facts in told.items()
    }


def joined_sigma(one: np.ndarray | None, other: np.ndarray | None) -> np.ndarray | None:
    """Return sigma of the mean of two halves; None where it is not known of both."""
    if one is None or other is None:
        return None
    return np.sqrt(one.astype(np.float64) ** 2 + other.astype(np.float64) ** 2).astype(
        np.float32
    ) / np.float32(2)
