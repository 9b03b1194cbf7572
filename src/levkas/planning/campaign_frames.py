"""Frames that are given to plans: the campaign that they belong to, their sensors, their full scale."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from levkas.calibration.codes import FullScale, SceneShots, find_full_scale, stated_full_scale
from levkas.calibration.patterns import channel_table, thin_periods
from levkas.calibration.templates import CalibrationRefused, Template, average, close_gaps
from levkas.campaign.discovery.file_index import FolderListings, too_deep, walk_folders
from levkas.core.problems import Problem, Refused
from levkas.readers.facts import Facts
from levkas.readers.frames import kind_of, read_frame

if TYPE_CHECKING:
    from levkas.campaign.campaign import Camera


PERIOD, ROWS, SAMPLED = 60, 20, 1 << 18
"""Columns, a multiple of every mosaic's, as the pattern may not be known; rows that are taken together, and values of a frame."""


def files_of(paths: Iterable[str | Path]) -> list[Path]:
    """Return files, and the frames of folders; raises Refused for a folder without any."""
    found: list[Path] = []
    for path in map(Path, paths):
        frames = _frames_below(path) if path.is_dir() else [path]
        if not frames:
            expected = "one frame or more"
            raise Refused(
                Problem(
                    "E_NO_FRAMES",
                    "there is no frame in this folder",
                    str(path),
                    None,
                    "none",
                    expected,
                )
            )
        found += frames
    return found


def _frames_below(folder: Path) -> list[Path]:
    """Return the files below a folder that are frames by name and first bytes."""
    found = []
    for above, names in walk_folders(folder, FolderListings()):
        if names is None:
            raise too_deep(folder.joinpath(*above))
        for file in (folder.joinpath(*above, name) for name in names):
            if file.suffix.lower() != ".hdr":
                with suppress(Refused):
                    kind_of(file)
                    found.append(file)
    return sorted(found)


def stack_of(
    files: Sequence[Path], *, saturation: float | None = None, exposure_s: float | None = None
) -> Template:
    """Average frames as `average` does; what is no finite number counts as the median of the others."""
    frames = (read_frame(file) for file in files)
    try:
        return close_gaps(average(frames, saturation=saturation, exposure_s=exposure_s))
    except CalibrationRefused as refused:
        problems = (replace(p, file=p.file or str(files[0])) for p in refused.problems)
        raise CalibrationRefused(*problems) from None


class Scale(NamedTuple):
    """Full scale of some frames, and black where a campaign declares it, counts."""

    full: FullScale
    black: float | None = None


def scale_of(
    files: Sequence[Path],
    facts: Facts,
    *,
    bits: int | None = None,
    saturation: float | None = None,
    white: bool = False,
) -> Scale | None:
    """Return the full scale of some frames of one camera; None where it is not known.

    Parameters
    ----------
    facts : Facts
        Of the first.
    bits : int, optional
        Of the converter, as given; `saturation` goes before it.
    saturation : float, optional
        Counts, as given.
    white : bool
        Whether the frames show an even surface.

    Notes
    -----
    What is given, else what the campaign of the first frame and the file state; where the codes pile up below that, they are full
    there, unless `saturation` is given. Of 16 bits of a sample some frame must use the highest: the brightest pixel alone
    shows no full scale, for a camera of 12 bits fills a quarter of its range with codes of 10.
    """
    camera, _, campaign = _frames_of_campaign(files[0]).get(_absolute(files[0]), (None, "", None))
    black = camera.black if camera else None
    if saturation:
        return Scale(FullScale(float(saturation), "as given"))
    if bits:
        stated: FullScale | None = FullScale(2.0**bits - 1, f"{bits} bits as given", bits)
        black = None
    else:
        own = (camera.saturation, camera.bits) if camera else (None, None)
        stated = stated_full_scale(facts, saturation=own[0], bits=own[1], where=campaign)
    top, shots = 0, []
    for values in map(read_frame, files):
        top = max(top, int(values.max(initial=0)))
        shots.append(thin_periods(values, ROWS, SAMPLED))
    found = find_full_scale([SceneShots([shot], white) for shot in shots], period=PERIOD)
    if found and (stated is None or found.counts < stated.counts):
        return Scale(found, black)
    if stated is not None and stated.source == "16 bits in the file":
        if top < 1 << 15:
            return None
        stated = stated._replace(source="16 bits in the file, all in use")
    return None if stated is None else Scale(stated, black)


def not_known(file: Path, facts: Facts) -> Problem:
    """Return the problem of a full scale that is not known."""
    return Problem(
        "E_BITS",
        "the full scale of the camera is unknown",
        str(file),
        "white level",
        f"{facts.dtype} without a white level, not all bits in use",
        "the bits of the camera's converter, or the code at which it saturates",
        "Give --bits 12 (10, 14, ...) or --saturation 4095, or `bits` of the camera in campaign.toml.",
    )


Pattern = str | Sequence[Sequence[str]]


def split_sensors(files: Sequence[Path]) -> dict[str, tuple[list[Path], Pattern | None]]:
    """Return files by the sensor that their campaign declares, with the mosaic of its channels; of one camera without sensors its own.

    One group without a name where no campaign above the first file has several sensors for them.
    """
    found = _frames_of_campaign(files[0])
    groups: dict[str, tuple[list[Path], Pattern | None]] = {}
    for file in files:
        camera, sensor, _ = found.get(_absolute(file), (None, "", None))
        keys = next((s for s in camera.sensors if s.name == sensor), None) if camera else None
        if keys is None or camera is None:
            return {"": (list(files), camera.pattern if camera else None)}
        names = tuple(keys.bands or (sensor,))
        table = channel_table(keys.pattern) if keys.pattern else np.zeros((1, 1), int)
        rows = tuple(tuple(names[i] for i in row) for row in table.tolist())
        groups.setdefault(sensor, ([], rows))[0].append(file)
    return groups


def _absolute(path: Path) -> Path:
    """Return a path from the root; a frame that is a link belongs to the campaign in which the link lies."""
    return Path(os.path.abspath(path))  # noqa: PTH100 - `resolve` follows the link


def _frames_of_campaign(file: Path) -> dict[Path, tuple[Camera, str, Path]]:
    """Return camera, sensor and campaign.toml of every frame of the campaign above a file; nothing without one."""
    from levkas.campaign.campaign import load_campaign
    from levkas.campaign.discovery.file_index import scan_folders

    above = next((p for p in _absolute(file).parents if (p / "campaign.toml").is_file()), None)
    if above is None:
        return {}
    try:
        campaign = load_campaign(above)
        frames = scan_folders(campaign).frames
    except Refused:
        return {}
    return {
        _absolute(f.path): (campaign.cameras[camera], f.sensor, campaign.path)
        for (camera, _), found in frames.items()
        for f in found
    }
