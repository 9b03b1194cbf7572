"""Bounds from one shot of everything: noise in space bounds noise over time.

The spread within small blocks of a flat, lit surface holds shot noise, read-out noise, PRNU and texture at once, so
that it bounds each of them; two shots would part them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from levkas.quality.emva1288.blocks import Blocks
from levkas.quality.emva1288.darks import Dark, DarkModel, model_darks

LIT = (0.15, 0.9)
"""Of saturation, above dark: where a white says something of noise and PRNU."""
FEWEST_BLOCKS = 8


@dataclass(frozen=True)
class Bound:
    """A number with the side on which it binds: ``"="``, ``"≤"`` or ``"≥"``."""

    name: str
    sign: str
    value: float
    unit: str

    def __str__(self) -> str:
        return f"{self.name} {self.sign} {self.value:.3g} {self.unit}".rstrip()


def bound_sensor(
    darks: Sequence[Dark], whites: Sequence[Blocks], *, saturation: float
) -> list[Bound]:
    """Return what single shots of a dark and of a white tell of one channel.

    Parameters
    ----------
    darks : sequence of Dark
    whites : sequence of Blocks
        Of an even, lit surface, one shot each.
    saturation : float
        Counts.

    Returns
    -------
    bounds : list of Bound
        Empty where there is neither.

    Examples
    --------
    A white of 1,000 counts whose spread is 10 in each of nine blocks, over a dark of 0 with a spread of 2.

    >>> white = Blocks(np.full(9, 1000.0), np.full(9, np.nan), np.full(9, 100.0), 1)
    >>> dark = Dark(np.zeros(9), np.nan, np.nan)
    >>> [str(b) for b in bound_sensor([dark], [white], saturation=4095)]
    ['black = 0 DN', 'gain K ≤ 0.1 DN/e⁻', 'PRNU ≤ 1 %', 'full well ≥ 4.1e+04 e⁻', 'SNR of the white ≥ 100']
    """
    found, level, quiet, model = [], 0.0, 0.0, None
    if darks:
        level = _middle(darks[0].level)
        model = model_darks(darks)
        found.append(Bound("black", "=", level, "DN"))
        spread = _middle(darks[0].spread)
        if np.isfinite(spread):
            quiet = spread
            found.append(Bound("noise in the dark, DSNU included", "≤", np.sqrt(quiet), "DN"))
    signal, variance = _lit(whites, model, saturation - level)
    if len(signal) < FEWEST_BLOCKS:
        return found
    each = np.maximum(variance - quiet, 0)
    gain = float(np.median(each / signal))
    return [
        *found,
        Bound("gain K", "≤", gain, "DN/e⁻"),
        Bound("PRNU", "≤", 100 * float(np.median(np.sqrt(each) / signal)), "%"),
        Bound("full well", "≥", (saturation - level) / max(gain, 1e-12), "e⁻"),
        Bound("SNR of the white", "≥", float(np.median(signal / np.sqrt(variance))), ""),
    ]


def _lit(
    whites: Sequence[Blocks], model: DarkModel | None, room: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return signal and spatial variance of blocks that are well lit."""
    above = [
        b.mean - (_middle(model.under(b.band, b.exposure_s)) if model is not None else 0.0)
        for b in whites
    ]
    signal = np.concatenate(above) if whites else np.empty(0)
    variance = np.concatenate([b.spatial for b in whites]) if whites else np.empty(0)
    used = np.isfinite(signal + variance) & (signal > LIT[0] * room) & (signal < LIT[1] * room)
    return signal[used], variance[used]


def _middle(values: np.ndarray | float) -> float:
    known = np.atleast_1d(values)
    known = known[np.isfinite(known)]
    return float(np.median(known)) if len(known) else float("nan")
