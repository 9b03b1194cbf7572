"""Names of analyses as a person writes them: ``infrared-visible``, ``ratio:700/1000``."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from levkas.core.cube import Band
from levkas.core.problems import Problem, Refused, closest_match

INFRARED = "infrared-visible"
RATIO = "ratio"
WAVELENGTH_NM = 5.0
"""A band is that of a wavelength where its centre is no further away, or half its width."""
MOST = 24
"""Analyses of one publication."""
LONGEST_LABEL = 60


class AnalysisUnknown(Refused):
    """A name is that of no analysis; every wrong one is listed."""


@dataclass(frozen=True)
class Analysis:
    """An analysis that is wanted.

    Parameters
    ----------
    kind : "infrared-visible" or "ratio"
    bands : tuple of str
        Of a ratio, as they were written.
    """

    kind: str
    bands: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """As it is written.

        >>> Analysis("ratio", ("700", "1000")).text
        'ratio:700/1000'
        """
        return self.kind if not self.bands else f"{self.kind}:{'/'.join(self.bands)}"

    @property
    def name(self) -> str:
        """Part of a file's name, another one for other bands.

        >>> Analysis("ratio", ("R 1", "1000 nm")).name, Analysis("ratio", ("IR+", "R")).name
        ('ratio-R_1-1000_nm', 'ratio-IR=2B-R')
        """
        if not self.bands:
            return self.kind
        plain = [re.sub(r"[^A-Za-z0-9. ]", lambda m: f"={ord(m[0]):02X}", b) for b in self.bands]
        return "-".join((self.kind, *(band.replace(" ", "_") for band in plain)))

    @property
    def needs(self) -> str:
        """What a layer must have."""
        if self.kind == RATIO:
            return f"bands {' and '.join(self.bands)} of one object under one light"
        return "bands from 780 to 1100 nm, and from 400 to 700 nm under the same light"


def parse_analyses(texts: Iterable[str]) -> tuple[Analysis, ...]:
    """Read names of analyses, separated by commas.

    Raises
    ------
    AnalysisUnknown
        ``E_VALUE`` with every name that is none.

    Examples
    --------
    >>> [analysis.text for analysis in parse_analyses(["infrared-visible,ratio:700/1000"])]
    ['infrared-visible', 'ratio:700/1000']
    """
    found: dict[str, Analysis] = {}
    problems = []
    for text in [part.strip() for one in texts for part in one.split(",")]:
        kind, colon, rest = text.partition(":")
        kind = kind.strip().lower()
        bands = tuple(part.strip() for part in rest.split("/"))
        if kind == INFRARED and not colon:
            found[kind] = Analysis(kind)
        elif kind == RATIO and len(bands) == 2 and all(0 < len(b) <= LONGEST_LABEL for b in bands):
            ratio = Analysis(kind, bands)
            found.setdefault(ratio.name, ratio)
        else:
            names = f"{INFRARED}, {RATIO}:700/1000 or {RATIO}:R/IR"
            what = "there is no such analysis"
            fix = closest_match(kind, (INFRARED, RATIO)) or f"Write {names}."
            problems.append(Problem("E_VALUE", what, None, "--analyse", text, names, fix))
    if len(found) > MOST:
        what = "too many analyses"
        problems.append(Problem("E_VALUE", what, None, "--analyse", len(found), f"at most {MOST}"))
    if problems:
        raise AnalysisUnknown(*problems)
    return tuple(found.values())


def find_band(bands: Sequence[Band], text: str) -> int | None:
    """Find a band by its label or its wavelength, nm; None where there is none.

    Examples
    --------
    >>> bands = [Band("690 nm", 690.0, 10.0), Band("698 nm", 698.0, 10.0), Band("IR")]
    >>> [find_band(bands, text) for text in ("700", "690nm", "ir", "750")]
    [1, 0, 2, None]
    """
    wanted = _plain(text)
    labels = [_plain(band.label) for band in bands]
    if wanted in labels:
        return labels.index(wanted)
    centre = _wavelength(text)
    apart = [abs(band.wavelength - centre) for band in bands]
    if not bands or np.isnan(apart).all():
        return None
    best = int(np.nanargmin(apart))
    width = bands[best].fwhm
    reach = max(WAVELENGTH_NM, 0.0 if np.isnan(width) else width / 2)
    return best if apart[best] <= reach else None


def _plain(text: str) -> str:
    return "".join(text.split()).lower().removesuffix("nm")


def _wavelength(text: str) -> float:
    try:
        return float(_plain(text))
    except ValueError:
        return float("nan")
