"""Facts of a raw frame, from its header and its codes."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from levkas.calibration.codes import count_codes
from levkas.quality.emva1288.levels import Levels, find_levels
from levkas.readers.frames import read_facts, read_frame
from levkas.readers.tiff import read_tiff_pages


@dataclass(frozen=True)
class FrameFacts:
    """One frame."""

    file: str
    size: str
    dtype: str
    bits: int | None = None
    black: float | None = None
    white: float | None = None
    pattern: str | None = None
    exposure_s: float | None = None
    iso: float | None = None
    levels: Levels | None = None

    @property
    def full(self) -> float:
        """White level, else the full scale of the bits."""
        return float(self.white or 2 ** (self.bits or 16) - 1)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        found = asdict(self)
        if self.levels is not None and not self.levels.curved:
            found["levels"]["knee"] = None
        return found


def describe_frame(path: str | Path) -> FrameFacts:
    """Read one file, all its pages, and describe it."""
    facts = read_facts(Path(path))
    levels, bits = None, facts.bits
    if facts.dtype in ("uint8", "uint16"):
        pages = read_tiff_pages(Path(path)) if facts.pages > 1 else [read_frame(Path(path))]
        levels = find_levels(count_codes(pages))
        # Bits that the file declares, where that is no more than how it is stored, say nothing.
        if not bits or bits == 8 * np.dtype(facts.dtype).itemsize:
            bits = max(8, levels.highest.bit_length())
    size = " x ".join(str(n) for n in (facts.shape[1], facts.shape[0], *facts.shape[2:]))
    return FrameFacts(
        str(facts.path),
        size + (f" x {facts.pages} pages" if facts.pages > 1 else ""),
        facts.dtype,
        bits,
        facts.black,
        facts.saturation,
        facts.pattern,
        facts.exposure_s,
        facts.iso,
        levels,
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
