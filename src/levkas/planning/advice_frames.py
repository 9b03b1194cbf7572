"""Frames for exposure advice: put together by wavelength and exposure, as their names and headers say."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from math import nan
from pathlib import Path

from levkas.calibration.templates import Template, average
from levkas.readers.frames import Facts, read_facts, read_frame


@dataclass(frozen=True)
class Shot:
    """Frames of one band at one exposure."""

    name: str
    wavelength: float
    exposure_s: float | None
    iso: float | None
    stack: Template


def gather_shots(files: Sequence[Path], full: float, exposure_s: float | None) -> list[Shot]:
    """Put frames of one wavelength, exposure and size together."""
    groups: dict[tuple[str, float, float | None, tuple[int, ...]], list[Path]] = {}
    told: dict[Path, Facts] = {}
    for file in files:
        facts = told[file] = read_facts(file)
        wavelength, time = _from_name(file.name)
        name = f"{wavelength:g} nm" if wavelength == wavelength else file.parent.name
        key = (name, wavelength, exposure_s or time or facts.exposure_s, facts.shape)
        found = next((k for k in groups if k[0] == key[0] and k[2:] == key[2:]), key)
        groups.setdefault(found, []).append(file)
    return [
        Shot(
            name,
            wavelength,
            time,
            told[members[0]].iso,
            average((read_frame(m) for m in members), saturation=full, exposure_s=time),
        )
        for (name, wavelength, time, _), members in groups.items()
    ]


def _from_name(name: str) -> tuple[float, float | None]:
    """Return wavelength in nm and exposure in s, as a file's name has them.

    >>> _from_name("d1_disks_550nm_25ms_0004.tif"), _from_name("white.tif")
    ((550.0, 0.025), (nan, None))
    """
    wavelength = re.search(r"(?<![\d.])(\d{3,4}(?:\.\d+)?) ?nm(?![a-z])", name, re.IGNORECASE)
    time = re.search(r"(?<![\d.])(\d+(?:\.\d+)?) ?(us|µs|ms|s)(?![a-z])", name, re.IGNORECASE)
    unit = {"us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0}
    seconds = float(time[1]) * unit[time[2].lower()] if time else None
    return (float(wavelength[1]) if wavelength else nan), seconds


def files_at(path: Path) -> list[Path]:
    """Return a file, or the frames of a folder."""
    if not path.is_dir():
        return [path]
    from levkas.quality.emva1288.facts import frames_below

    return frames_below(path)
