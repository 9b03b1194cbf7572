"""Logit link: a method that works on the logarithm of the odds of reflectance.

    z = log(u / (1 − u)),   u = y / h

Estimates lie between 0 and h, 1 or a little above the highest training value. [heikkinen2013]_,
10.1364/JOSAA.30.002444.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from levkas.estimation.model import Model
from levkas.estimation.training import Training

SMALLEST = 0.002
"""Of u and 1 − u: reflectance below it is noise, and its logarithm would be noise too."""
MARGIN = 1.01
"""h over the highest training value, where that is above 1."""


@dataclass(frozen=True, eq=False)
class LogitModel:
    """A model of z with the highest reflectance h of its training."""

    inner: Model
    highest: float

    def __call__(self, responses: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        z, sigma = self.inner(responses)
        u = 1 / (1 + np.exp(-z))
        return self.highest * u, None if sigma is None else self.highest * u * (1 - u) * sigma

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all that the model is, as arrays."""
        return {**self.inner.arrays(), "highest": np.asarray(self.highest)}


def fit_with_logit(
    training: Training,
    rng: np.random.Generator,
    *,
    fit: Callable[[Training, np.random.Generator], Model],
) -> LogitModel:
    """Fit a method to the logarithm of the odds; sigma of spectra is propagated."""
    highest = max(1.0, MARGIN * float(training.spectra.max()))
    u = np.clip(training.spectra / highest, SMALLEST, 1 - SMALLEST)
    sigma = training.spectrum_sigma

    def read(z: np.ndarray) -> np.ndarray:
        return np.asarray(highest / (1 + np.exp(-z)))

    linked = replace(
        training,
        criterion=lambda estimated, measured: training.criterion(read(estimated), read(measured)),
        spectra=np.log(u / (1 - u)),
        spectrum_sigma=None if sigma is None else sigma / (highest * u * (1 - u)),
    )
    return LogitModel(fit(linked, rng), highest)


def read_with_logit(
    arrays: Mapping[str, np.ndarray], *, read: Callable[[Mapping[str, np.ndarray]], Model]
) -> LogitModel:
    """Return the model of some arrays; `read` makes the inner one."""
    return LogitModel(read(arrays), float(arrays["highest"]))
