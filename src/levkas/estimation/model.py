"""The protocol of fitted estimators, and prediction of many pixels in blocks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from levkas.core.machine import steady_libraries
from levkas.core.problems import Problem, Refused
from levkas.core.threads import each
from levkas.estimation.training import Training

BLOCK = 256
"""Pixels that are estimated at a time: their kernels with 1,500 anchors, 3 MB, stay in the cache."""


class Model(Protocol):
    """A fitted estimator: ``model(responses)`` returns spectra and, where it estimates it, their sigma."""

    def __call__(self, responses: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]: ...
    def arrays(self) -> dict[str, np.ndarray]: ...


@dataclass(frozen=True)
class EstimationMethod:
    """A row of `levkas.estimation.methods.METHODS`.

    Parameters
    ----------
    name, title : str
        On the command line, and in tables.
    fitter : callable
        ``fitter(training, rng)`` returns a `Model`.
    read : callable
        ``read(arrays)`` makes a model again of what its ``arrays()`` returned.
    """

    name: str
    title: str
    fitter: Callable[[Training, np.random.Generator], Model]
    read: Callable[[Mapping[str, np.ndarray]], Model]

    def fit(self, training: Training, rng: np.random.Generator) -> Model:
        """Fit the method, with linear algebra that sums in one order on any number of processors."""
        with steady_libraries():
            return self.fitter(training, rng)


def in_blocks(
    estimate: Callable[[np.ndarray], tuple[np.ndarray, ...]], responses: np.ndarray, channels: int
) -> tuple[np.ndarray, ...]:
    """Estimate pixels block by block, several blocks at a time.

    Parameters
    ----------
    estimate : callable
        (m, channels) → arrays of m rows.
    responses : ndarray, (n, channels)
        NaN gives NaN.
    channels : int
        That the model was fitted with.

    Raises
    ------
    Refused
        Where the responses have another number of channels.
    """
    responses = np.asarray(responses, float)
    if responses.ndim != 2 or responses.shape[1] != channels:
        raise Refused(
            Problem(
                "E_CHANNELS",
                "the model was fitted with other channels than these responses have",
                found=responses.shape,
                expected=("n", channels),
                fix="Give layers of as many channels as the model was fitted with.",
            )
        )
    starts = range(0, max(len(responses), 1), BLOCK)
    with steady_libraries():
        blocks = each(estimate, [responses[start : start + BLOCK] for start in starts])
    return tuple(np.concatenate(parts) for parts in zip(*blocks, strict=True))
