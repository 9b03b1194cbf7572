"""What a file says of itself before a pixel is decoded."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

from levkas.problems import Problem, Refused

MOST_SAMPLES = 2_000_000_000
"""Samples of one frame; a file that declares more is damaged or not an image."""
LONGEST_SIDE = 500_000
FREE_BYTES = 64 << 20
"""What a file may expand to whatever its ratio: constant dark frames compress very well."""
COPY_AGAIN = "Copy the file again from the camera, or leave it out of the campaign."


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
        (h, w) or (h, w, samples) of one page; for ENVI (lines, samples, bands).
    dtype : str
    pages : int
        Full-size pages of a TIFF; previews and masks are not counted.
    bits : int or None
        Significant bits of a sample.
    black, saturation : float or None, counts
        `black` is the mean where the phases of a mosaic differ.
    blacks : tuple of float or None
        Black of each phase of the pattern, row by row, where they differ.
    pattern : str or None
        Bayer letters of the visible area row by row: ``"RGGB"``.
    exposure_s, iso : float or None
    captured : str or None
        ISO 8601, local time of the camera unless the file states an offset.
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
    path: str | Path,
    message: str,
    *,
    code: str = "E_UNREADABLE",
    expected: Any = "a whole file as its format is",
    fix: str | None = COPY_AGAIN,
    **more: Any,
) -> UnreadableCapture:
    """Return the refusal of a file, ready to raise.

    Examples
    --------
    >>> print(unreadable("a.tif", "no page 3", found="2 pages", expected="4", fix="Check the name."))
    no page 3 (file: a.tif; found: 2 pages; expected: 4). Check the name.
    """
    more.setdefault("found", "nothing of the kind")
    return UnreadableCapture(
        Problem(code, message, file=str(path), expected=expected, fix=fix, **more)
    )


@contextmanager
def decoding(path: Path, what: str) -> Iterator[None]:
    """Turn whatever a decoder raises on a damaged file into UnreadableCapture."""
    try:
        yield
    except Refused:
        raise
    except Exception as error:
        # Damaged headers lead tifffile, imagecodecs and exifread to any class there is: struct,
        # zlib, key, type, recursion and memory errors were all met. Programs still end on Ctrl-C.
        raise unreadable(
            path,
            f"the {what} cannot be read",
            found=f"{type(error).__name__}: {error}"[:300],
            expected=f"a whole {what}",
            fix=COPY_AGAIN,
        ) from error


def check_size(
    path: Path,
    shape: tuple[int, ...],
    *,
    most: int = MOST_SAMPLES,
    field: str = "width, height",
    fix: str = COPY_AGAIN,
) -> None:
    """Refuse absurd declared sizes before anything is allocated."""
    samples = prod(int(side) for side in shape)
    if min(shape) > 0 and samples <= most and max(shape) <= LONGEST_SIDE:
        return
    raise unreadable(
        path,
        "the declared size cannot be right",
        code="E_SIZE",
        field=field,
        found=" x ".join(str(s) for s in shape),
        expected=f"1 to {most} samples, sides up to {LONGEST_SIDE}",
        fix=fix,
    )


def check_ratio(
    path: Path, needed: int, stored: int, *, ratio: int, field: str = "width, height"
) -> None:
    """Refuse an image of `needed` bytes that `stored` bytes cannot hold at `ratio` to 1."""
    if needed <= FREE_BYTES or needed <= ratio * stored:
        return
    raise unreadable(
        path,
        "the image is larger than its stored bytes can hold",
        code="E_SIZE",
        field=field,
        found=f"{needed} bytes from {stored}",
        expected=f"at most {ratio} to 1",
        fix=COPY_AGAIN,
    )
