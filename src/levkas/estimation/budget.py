"""The error budget of spectral estimation: what metamerism, noise, registration and exposure cost.

The same experiment is run with responses computed from the reference cube itself (perfect registration,
no noise), with the cameras' noise added, and as captured; with the reference shifted by parts of a pixel; and
with another exposure of the test.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from levkas.core.problems import Refused
from levkas.estimation.methods import EstimationMethod, Model
from levkas.estimation.samples import PaintSamples, SampleSource, choose_training

SHIFTS_PX = (0.25, 0.5, 1.0)
EXPOSURES = (0.5, 2.0)
SAMPLES = 500
"""Training samples of each experiment of the budget."""
SMOOTHNESS = 0.03
"""Weight of second differences of an effective sensitivity, over the root mean square of spectra."""
CONDITIONS = {
    "computed": "responses computed from the reference cube: no registration error, no noise",
    "noise": "computed responses with the cameras' noise added",
    "real": "responses as captured and registered",
    **{f"shift {s:g}": f"as captured, the reference shifted by {s:g} px" for s in SHIFTS_PX},
    **{f"exposure {e:g}": f"as captured, the test exposed {e:g} times" for e in EXPOSURES},
}
"""Key → meaning; shifts and exposures of one experiment each."""

Painting = tuple[str, PaintSamples]


@dataclass(frozen=True)
class Budget:
    """RMSE of every method under every condition.

    Parameters
    ----------
    fold : str
        Paintings that were tested.
    rmse : dict of method to dict of condition to float
    position_sigma : float or None
        What registration leaves between the layers, one standard deviation an axis, reference px.
    """

    fold: str
    rmse: dict[str, dict[str, float]]
    position_sigma: float | None

    def slope(self, method: str) -> float | None:
        """Return the growth of RMSE a pixel of shift, by least squares over all shifts."""
        found = self._over_shifts(method)
        return None if found is None else float(np.polyfit(*found, 1)[0])

    def registration_share(self, method: str) -> float | None:
        """Return the share of the mean squared error that registration makes, 0 … 1.

        The squared error grows by a·s² with a shift s; position errors of σ an axis add 2·a·σ².
        """
        found = self._over_shifts(method)
        if found is None or self.position_sigma is None:
            return None
        growth = max(0.0, float(np.polyfit(found[0] ** 2, found[1] ** 2, 1)[0]))
        return min(1.0, 2 * growth * self.position_sigma**2 / self.rmse[method]["real"] ** 2)

    def _over_shifts(self, method: str) -> tuple[np.ndarray, np.ndarray] | None:
        row = self.rmse[method]
        known = [(0.0, row.get("real")), *((s, row.get(f"shift {s:g}")) for s in SHIFTS_PX)]
        pairs = [(s, e) for s, e in known if e is not None]
        return (
            None
            if len(pairs) < 2
            else (np.array([s for s, _ in pairs]), np.array([e for _, e in pairs]))
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the record for programs."""
        return {
            "tested": self.fold,
            "position_sigma_px": self.position_sigma,
            "rows": [
                {
                    "method": method,
                    "rmse": row,
                    "slope_per_px": self.slope(method),
                    "registration_share": self.registration_share(method),
                }
                for method, row in self.rmse.items()
            ],
        }


def measure_budget(
    source: SampleSource,
    train: Sequence[Painting],
    test: Sequence[Painting],
    methods: Sequence[EstimationMethod],
    seed: int,
    position_sigma: float | None,
) -> Budget:
    """Fit and score every method under every condition.

    Parameters
    ----------
    source : SampleSource
    train, test : sequence of (name, PaintSamples)
        Paintings on either side of a split.
    methods : sequence of EstimationMethod
    seed : int
        Of noise, and of the choice of training samples.
    position_sigma : float or None
        As of `Budget`.
    """
    train, test = (
        [_with_neighbours(source, p) for p in train],
        [_with_neighbours(source, p) for p in test],
    )
    sensitivities = effective_sensitivities([samples for _, samples in train])
    variants: dict[str, Callable[[Painting], PaintSamples]] = {
        "computed": lambda painting: _computed(painting, sensitivities),
        "noise": lambda painting: _noisy(_computed(painting, sensitivities), painting[0], seed),
        "real": lambda painting: painting[1],
        **{f"shift {s:g}": partial(_shifted, source, s) for s in SHIFTS_PX},
    }
    rmse: dict[str, dict[str, float]] = {method.name: {} for method in methods}
    for condition, vary in variants.items():
        chosen = choose_training([vary(p) for p in train], SAMPLES, np.random.default_rng(seed))
        tests = [vary(p) for p in test]

        for method in methods:
            try:
                model = method.fit(chosen, np.random.default_rng(seed))
            except Refused:
                continue  # told where the method is scored
            rmse[method.name][condition] = _error(model, tests)
            if condition == "real":
                for exposure in EXPOSURES:
                    rmse[method.name][f"exposure {exposure:g}"] = _error(model, tests, exposure)
    rows = {name: {c: row[c] for c in CONDITIONS if c in row} for name, row in rmse.items() if row}
    return Budget(", ".join(name for name, _ in test), rows, position_sigma)


def effective_sensitivities(train: Sequence[PaintSamples]) -> np.ndarray:
    """Return the non-negative, smooth sensitivities that make responses of spectra, (channels, bands).

    They hold the light and the scale of the calibration, which tables of sensitivities do not. Non-negative
    least squares, Lawson and Hanson 1974 (10.1137/1.9781611971217).
    """
    from scipy.optimize import nnls

    spectra = np.concatenate([samples.spectra for samples in train])
    responses = np.concatenate([samples.responses for samples in train])
    bands = spectra.shape[1]
    level = SMOOTHNESS * float(np.sqrt(np.square(spectra).sum()))
    bend = np.diff(np.eye(bands), n=2, axis=0) * level
    # R of the QR decomposition has the same solution, and only as many rows as bands.
    q, r = np.linalg.qr(np.vstack([spectra, bend]))
    return np.stack([nnls(r, q[: len(spectra)].T @ response)[0] for response in responses.T])


def _with_neighbours(source: SampleSource, painting: Painting) -> Painting:
    """Keep paint whose neighbours, as far as the reference is shifted, were seen."""
    name, samples = painting
    good = ~samples.gold
    for shift in SHIFTS_PX:
        good &= np.isfinite(source.shifted_spectra(name, samples, shift)).all(1)
    return name, samples.take(good)


def _computed(painting: Painting, sensitivities: np.ndarray) -> PaintSamples:
    return replace(painting[1], responses=painting[1].spectra @ sensitivities.T)


def _noisy(samples: PaintSamples, name: str, seed: int) -> PaintSamples:
    if samples.response_sigma is None:
        return samples
    rng = np.random.default_rng([seed, *name.encode()])
    noise = rng.standard_normal(samples.responses.shape) * samples.response_sigma
    return replace(samples, responses=samples.responses + noise)


def _shifted(source: SampleSource, shift_px: float, painting: Painting) -> PaintSamples:
    return replace(painting[1], spectra=source.shifted_spectra(*painting, shift_px))


def _error(model: Model, tests: Sequence[PaintSamples], exposure: float = 1.0) -> float:
    """Return RMSE over pixels and bands; of another exposure, in units of the original one."""
    squared = [
        np.square(model(exposure * samples.responses)[0] / exposure - samples.spectra)
        for samples in tests
    ]
    return float(np.sqrt(np.concatenate(squared).mean()))
