"""Full scale of a sensor: as given, as the file declares it, or as its campaign does."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from levkas.calibration.patterns import channel_table
from levkas.calibration.templates import CalibrationRefused, Template, average, close_gaps
from levkas.core.problems import Problem, Refused
from levkas.readers.frames import Facts, read_frame

if TYPE_CHECKING:
    from levkas.campaign.campaign import Camera


def files_of(paths: Iterable[str | Path]) -> list[Path]:
    """Return files, and the frames of folders; raises Refused for a folder without any."""
    from levkas.quality.emva1288.facts import frames_below

    found: list[Path] = []
    for path in map(Path, paths):
        frames = frames_below(path) if path.is_dir() else [path]
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


def stack_of(
    files: Sequence[Path], *, saturation: float | None = None, exposure_s: float | None = None
) -> Template:
    """Average frames as `average` does; what is no finite number counts as the median of the others.

    Raises
    ------
    Refused
        UnreadableCapture; ``E_VALUE`` where there is no finite number at all.
    """
    frames = (read_frame(file) for file in files)
    try:
        return close_gaps(average(frames, saturation=saturation, exposure_s=exposure_s))
    except CalibrationRefused as refused:
        problems = (replace(p, file=p.file or str(files[0])) for p in refused.problems)
        raise CalibrationRefused(*problems) from None


@dataclass(frozen=True)
class FullScale:
    """Counts at which a sensel is full, where that is known from, and black where a campaign has it."""

    counts: float
    source: str
    bits: int | None = None
    black: float | None = None


def find_full_scale(
    files: Sequence[Path],
    facts: Facts,
    *,
    bits: int | None = None,
    saturation: float | None = None,
) -> FullScale | None:
    """Return the full scale of some frames of one camera; None where it is not known.

    Parameters
    ----------
    files : sequence of Path
    facts : Facts
        Of the first.
    bits : int, optional
        Of the converter, as given; `saturation` goes before it.
    saturation : float, optional
        Counts, as given.

    Notes
    -----
    In this order: given, `saturation` of the campaign that the first frame belongs to, white level of the file,
    `bits` of the campaign, bits of a sample where they are the converter's: fewer than are stored, 8 of 8, or 16
    of 16 that are all in use. The brightest pixel does not show it: a camera of 12 bits fills a
    quarter of its range with codes of 10.
    """
    if saturation:
        return FullScale(float(saturation), "as given")
    if bits:
        return FullScale(2.0**bits - 1, f"{bits} bits as given", bits)
    camera, campaign = _declared(files[0])
    black = camera.black if camera else None
    if camera is not None and camera.saturation:
        return FullScale(float(camera.saturation), f"saturation in {campaign}", None, black)
    if facts.saturation:
        return FullScale(float(facts.saturation), "white level in the file", None, black)
    if camera is not None and camera.bits:
        source = f"{camera.bits} bits in {campaign}"
        return FullScale(2.0**camera.bits - 1, source, camera.bits, black)
    stored = 8 * np.dtype(facts.dtype).itemsize
    if np.dtype(facts.dtype).kind != "u" or not facts.bits:
        return None
    if facts.bits < stored or stored == 8:
        return FullScale(2.0**facts.bits - 1, f"{facts.bits} bits in the file", facts.bits, black)
    if stored == 16 and any(int(read_frame(f).max(initial=0)) >= 1 << 15 for f in files):
        return FullScale(65535.0, "16 bits in the file, all in use", 16, black)
    return None


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


Rows = tuple[tuple[str, ...], ...]


def split_sensors(files: Sequence[Path]) -> dict[str, tuple[list[Path], Rows | None]]:
    """Return files by the sensor that their campaign declares, with the names of its channels as rows of a mosaic.

    One group without a name where no campaign above the first file has several sensors for them.
    """
    found = _frames_of_campaign(files[0])
    groups: dict[str, tuple[list[Path], Rows | None]] = {}
    for file in files:
        camera, sensor = found.get(_absolute(file), (None, ""))
        keys = next((s for s in camera.sensors if s.name == sensor), None) if camera else None
        if keys is None or camera is None:
            return {"": (list(files), None)}
        names = tuple(keys.bands or (sensor,))
        table = channel_table(keys.pattern) if keys.pattern else np.zeros((1, 1), int)
        rows = tuple(tuple(names[i] for i in row) for row in table.tolist())
        groups.setdefault(sensor, ([], rows))[0].append(file)
    return groups


def _absolute(path: Path) -> Path:
    """Return a path from the root; a frame that is a link belongs to the campaign in which the link lies."""
    return Path(os.path.abspath(path))  # noqa: PTH100 - `resolve` follows the link


def _frames_of_campaign(file: Path) -> dict[Path, tuple[Camera, str]]:
    """Return camera and sensor of every frame of the campaign above a file; nothing without one."""
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
        _absolute(f.path): (campaign.cameras[camera], f.sensor)
        for (camera, _), found in frames.items()
        for f in found
    }


def _declared(file: Path) -> tuple[Camera | None, Path | None]:
    """Return the camera of the campaign above a file that has it among its frames, and campaign.toml."""
    from levkas.campaign.campaign import load_campaign
    from levkas.campaign.discovery.file_index import scan_folders

    file = _absolute(file)
    above = next((p for p in file.parents if (p / "campaign.toml").is_file()), None)
    if above is None:
        return None, None
    try:
        campaign = load_campaign(above)
        frames = scan_folders(campaign).frames
    except Refused:
        return None, None
    for (camera, _), found in frames.items():
        if any(_absolute(f.path) == file for f in found):
            return campaign.cameras[camera], campaign.path
    return None, None
