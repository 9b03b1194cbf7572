"""Colour charts of a database as training samples: the means of their patches."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from levkas.core.problems import Problem
from levkas.core.text import read_json
from levkas.database.containment import check_inside
from levkas.database.layout import LayerId
from levkas.estimation.samples import EstimationRefused, PaintSamples


def charts_of(database: Path, sources: Sequence[str], target: str) -> list[str]:
    """Return the names of charts that all of these cameras measured."""
    folder = database / "charts"
    if not folder.is_dir():
        return []
    names = sorted(path.name for path in folder.iterdir() if path.is_dir())
    return [n for n in names if all(_record(database, n, s).is_file() for s in (*sources, target))]


def read_chart(database: Path, name: str, sources: Sequence[str], target: str) -> PaintSamples:
    """Read the patches of a chart that no camera saw saturated.

    Sigma is that of a patch's mean: its noise over the root of its pixels.

    Raises
    ------
    EstimationRefused
        Where the records of the chart cannot be used together.
    """
    spectra, spectrum_sigma, good = _patches(database, name, target)
    responses, response_sigma = [], []
    for source in sources:
        mean, sigma, visible = _patches(database, name, source)
        if len(mean) != len(spectra):
            raise _unusable(_record(database, name, source), "another number of patches")
        good = good & visible
        responses.append(mean)
        response_sigma.append(sigma)
    numbers = np.arange(len(spectra))
    samples = PaintSamples(
        np.concatenate(responses, 1), spectra, np.concatenate(response_sigma, 1), spectrum_sigma,
        np.zeros(len(spectra), bool), numbers, numbers * 0,
    )  # fmt: skip
    return samples.take(good)


def _record(database: Path, name: str, layer: str) -> Path:
    return database / "charts" / name / f"{LayerId.parse(name, layer).stem}.json"


def _patches(database: Path, name: str, layer: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return means and their sigma, (patches, bands), and which patches are whole."""
    path = _record(database, name, layer)
    check_inside(database, path)
    try:
        patches = read_json(path)["patches"]
        mean, noise, saturated = (
            np.array([patch[key] for patch in patches], float)
            for key in ("mean", "noise", "saturated")
        )
        pixels = np.array([patch["pixels"] for patch in patches], float)
    except (KeyError, TypeError, ValueError) as error:
        raise _unusable(path, f"{type(error).__name__}: {error}") from None
    good = np.isfinite(mean).all(1) & (np.nan_to_num(saturated) == 0).all(1) & (pixels > 0)
    sigma = np.nan_to_num(noise) / np.sqrt(np.maximum(pixels, 1))[:, None]
    return mean, sigma, good


def _unusable(path: Path, found: str) -> EstimationRefused:
    return EstimationRefused(
        Problem(
            "E_VALUE",
            "the record of a chart is not as a build writes it",
            str(path),
            found=found,
            expected="patches with mean, noise, saturated and pixels",
            fix="Build the database again.",
        )
    )
