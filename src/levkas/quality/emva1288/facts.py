"""Facts of raw frames, from their headers and their codes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from levkas.calibration.code_spacing import MOST_CODES, Levels, count_codes, find_levels
from levkas.campaign.discovery.file_index import FolderListings, too_deep, walk_folders
from levkas.core.problems import Problem, Refused
from levkas.readers.frames import Facts, kind_of, read_facts, read_frame
from levkas.readers.tiff import read_tiff_pages

MOST_FRAMES = 400
SIDECARS = (".hdr",)


class NothingToDescribe(Refused):
    """A path without any frame."""


@dataclass(frozen=True)
class FrameFacts:
    """One frame.

    Parameters
    ----------
    file : str
    kind, size, dtype : str
    bits : int or None
        Declared in the file; else what the top code needs, of all frames of a folder.
    black, white : float or None
        Levels that the file declares, counts.
    pattern : str or None
    exposure_s, iso : float or None
    model, captured : str or None
    levels : Levels or None
        Of whole codes; None for real numbers.
    clipped, zeros : float or None
        Share of pixels at the white level (else at the full scale), and at 0.
    """

    file: str
    kind: str
    size: str
    dtype: str
    bits: int | None
    black: float | None
    white: float | None
    pattern: str | None
    exposure_s: float | None
    iso: float | None
    model: str | None
    captured: str | None
    levels: Levels | None
    clipped: float | None
    zeros: float | None

    @property
    def curve(self) -> str:
        """Description of the codes: spacing, or compression curve."""
        return describe_levels(self.levels, self.full) if self.levels else "real numbers"

    @property
    def full(self) -> float:
        """White level, else the full scale of the bits."""
        return float(self.white or 2 ** (self.bits or 16) - 1)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values; `levels` with the description of their curve."""
        found = {**asdict(self), "curve": self.curve}
        if self.levels is not None and not self.levels.curved:
            found["levels"]["knee"] = None
        return found


def describe_frame(path: str | Path) -> FrameFacts:
    """Read one file, all its pages, and describe it.

    Raises
    ------
    UnreadableCapture
    """
    return _facts(*_read(Path(path)))


Codes = tuple[np.ndarray, np.ndarray]
"""The codes of a frame, and how often each occurs."""


def _read(path: Path) -> tuple[Facts, Codes | None]:
    facts = read_facts(path)
    if facts.dtype not in ("uint8", "uint16"):
        read_frame(path)
        return facts, None
    histogram = count_codes(read_tiff_pages(path) if facts.pages > 1 else [read_frame(path)])
    codes = np.flatnonzero(histogram)
    return facts, (codes, histogram[codes])


def _whole(codes: Codes) -> np.ndarray:
    histogram = np.zeros(MOST_CODES, np.int64)
    histogram[codes[0]] = codes[1]
    return histogram


def _bits(facts: Facts, top: int) -> int:
    """Bits that the file declares, where that is more than how it is stored; else what `top` needs."""
    if facts.bits and facts.bits != 8 * np.dtype(facts.dtype).itemsize:
        return facts.bits
    return max(8, top.bit_length())


def _facts(facts: Facts, codes: Codes | None, top: int = 0) -> FrameFacts:
    """Describe a frame; `top` is the highest code of its whole folder."""
    levels, clipped, zeros, bits = None, None, None, facts.bits
    if codes is not None:
        values, counts = codes
        levels = find_levels(_whole(codes))
        bits = _bits(facts, max(top, levels.highest))
        full = facts.saturation or 2**bits - 1
        pixels = float(counts.sum())
        clipped = float(counts[values >= full].sum()) / pixels
        zeros = float(counts[values == 0].sum()) / pixels
    size = " x ".join(str(n) for n in (facts.shape[1], facts.shape[0], *facts.shape[2:]))
    return FrameFacts(
        str(facts.path),
        facts.kind,
        size + (f" x {facts.pages} pages" if facts.pages > 1 else ""),
        facts.dtype,
        bits,
        facts.black,
        facts.saturation,
        facts.pattern,
        facts.exposure_s,
        facts.iso,
        facts.model,
        facts.captured,
        levels,
        clipped,
        zeros,
    )


