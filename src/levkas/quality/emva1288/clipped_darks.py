"""Darks that the camera clipped at zero: black and noise from what is left of their distribution.

With the true black at 0, the mean of a clipped dark is 0.399 σ and its spread 0.584 σ: subtracting it
biases every lit pixel.  A code k stands for (k − ½, k + ½), the code 0 for everything below ½; black,
noise in time and spread between sensels are those that make pairs of shots likeliest, a sensel's own
offset being integrated out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from levkas.calibration.templates import CalibrationRefused
from levkas.core.problems import Problem

MANY_ZEROS = 0.02
NARROW = 0.3  # counts: a smaller spread is hidden by rounding
BINS = 160
NODES = 17  # of Gauss and Hermite
FEWEST = 30  # pixels at codes 2 to 4, without which a spread is not told from a black


@dataclass(frozen=True)
class DarkLevel:
    """Black and noise of a dark, counts.

    Parameters
    ----------
    black : float
        Mean before clipping; may be negative.
    noise : float
        Standard deviation over time, rounding not included.
    fixed : float
        Standard deviation from sensel to sensel; NaN from a single shot, whose `noise` holds both.
    black_error, noise_error, fixed_error : float
        One standard error of each.
    zeros : float
        Share of pixels at 0.
    """

    black: float
    noise: float
    fixed: float
    black_error: float
    noise_error: float
    fixed_error: float
    zeros: float


def is_clipped(frame: np.ndarray) -> bool:
    """Whether a dark frame was clipped at zero, so that its mean is not black.

    Zeros in more than 2 % of the pixels, or a spread below 0.3 counts about 0.

    >>> is_clipped(np.array([[0, 0, 1, 2]])), is_clipped(np.full((2, 2), 64))
    (True, False)
    """
    if frame.min() > 0:
        return False
    return bool(np.mean(frame == 0) > MANY_ZEROS or frame.std() < NARROW)


def fit_clipped_dark(frames: Sequence[np.ndarray]) -> DarkLevel:
    """Fit black, noise and spread of darks that were clipped at zero.

    Parameters
    ----------
    frames : sequence of ndarray, one shape, whole codes
        Shots of one exposure and one channel. Two or more tell noise from fixed pattern; they are
        taken in pairs.

    Returns
    -------
    level : DarkLevel

    Raises
    ------
    CalibrationRefused
        E_DARK_CLIPPED where so little stands above zero that black and noise cannot be told apart.

    Notes
    -----
    Normal in time and from sensel to sensel; hot sensels are a share of outliers, spread evenly,
    that is fitted too. Errors are from the curvature of the likelihood. From 300,000 pixels black
    and noise come within 1 % of σ while a tenth of the pixels is above zero.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> shots = [np.rint(rng.normal(0.5, 2.0, (300, 300))).clip(0) for _ in range(2)]
    >>> level = fit_clipped_dark(shots)
    >>> abs(level.black - 0.5) < 0.05, abs(level.noise - 2.0) < 0.05
    (True, True)
    """
    from scipy.optimize import minimize

    first = frames[0]
    pairs = [(a, b) for a, b in zip(frames[::2], frames[1::2], strict=False)] or [(first, first)]
    edges, table = _table(pairs, alone=len(frames) == 1)
    zeros = float(np.mean([np.mean(frame == 0) for frame in frames]))
    _check_informative(frames, zeros)
    start = _first_guess(np.concatenate([np.ravel(frame) for frame in frames]))
    free = np.array([True, True, len(frames) > 1, True])

    def loss(part: np.ndarray) -> float:
        full = start.copy()
        full[free] = part
        if not free[2]:
            full[2] = -20.0
        return _loss(full, edges, table, alone=len(frames) == 1)

    options = {"xatol": 1e-4, "fatol": 5e-3, "maxiter": 4000, "maxfev": 4000}
    made = minimize(loss, start[free], method="Nelder-Mead", options=options)
    made = minimize(loss, made.x, method="Nelder-Mead", options=options)
    errors = _errors(loss, made.x)
    found, error = np.full(4, np.nan), np.full(4, np.nan)
    found[free], error[free] = made.x, errors
    noise, fixed = np.exp(found[1]), np.exp(found[2])
    numbers = found[0], noise, fixed, error[0], noise * error[1], fixed * error[2], zeros
    return DarkLevel(*(float(n) for n in numbers))


def _check_informative(frames: Sequence[np.ndarray], zeros: float) -> None:
    # Hot sensels stand anywhere: a few counts above zero there must be more than those.
    beyond = max(int(np.count_nonzero((f >= 2) & (f <= 4))) for f in frames)
    beyond = max(beyond, *(int(np.count_nonzero(f > 4)) if np.median(f) > 2 else 0 for f in frames))
    if beyond >= FEWEST:
        return
    raise CalibrationRefused(
        Problem(
            "E_DARK_CLIPPED",
            "the darks are clipped so far that black cannot be told from them",
            found=f"{zeros:.1%} zeros, {beyond} pixels at 2 to 4 counts",
            expected=f"{FEWEST} or more",
            fix="Raise the camera's black level (offset) by some counts, or capture an exposure series "
            "of a lit scene: black is fitted from it.",
        )
    )


def _first_guess(codes: np.ndarray) -> np.ndarray:
    """Return parameters from how much lies above two codes."""
    from scipy.special import ndtri

    above = 1 - np.cumsum(np.bincount(codes.astype(np.int64))[:4000]) / len(codes)
    low = int(np.argmax(above < 0.7))
    high = max(low + 1, int(np.argmax(above <= above[low] / 8)))
    z = -ndtri(np.clip([above[low], above[min(high, len(above) - 1)]], 1e-6, 1 - 1e-6))
    noise = (high - low) / max(z[1] - z[0], 0.05)
    black = low + 0.5 - z[0] * noise
    return np.array([black, np.log(noise), np.log(noise / 4), -7.0])


def _table(
    pairs: list[tuple[np.ndarray, np.ndarray]], *, alone: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the upper edges of bins of codes, and how often pairs of bins occur."""
    sample = np.concatenate([pair[0].ravel() for pair in pairs])
    # Twice the 99th percentile lies beyond 4 sigma of what is no hot sensel, even for half a normal.
    top = int(max(2 * np.quantile(sample, 0.99), 6))
    width = -(-(top + 1) // BINS)
    bins = top // width + 1
    table = np.zeros((bins, bins))
    for a, b in pairs:
        i, j = (np.asarray(p).ravel().astype(np.int64) // width for p in (a, b))
        inside = (i < bins) & (j < bins)
        table += np.bincount(i[inside] * bins + j[inside], minlength=bins * bins).reshape(bins, -1)
    return (np.arange(bins) + 1) * width - 0.5, table.diagonal().copy() if alone else table


def _loss(numbers: np.ndarray, edges: np.ndarray, table: np.ndarray, *, alone: bool) -> float:
    """Return minus the logarithm of the likelihood."""
    from scipy.special import ndtr

    black, noise, fixed, outliers = numbers
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
    centre = black + np.exp(fixed) * nodes[:, None]
    below = ndtr((edges - centre) / np.exp(noise))
    share = np.diff(below, axis=1, prepend=0.0)
    weights = weights / weights.sum()
    likely = weights @ share if alone else (share * weights[:, None]).T @ share
    odd = 1 / (1 + np.exp(-np.clip(outliers, -40, 40)))
    return -float(np.sum(table * np.log((1 - odd) * likely + odd / table.size + 1e-300)))


def _errors(loss: object, best: np.ndarray) -> np.ndarray:
    """Return standard errors from the curvature of the loss."""
    count, step = len(best), 2e-3
    curvature = np.empty((count, count))
    moves = np.eye(count) * step
    for i in range(count):
        for j in range(count):
            corners = [
                loss(best + a * moves[i] + b * moves[j])  # type: ignore[operator]
                for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))
            ]
            curvature[i, j] = (corners[0] - corners[1] - corners[2] + corners[3]) / (4 * step**2)
    # A parameter on which nothing depends (no outliers, no fixed pattern) has no curvature.
    return np.sqrt(np.maximum(np.diag(np.linalg.pinv(curvature, rcond=1e-9)), 0.0))
