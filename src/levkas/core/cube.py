"""The cube: calibrated bands of one object by one camera under one setup."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import IntFlag
from math import nan
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Problem, Refused, closest_match

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import xarray


class Flag(IntFlag):
    """Bits of the flag field, one byte per pixel and band; docs/conventions.md describes each. A value that is none raises ValueError.

    >>> import numpy as np
    >>> flags = np.array([[0, 2, 66]], np.uint8)
    >>> (flags & Flag.SATURATED > 0).tolist(), Flag(66)
    ([[False, True, True]], <Flag.SATURATED|NEAR: 66>)
    """

    OUTSIDE = 1
    SATURATED = 2
    BLACK = 4
    DEFECT = 8
    GLARE = 16
    MOVED = 32
    NEAR = 64
    VEILED = 128


UNRELIABLE = Flag.OUTSIDE | Flag.SATURATED
"""Pixels that registration must not lean on; single defects were replaced well enough for it."""


def is_flagged(flags: np.ndarray, flag: Flag) -> np.ndarray:
    """Return where at least one of some flags is set, of bool, the shape of `flags`.

    NumPy takes a `Flag` for a number of 64 bits, and would make eight bytes of every one.

    >>> is_flagged(np.array([0, 2, 66, 1], np.uint8), Flag.SATURATED | Flag.NEAR).tolist()
    [False, True, True, False]
    """
    return np.asarray((flags & np.uint8(flag)) != 0)


@dataclass(frozen=True, slots=True)
class Band:
    """One channel of a cube: its label, such as ``"550 nm"`` or ``"R1"``, centre and full width at half maximum, nm.

    NaN where the channel is broad, or the width not known. A `bad` band is one that its file calls so: its values are
    kept, and used for nothing. Without a label it raises TypeError.

    >>> Band("550 nm", 550.0, 10.0).wavelength
    550.0
    """

    label: str
    wavelength: float = nan
    fwhm: float = nan
    bad: bool = False


@dataclass(frozen=True)
class Cube:
    """Values of one camera with what is known about each of them.

    `values`, (height, width, bands), float32, are reflectance (1.0 is the perfect diffuser) or counts, as `quantity` says:
    ``"reflectance"`` or ``"counts"``. `flags`, uint8, has bits of `Flag`; `sigma`, float32 or None, is one standard deviation
    of the random part, in the unit of `values`. Arrays that differ in shape, or do not have as many bands as `bands`, raise
    ValueError.

    >>> import numpy as np
    >>> grey = np.full((2, 3, 1), 0.5, np.float32)
    >>> cube = Cube(grey, np.zeros(grey.shape, np.uint8), None, (Band("550 nm", 550.0),))
    >>> cube.to_xarray().sel(band="550 nm").shape
    (2, 3)
    """

    values: np.ndarray
    flags: np.ndarray
    sigma: np.ndarray | None
    bands: tuple[Band, ...]
    quantity: str = "reflectance"

    def __post_init__(self) -> None:
        shapes = [a.shape for a in (self.values, self.flags, self.sigma) if a is not None]
        if len(set(shapes)) != 1 or self.values.ndim != 3 or shapes[0][2] != len(self.bands):
            raise ValueError(f"cube of {len(self.bands)} bands has arrays of shapes {shapes}")

    @property
    def labels(self) -> list[str]:
        """Band labels in order."""
        return [band.label for band in self.bands]

    @property
    def shape(self) -> tuple[int, int, int]:
        """(height, width, bands)."""
        height, width, bands = self.values.shape
        return height, width, bands

    @property
    def has_sigma(self) -> bool:
        """Whether the noise is known."""
        return self.sigma is not None

    @property
    def blocks(self) -> tuple[Cube]:
        """The cube itself, as the one block of its rows."""
        return (self,)

    def to_xarray(self, **attributes: Any) -> xarray.DataArray:
        """Return a labelled array, dims ``("y", "x", "band")``."""
        import xarray

        coords = {
            "band": self.labels,
            "wavelength": ("band", [b.wavelength for b in self.bands]),
            "fwhm": ("band", [b.fwhm for b in self.bands]),
        }
        attributes = {"quantity": self.quantity, **attributes}
        return xarray.DataArray(self.values, coords, ("y", "x", "band"), attrs=attributes)


@dataclass(frozen=True)
class CubeRows:
    """A cube that comes in `blocks` of some rows, from top to bottom, taken once; a `Cube` is its own one block.

    `shape` is (height, width, bands) of all rows together.
    """

    blocks: Iterable[Cube]
    shape: tuple[int, int, int]
    bands: tuple[Band, ...]
    quantity: str
    has_sigma: bool


def band_labels(wavelengths: Sequence[float]) -> list[str]:
    """Label wavelengths, nm, with the fewest decimals that keep the labels unique; two may not be the same number.

    >>> band_labels([400, 410.0])
    ['400 nm', '410 nm']
    >>> band_labels([366.551, 366.56])
    ['366.55 nm', '366.56 nm']
    """
    values = [float(w) for w in wavelengths]
    for decimals in range(7):
        labels = [f"{w:.{decimals}f} nm" for w in values]
        if len(set(labels)) == len(labels):
            return labels
    twice = sorted({w for w in values if values.count(w) > 1})
    found = f"{twice[:3]} nm twice" if twice else "wavelengths closer than 1e-6 nm"
    what, expected = "two bands have the same wavelength", "one band per wavelength"
    raise Refused(Problem("E_BAND_TWICE", what, None, "wavelengths", found, expected))


def find_band(labels: Sequence[str], text: str, wavelengths: Sequence[float] = ()) -> int:
    """Return the index of the band that `text` names: ``"550 nm"``, ``"550nm"``, ``"550"``, ``"R1"``.

    A wavelength with more decimals than the labels have is found among `wavelengths`, nm. Refused where no band, or more
    than one, is meant.

    >>> find_band(["540 nm", "550 nm"], "550nm")
    1
    """
    if text in labels:
        return list(labels).index(text)
    number = _wavelength(str(text))
    for known in ([_wavelength(label) for label in labels], wavelengths):
        hits = [i for i, wavelength in enumerate(known) if abs(wavelength - number) < 5e-4]
        if len(hits) == 1:
            return hits[0]
    expected = ", ".join(labels) if len(labels) <= 12 else f"{labels[0]} … {labels[-1]}"
    fix = _near_bands(labels, text, number) or "Use a band name from the list."
    what = f"unknown band {text!r}"
    raise Refused(Problem("E_BAND_MISSING", what, None, "band", str(text), expected, fix))


def _near_bands(labels: Sequence[str], text: str, number: float) -> str | None:
    """Return which bands may be meant: those next to a wavelength, else the one of the nearest name.

    >>> _near_bands(["540 nm", "550 nm", "600 nm"], "555", 555.0)
    "Did you mean '550 nm' or '600 nm'?"
    """
    known = [(nm, label) for label in labels if (nm := _wavelength(label)) == nm]
    if number != number or not known:
        return closest_match(text, labels)
    below, above = [k for k in known if k[0] < number], [k for k in known if k[0] > number]
    near = [repr(choose(some)[1]) for choose, some in ((max, below), (min, above)) if some]
    return f"Did you mean {' or '.join(near)}?"


def _wavelength(text: str) -> float:
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(?:nm)?\s*", text)
    return float(found.group(1)) if found else nan