def describe_levels(levels: Levels, full: float) -> str:
    """Describe how many codes there are, and on which curve they lie.

    >>> describe_levels(Levels(683, 0, 4095, 1.0, 215.0, 0.01565), 4095)
    '683 codes found of 683 on a compression curve: 1 apart up to 215, 15.6 apart at 4095'
    >>> describe_levels(Levels(256, 0, 4095, 16.0), 4095)
    '256 codes found, 16 apart: 256 of the 4096 there could be'
    """
    possible = levels.between(0, full)
    if levels.curved:
        return (
            f"{levels.count} codes found of {max(possible, levels.count)} on a compression curve: "
            f"{levels.spacing:g} apart up to {levels.knee:.0f}, {float(levels.step(full)):.1f} apart "
            f"at {full:.0f}"
        )
    if levels.spacing > 1:
        return f"{levels.count} codes found, {levels.spacing:g} apart: {possible} of the {full + 1:.0f} there could be"
    return f"{levels.count} codes found of {full + 1:.0f}"


def describe_files(path: str | Path) -> tuple[list[FrameFacts], Levels | None, list[Problem]]:
    """Describe a frame, or every frame of a folder and those below it.

    Returns
    -------
    frames : list of FrameFacts
        By name; at most 400 of a folder.
    levels : Levels or None
        Of all together, where they are of one dtype: single frames fill few of the codes.
    problems : list of Problem
        Frames that cannot be read, and how many were left out.

    Raises
    ------
    NothingToDescribe
        E_NO_FRAMES where there is no frame.
    """
    path = Path(path)
    files = frames_below(path) if path.is_dir() else [path]
    read: list[tuple[Facts, Codes | None]] = []
    problems: list[Problem] = []
    for file in files[:MOST_FRAMES]:
        try:
            read.append(_read(file))
        except Refused as refused:
            problems += refused.problems
    if not files:
        raise NothingToDescribe(
            Problem(
                "E_NO_FRAMES",
                "no frame is here",
                file=str(path),
                expected="a campaign, a frame, or a folder of frames (TIFF, PNG, camera raw, ENVI)",
                fix="Name the folder that holds the frames.",
            )
        )
    if len(files) > MOST_FRAMES:
        left = len(files) - MOST_FRAMES
        problems.append(
            Problem(
                "E_TOO_MANY", f"{left} frames were not looked at", file=str(path), found=len(files)
            )
        )
    counted = [codes for _, codes in read if codes is not None]
    one_kind = len({(facts.dtype, facts.model) for facts, _ in read}) == 1
    if not counted or not one_kind:
        return [_facts(*each) for each in read], None, problems
    top = int(max(values[-1] for values, _ in counted))
    total = np.zeros(MOST_CODES, np.int64)
    for values, counts in counted:
        total[values] += counts
    return [_facts(*each, top) for each in read], find_levels(total), problems


def frames_below(folder: Path) -> list[Path]:
    """Return the files below a folder that are frames by name and first bytes."""
    found = []
    for above, names in walk_folders(folder, FolderListings()):
        if names is None:
            raise too_deep(folder.joinpath(*above))
        for file in (folder.joinpath(*above, name) for name in names):
            if file.suffix.lower() in SIDECARS:
                continue
            try:
                kind_of(file)
            except Refused:
                continue
            found.append(file)
    return sorted(found)


def facts_table(frames: Sequence[FrameFacts], root: Path) -> str:
    """Return a table of frames for people, a line each."""
    head = (
        "file",
        "size",
        "bits",
        "black",
        "white",
        "pattern",
        "codes",
        "clipped",
        "zeros",
        "time",
        "ISO",
    )
    rows = [head, *(_row(frame, root) for frame in frames)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    return "\n".join(
        "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def _row(frame: FrameFacts, root: Path) -> tuple[str, ...]:
    def text(value: float | None, form: str = "g") -> str:
        return "–" if value is None else format(value, form)

    file = Path(frame.file)
    return (
        str(file.relative_to(root)) if root in file.parents else file.name,
        frame.size,
        text(frame.bits),
        text(frame.black),
        text(frame.white),
        frame.pattern or "–",
        text(frame.levels.count if frame.levels else None),
        "–" if frame.clipped is None else f"{100 * frame.clipped:.2f} %",
        "–" if frame.zeros is None else f"{100 * frame.zeros:.1f} %",
        "–" if frame.exposure_s is None else f"{frame.exposure_s:g} s",
        text(frame.iso),
    )
