"""Lamp drift and flicker between shots, from the light in cells of a frame.

Each shot's brightness over the stack's mean is the median over cells of their ratios, so that something
that moved in a part of the picture does not count. A straight line through it is drift, what is left
is flicker.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

CELL = 32  # pixels a side
NOTICED = 0.002  # of the light: a fifth of what reflectance may be wrong by
SIGMAS = 4.0
DIM = 0.02  # of the brightest cells: darker ones tell only noise


@dataclass
class CellMeans:
    """What each shot of a stack saw in cells, filled while frames pass by.

    Examples
    --------
    >>> light = CellMeans()
    >>> frames = [np.full((64, 64), level) for level in (100, 101)]
    >>> sum(1 for _ in light.watch(frames)), light.cells.shape
    (2, (2, 4))
    """

    shots: list[np.ndarray] = field(default_factory=list)

    def watch(self, frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
        """Hand frames on and keep the means of their cells."""
        for frame in frames:
            self.shots.append(_cell_means(frame))
            yield frame

    @property
    def cells(self) -> np.ndarray:
        """Mean counts, (shots, cells)."""
        return np.array(self.shots)


@dataclass(frozen=True)
class Drift:
    """How steady the light was.

    Parameters
    ----------
    scales : ndarray, (shots,)
        Brightness of each shot over the mean of all.
    drift : float
        Change along a straight line from the first shot to the last, relative.
    flicker : float
        Standard deviation about that line, relative; NaN with fewer than three shots.
    error : float
        What noise alone puts on a single scale.
    """

    scales: np.ndarray
    drift: float
    flicker: float
    error: float

    @property
    def noticed(self) -> bool:
        """Whether either stands out of the noise and would show in reflectance."""
        least = max(NOTICED, SIGMAS * self.error)
        return abs(self.drift) > least or self.flicker > least

    @property
    def note(self) -> str:
        """What to tell a person; empty where the light was steady."""
        if not self.noticed:
            return ""
        parts = [f"the light changed by {100 * self.drift:+.2f} % from the first shot to the last"]
        if np.isfinite(self.flicker):
            parts.append(f"and flickered by {100 * self.flicker:.2f} % rms")
        return f"{' '.join(parts)}: let lamps warm up, and take white and object in turns"


def measure_drift(cells: np.ndarray, dark: float | np.ndarray = 0.0) -> Drift | None:
    """Compare the shots of one scene.

    Parameters
    ----------
    cells : ndarray, (shots, cells)
        Mean counts, from `CellMeans`; in the order in which they were taken.
    dark : float or ndarray, (cells,)
        Counts without light.

    Returns
    -------
    drift : Drift or None
        None with fewer than two shots or without light.

    Examples
    --------
    >>> cells = np.outer([1.00, 1.01, 1.02], np.linspace(50, 900, 40)) + 64
    >>> found = measure_drift(cells, 64.0)
    >>> round(found.drift, 3), found.noticed
    (0.02, True)
    """
    light = np.asarray(cells, float) - dark
    mean = light.mean(0)
    bright = mean > DIM * np.quantile(mean, 0.98)
    if len(light) < 2 or not bright.any() or np.quantile(mean, 0.98) <= 0:
        return None
    ratios = light[:, bright] / mean[bright]
    scales = np.median(ratios, axis=1)
    spread = 1.4826 * np.median(np.abs(ratios - scales[:, None]))
    error = 1.2533 * float(spread) / np.sqrt(ratios.shape[1])
    return Drift(scales, *_line(scales), error)


def common_variance(scales: Sequence[float] | np.ndarray) -> float:
    """Return the relative variance that the light of all pixels shares over shots.

    >>> round(common_variance([0.99, 1.01]), 6)
    0.0002
    """
    return float(np.var(scales, ddof=1)) if len(scales) > 1 else 0.0


def _line(scales: np.ndarray) -> tuple[float, float]:
    count = len(scales)
    at = np.arange(count) - (count - 1) / 2
    slope = float(at @ scales / (at @ at))
    rest = scales - scales.mean() - slope * at
    flicker = float(np.sqrt(rest @ rest / (count - 2))) if count > 2 else float("nan")
    return slope * (count - 1), flicker


def _cell_means(frame: np.ndarray) -> np.ndarray:
    """Return means of squares of `CELL` pixels, or of the frame where it is smaller."""
    planes = frame.reshape(*frame.shape[:2], -1)
    high, wide = (max(1, n // CELL) for n in frame.shape[:2])
    tall, broad = (n if n < CELL else CELL for n in frame.shape[:2])
    whole = planes[: high * tall, : wide * broad]
    parts = whole.reshape(high, tall, wide, broad, -1)
    return parts.mean((1, 3), dtype=np.float64).ravel()
