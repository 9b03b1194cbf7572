"""Drift and flicker of the light over the shots of a stack."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from levkas.calibration.lamp import SIGMAS, measure_light

NOTICED = 0.002  # of the light: a fifth of what reflectance may be wrong by


@dataclass(frozen=True)
class Drift:
    """How steady the light was: brightness of each shot over the mean of all, and relative change along a line from first to last.

    `flicker` is the standard deviation about that line, NaN with fewer than three shots; `error` what noise puts on a scale.
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
        """Warning for the user; empty where the light was steady."""
        if not self.noticed:
            return ""
        parts = [f"the light changed by {100 * self.drift:+.2f} % from the first shot to the last"]
        if np.isfinite(self.flicker):
            parts.append(f"and flickered by {100 * self.flicker:.2f} % rms")
        return f"{' '.join(parts)}: let lamps warm up, and take white and object in turns"


def measure_drift(cells: np.ndarray, dark: float | np.ndarray = 0.0) -> Drift | None:
    """Compare the shots of one scene, (shots, cells) in their order; None of fewer than two, or without light.

    >>> cells = np.outer([1.00, 1.01, 1.02], np.linspace(50, 900, 40)) + 64
    >>> found = measure_drift(cells, 64.0)
    >>> round(found.drift, 3), found.noticed
    (0.02, True)
    """
    found = measure_light(np.asarray(cells, float)[:, None], dark)
    if len(cells) < 2 or not np.isfinite(found.error[0]):
        return None
    scales, count = found.levels[:, 0], len(cells)
    at = np.arange(count) - (count - 1) / 2
    slope = float(at @ scales / (at @ at))
    rest = scales - scales.mean() - slope * at
    flicker = float(np.sqrt(rest @ rest / (count - 2))) if count > 2 else float("nan")
    return Drift(scales, slope * (count - 1), flicker, float(found.error[0]))


def common_variance(scales: Sequence[float] | np.ndarray) -> float:
    """Return the relative variance that the light of all pixels shares over shots.

    >>> round(common_variance([0.99, 1.01]), 6)
    0.0002
    """
    return float(np.var(scales, ddof=1)) if len(scales) > 1 else 0.0
