"""Which bands a file holds: a mosaic's channels, a cube's or a photograph's, by header and as declared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.campaign.discovery.captures import CaptureRefused, Rows
from levkas.core.cube import Band, band_labels
from levkas.core.problems import Problem

if TYPE_CHECKING:
    from levkas.campaign.campaign import Camera
    from levkas.campaign.schema.tables import Sensor
    from levkas.readers.frames import Facts

NEAREST_NM = 0.5
"""Declared wavelengths may differ from a header's by this, or by half a step where that is more."""


def bands_of_mosaic(
    camera: Camera, pattern: Rows | None, names: Sequence[str] | None, facts: Facts | None
) -> tuple[Rows, tuple[Band, ...]]:
    """Channels of a mosaic, and its pattern with their names in place of letters.

    Names are those of red, green, blue in this order where the pattern has these letters, else of
    the channels in the order in which the pattern first shows them.
    """
    letters = facts.pattern if facts and pattern is None else None
    if letters:
        pattern = (tuple(letters[:2]), tuple(letters[2:4]))
    if pattern is None:
        raise CaptureRefused(
            Problem(
                "E_VALUE",
                f"{camera.name}: neither campaign.toml nor the file says its mosaic",
                str(facts.path) if facts else None,
                f"cameras.{camera.name}.pattern",
                expected='such as pattern = "RGGB"',
                fix="Declare `pattern`.",
            )
        )
    channels = list(dict.fromkeys(name for row in pattern for name in row))
    if set(channels) == set("RGB"):
        channels = list("RGB")
    if names and set(names) == set(channels):
        channels = list(names)
    elif names:
        if len(names) != len(channels):
            where = str(facts.path) if facts else ""
            raise CaptureRefused(
                count_problem(camera, "bands", len(names), len(channels), "channels", where)
            )
        named = dict(zip(channels, names, strict=True))
        pattern = tuple(tuple(named[name] for name in row) for row in pattern)
        channels = list(names)
    return pattern, tuple(Band(name) for name in channels)


def bands_in_file(
    camera: Camera, sensor: Sensor | None, facts: Facts, *, pages: bool = False
) -> tuple[Band, ...]:
    """Bands of a file that holds them all: a cube, a photograph, a sensor without a mosaic.

    Declared names and wavelengths go before the header's; counts must agree.

    Parameters
    ----------
    pages : bool
        Whether bands are pages of a TIFF, not samples of a pixel.
    """
    samples = facts.shape[2] if len(facts.shape) == 3 else 1
    pages = pages or (camera.kind == "cube" and samples == 1 and facts.kind != "envi")
    count = facts.pages if pages else samples
    where, unit = str(facts.path), "pages" if pages else "bands"
    if camera.kind == "image" and count not in (1, 3):
        raise CaptureRefused(
            Problem(
                "E_BAND_COUNT",
                f"{camera.name}: an image has 1 or 3 channels",
                where,
                f"cameras.{camera.name}.kind",
                count,
                "1 or 3",
                'Write kind = "cube".',
            )
        )
    names = (sensor.bands if sensor else ()) or camera.bands
    centres = camera.centres if sensor is None else None
    for field, declared in (("wavelengths", centres), ("bands", names)):
        if declared and len(declared) != count:
            raise CaptureRefused(count_problem(camera, field, len(declared), count, unit, where))
    header = facts.wavelengths if facts.wavelengths and len(facts.wavelengths) == count else None
    if centres and header:
        _check_near(camera, centres, header, where)
    centres = centres or header
    widths = facts.fwhm if facts.fwhm and len(facts.fwhm) == count else (nan,) * count
    named = names or _default_names(camera, sensor, facts, count, centres)
    return tuple(
        Band(n, w, f) for n, w, f in zip(named, centres or (nan,) * count, widths, strict=True)
    )


def _default_names(
    camera: Camera,
    sensor: Sensor | None,
    facts: Facts,
    count: int,
    centres: Sequence[float] | None,
) -> Sequence[str]:
    if camera.kind == "image":
        return ("R", "G", "B") if count == 3 else ("grey",)
    told = facts.band_names if facts.band_names and len(facts.band_names) == count else None
    if sensor is not None and count == 1:
        return told or (sensor.name,)
    if centres:
        return band_labels(centres)
    if told and len(set(told)) == count:
        return told
    return [f"band {i + 1}" for i in range(count)]


def _check_near(
    camera: Camera, declared: Sequence[float], header: Sequence[float], path: str
) -> None:
    steps = sorted(abs(b - a) for a, b in pairwise(header))
    allowed = max(NEAREST_NM, steps[len(steps) // 2] / 2 if steps else 0.0)
    for ours, theirs in zip(declared, header, strict=True):
        if abs(ours - theirs) > allowed:
            raise CaptureRefused(
                Problem(
                    "E_VALUE",
                    f"{camera.name}: `wavelengths` are not those of the header",
                    path,
                    f"cameras.{camera.name}.wavelengths",
                    f"{theirs:g} nm in the header",
                    f"{ours:g} nm",
                    "Mend `wavelengths`, or take it out: the header has them.",
                )
            )


def relabel(camera: Camera, bands: Sequence[Band], path: Path) -> tuple[Band, ...]:
    """Give channels of a mosaic, or of several sensors, the centres that are declared for them."""
    centres = camera.centres
    if centres is None:
        return tuple(bands)
    if len(centres) != len(bands):
        raise CaptureRefused(
            count_problem(camera, "wavelengths", len(centres), len(bands), "channels", str(path))
        )
    return tuple(replace(b, wavelength=w) for b, w in zip(bands, centres, strict=True))


def described(declared: Sequence[float | str]) -> str:
    """Say what was declared.

    >>> described([400.0, 410.0, 420.0])
    '400–420 nm by 10 nm is 3 bands'
    """
    count = len(declared)
    if count > 2 and all(isinstance(k, float) for k in declared):
        centres = [float(k) for k in declared]
        step = centres[1] - centres[0]
        if all(abs(b - a - step) < 1e-6 for a, b in pairwise(centres)):
            return f"{centres[0]:g}–{centres[-1]:g} nm by {step:g} nm is {count} bands"
    return f"{count} bands are declared"


def count_problem(
    camera: Camera, field: str, declared: int, found: int, what: str, path: str
) -> Problem:
    """Return the problem of bands whose number does not fit `field`."""
    told = described(camera.centres) if field == "wavelengths" and camera.centres else ""
    return Problem(
        "E_BAND_COUNT",
        f"{camera.name}: {told or f'{declared} {field} are declared'}, there are {found} {what}",
        path or None,
        f"cameras.{camera.name}.{field}",
        found,
        declared,
        f"Mend `{field}` in campaign.toml, or give the whole file.",
    )
