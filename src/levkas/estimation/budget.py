"""The error budget of spectral estimation: what metamerism, noise, registration and exposure cost.

The same experiment is run with responses computed from the reference cube itself (perfect registration,
no noise), with the cameras' noise added, and as captured; with the reference shifted by parts of a pixel; and
with another exposure of the test. Every draw trains on a random half of the blocks of the training paintings and
weighs the blocks of the test as the bootstrap does: over draws, numbers scatter as they would over other paintings
of the same paints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from levkas.core.problems import Refused
from levkas.estimation.methods import EstimationMethod, Model
from levkas.estimation.samples import BLOCKS, PaintSamples, SampleSource, training_of
from levkas.estimation.training import Criterion, mean_square, select_training

SHIFTS_PX = (0.25, 0.5, 1.0)
EXPOSURES = (0.5, 2.0)
SAMPLES = 500
"""Training samples of each experiment of the budget."""
DRAWS = 6
"""Of training and test blocks; half-widths of 95 % intervals are known to a third."""
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
    draws : dict of method to dict of condition to tuple of float
        RMSE of every draw; one place holds the same draw under all conditions.
    position_sigma : float or None
        What registration leaves between the layers, one standard deviation an axis, reference px.
    """

    fold: str
    draws: dict[str, dict[str, tuple[float, ...]]]
    position_sigma: float | None = None

    @cached_property
    def rmse(self) -> dict[str, dict[str, float]]:
        """Mean over draws of every method under every condition."""
        return {
            method: {condition: float(np.mean(values)) for condition, values in row.items()}
            for method, row in self.draws.items()
        }

    def interval(self, method: str, condition: str, other: str = "") -> float:
        """Return the half-width of the 95 % interval of an RMSE, or of its difference from another's.

        Training on a random half scatters as much as the whole would from sample to sample, Shao and Wu
        1989 (10.1214/aos/1176347263); Student's t over the draws.

        >>> Budget("a", {"wiener": {"real": (0.02, 0.04)}}).interval("wiener", "real").__round__(3)
        0.18
        """
        from scipy.special import stdtrit

        values = np.array(self.draws[method][condition])
        values = values - np.array(self.draws[method][other]) if other else values
        return float(stdtrit(len(values) - 1, 0.975) * values.std(ddof=1))

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
                    "interval_95": {c: self.interval(method, c) for c in row},
                    "difference_95": {
                        c: self.interval(method, c, "real") for c in row if c != "real"
                    },
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
    *,
    criterion: Criterion = mean_square,
) -> Budget:
    """Fit and score every method under every condition, draw by draw.

    Parameters
    ----------
    source : SampleSource
    train, test : sequence of (name, PaintSamples)
        Paintings on either side of a split.
    methods : sequence of EstimationMethod
    seed : int
        Of noise, and of the choice of blocks and training samples.
    criterion : callable
        As of `Training`.
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
    found: dict[str, dict[str, list[float]]] = {method.name: {} for method in methods}
    for condition, vary in variants.items():
        trained, tests = [vary(p) for p in train], [vary(p) for p in test]
        for draw in range(DRAWS):
            rng = np.random.default_rng([seed, draw])
            halves = [samples.take(_half(samples, rng)) for samples in trained]
            weights = [rng.multinomial(BLOCKS**2, np.full(BLOCKS**2, BLOCKS**-2.0)) for _ in tests]
            chosen = select_training(training_of(halves), SAMPLES, rng)
            chosen = replace(chosen, criterion=criterion)
            for method in methods:
                try:
                    model = method.fit(chosen, np.random.default_rng([seed, draw]))
                except Refused:
                    continue  # stated where the method is scored
                row = found[method.name]
                row.setdefault(condition, []).append(_error(model, tests, weights))
                for exposure in EXPOSURES if condition == "real" else ():
                    error = _error(model, tests, weights, exposure)
                    row.setdefault(f"exposure {exposure:g}", []).append(error)
    rows = {
        name: {c: tuple(row[c]) for c in CONDITIONS if len(row.get(c, ())) == DRAWS}
        for name, row in found.items()
    }
    complete = {name: row for name, row in rows.items() if "real" in row}
    return Budget(", ".join(name for name, _ in test), complete)


def _half(samples: PaintSamples, rng: np.random.Generator) -> np.ndarray:
    """Return which samples lie in a random half of their painting's blocks that have any, (n,) bool."""
    blocks = samples.blocks()
    there = np.unique(blocks)
    return np.asarray(np.isin(blocks, rng.permutation(there)[: -(-len(there) // 2)]))


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
    """Keep paint whose neighbours, as far as the reference is shifted, were measured."""
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


def _error(
    model: Model,
    tests: Sequence[PaintSamples],
    weights: Sequence[np.ndarray],
    exposure: float = 1.0,
) -> float:
    """Return RMSE over pixels, each weighted as its block, and bands; of another exposure in units of the original."""
    squared, counts = 0.0, 0.0
    for samples, of_blocks in zip(tests, weights, strict=True):
        missed = model(exposure * samples.responses)[0] / exposure - samples.spectra
        weight = of_blocks[samples.blocks()]
        squared += float(weight @ np.square(missed).mean(1))
        counts += float(weight.sum())
    return float(np.sqrt(squared / max(counts, 1.0)))
