"""The colours of a mosaic, told from what its phases saw: guesses with their reasons."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

GREENS_ALIKE = 0.03
"""The two greens of a Bayer tile differ by less of their mean, other colours by more."""
AGREE = 0.8
"""Share of the evidence that must point one way."""
FIRST = "whether red or blue comes first in the mosaic"
DIAGONALS = (((0, 0), (1, 1)), ((0, 1), (1, 0)))
LONG_NM, MIDDLE_NM, SHORT_NM = (600.0, 720.0), (510.0, 570.0), (380.0, 480.0)


@dataclass(frozen=True)
class Mosaic:
    """A guessed mosaic: rows of channel names, why, and what remains unknown ("" for nothing)."""

    rows: tuple[tuple[str, ...], ...]
    why: str
    unknown: str = ""

    @property
    def letters(self) -> str:
        """``"RGGB"`` of a Bayer mosaic, else ""."""
        flat = [name for row in self.rows for name in row]
        return "".join(flat) if all(len(name) == 1 for name in flat) else ""


def name_mosaic(
    side: int,
    bright: np.ndarray,
    *,
    dark: float = 0.0,
    shown: Mapping[str, np.ndarray] | None = None,
    warmth: Mapping[str, float] | None = None,
    narrow: Mapping[float, np.ndarray] | None = None,
) -> Mosaic:
    """Name the channels of a mosaic.

    Parameters
    ----------
    side : int
        Of its tile, sensels.
    bright : ndarray, (side, side)
        Phase means of a white, or of an object where there is none; counts.
    dark : float
        Level without light.
    shown : mapping of object to ndarray, optional
        Phase means of objects, where `bright` is a white.
    warmth : mapping of object to float, optional
        Logarithm of its mean reflectance in long over that in short waves, as another camera saw it.
    narrow : mapping of nm to ndarray, optional
        Phase means behind narrow filters.

    Examples
    --------
    >>> white = np.array([[2189.0, 3011.0], [3011.0, 1949.0]])
    >>> icon = {"icon": np.array([[455.0, 333.0], [332.0, 177.0]])}
    >>> name_mosaic(2, white, dark=66, shown=icon, warmth={"icon": 1.2}).letters
    'RGGB'
    """
    if narrow and side == 2 and (told := _by_wavelength(narrow, dark)):
        return told
    diagonal = _greens(bright - dark) if side == 2 else None
    if diagonal is None:
        names = [f"B{i + 1}" for i in range(side * side)]
        rows = tuple(tuple(names[r * side : (r + 1) * side]) for r in range(side))
        unknown = "what each channel of the mosaic sees: the names are in reading order"
        return Mosaic(rows, f"levels repeat every {side} sensels", unknown)
    greens, ends = (DIAGONALS[diagonal], DIAGONALS[1 - diagonal])
    red, why, unknown = _first_is_red(ends, bright - dark, dark, shown or {}, warmth or {})
    grid = np.full((2, 2), "B", dtype=object)
    grid[greens[0]] = grid[greens[1]] = "G"
    grid[ends[0] if red else ends[1]] = "R"
    rows = tuple(tuple(str(n) for n in row) for row in grid)
    return Mosaic(rows, f"two phases on a diagonal are alike: greens{why}", unknown)


def _first_is_red(
    ends: tuple[tuple[int, int], tuple[int, int]],
    bright: np.ndarray,
    dark: float,
    shown: Mapping[str, np.ndarray],
    warmth: Mapping[str, float],
) -> tuple[bool, str, str]:
    """Whether the first of two phases is the red one, why, and what remains unknown."""
    votes = {}
    for target, phases in shown.items():
        first, last = (max(phases[p] - dark, 1e-3) / max(bright[p], 1e-3) for p in ends)
        votes[target] = float(np.log(first / last))
    known = {target: vote * warmth[target] for target, vote in votes.items() if target in warmth}
    if known and sum(map(abs, known.values())) > 0.01:
        vote, most = sum(known.values()), sum(map(abs, known.values()))
        sure = abs(vote) > AGREE * most
        return vote > 0, "; red sees objects as spectra have them", "" if sure else FIRST
    if not votes:
        return True, "", FIRST
    vote = sum(votes.values())
    why = "; red is where objects are brighter against the white, as paintings are"
    return vote >= 0, why, FIRST


def _greens(levels: np.ndarray) -> int | None:
    """Which of `DIAGONALS` holds two like phases; None for neither or both."""

    def differ(a: float, b: float) -> float:
        return abs(a - b) / max(0.5 * (a + b), 1e-9)

    main, other = differ(levels[0, 0], levels[1, 1]), differ(levels[0, 1], levels[1, 0])
    if min(main, other) > GREENS_ALIKE or max(main, other) < 2 * min(main, other) + 0.01:
        return None
    return 0 if main < other else 1


def _by_wavelength(narrow: Mapping[float, np.ndarray], dark: float) -> Mosaic | None:
    """Red, green and blue are the phases that see long, middle and short waves best."""
    shares: dict[str, np.ndarray] = {}
    for name, (low, high) in (("R", LONG_NM), ("G", MIDDLE_NM), ("B", SHORT_NM)):
        levels = [phases - dark for nm, phases in narrow.items() if low <= nm <= high]
        if not levels:
            return None
        shares[name] = np.mean([p / max(float(p.sum()), 1e-9) for p in levels], axis=0)
    red, blue = (np.unravel_index(int(shares[n].argmax()), (2, 2)) for n in "RB")
    grid = np.full((2, 2), "G", dtype=object)
    grid[red], grid[blue] = "R", "B"
    greens = np.argwhere(grid == "G")
    if len(greens) != 2 or abs(greens[0] - greens[1]).sum() != 2:
        return None
    rows = tuple(tuple(str(n) for n in row) for row in grid)
    return Mosaic(rows, "one phase sees the long waves best (R), one the short ones (B)")
