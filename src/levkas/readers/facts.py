"""What a file says of itself before a pixel is decoded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from levkas.problems import Problem, Refused

MOST_PIXELS = 2_000_000_000
"""Samples of one page; a file that declares more is damaged or not an image."""
LONGEST_SIDE = 500_000


class UnreadableCapture(Refused):
    """A file that is not what it should be; nothing of it was used."""


@dataclass(frozen=True)
class Facts:
    """Declared by a capture's headers; None where it does not say.

    Parameters
    ----------
    path : Path
    kind : str
        ``"tiff"``, ``"png"``, ``"jpeg"``, ``"raw"`` or ``"envi"``.
    shape : tuple of int
        (h, w) or (h, w, samples); for ENVI (lines, samples, bands).
    dtype : str
    pages : int
    bits : int or None
        Significant bits of a sample.
    black, saturation : float or None, counts
    blacks : tuple of float or None
        Black of each phase of the pattern, row by row, where they differ.
    pattern : str or None
        Bayer letters row by row: ``"RGGB"``.
    exposure_s, iso : float or None
    captured : str or None
        ISO 8601.
    model : str or None
    wavelengths, fwhm : tuple of float or None, nm
    band_names : tuple of str or None
    interleave : str or None
    """

    path: Path
    kind: str
    shape: tuple[int, ...]
    dtype: str
    pages: int = 1
    bits: int | None = None
    black: float | None = None
    saturation: float | None = None
    blacks: tuple[float, ...] | None = None
    pattern: str | None = None
    exposure_s: float | None = None
    iso: float | None = None
    captured: str | None = None
    model: str | None = None
    wavelengths: tuple[float, ...] | None = None
    fwhm: tuple[float, ...] | None = None
    band_names: tuple[str, ...] | None = None
    interleave: str | None = None


def unreadable(
    path: str | Path, message: str, *, code: str = "E_UNREADABLE", **more: Any
) -> UnreadableCapture:
    """Return the refusal of a file, ready to raise."""
    return UnreadableCapture(Problem(code, message, file=str(path), **more))


def check_size(path: Path, shape: tuple[int, ...]) -> None:
    """Refuse absurd declared sizes before anything is allocated."""
    samples = 1
    for side in shape:
        samples *= int(side)
    if samples <= 0 or samples > MOST_PIXELS or max(shape[:2]) > LONGEST_SIDE:
        raise unreadable(
            path,
            "the declared size cannot be right",
            code="E_SIZE",
            field="width, height",
            found=" x ".join(str(s) for s in shape),
            expected=f"1 to {MOST_PIXELS} samples, sides up to {LONGEST_SIDE}",
            fix="Copy the file again from the camera.",
        )
