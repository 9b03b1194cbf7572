"""Joint adjustment: several captures by one camera, adjusted together on the frame of each.

A camera looks at every painting through the same lens, and a stand that is not moved looks from the same
place. What others of its captures observed is transferred to the frame of one of them by a homography each
(the paintings may lie anywhere), and one map is fitted to all of it and to what this capture observed.
That shared map is one more model in the selection for the capture, also behind plain ones for how this
painting lies: it is taken only where it predicts blocks of this very capture, left out of the fit, better
than all that the capture found alone. Chromatic shifts are pooled with those of captures in the same pose.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from levkas.geometry import from_dict
from levkas.geometry.transforms import Affine, Composed, Inverse, Transform
from levkas.registration.chromatic import ChromaticShifts, pool_chromatic
from levkas.registration.depth_step import depth_step_of
from levkas.registration.model_selection import (
    HOMOGRAPHY,
    MODELS,
    Fit,
    SelectedModel,
    SelectionTerms,
    select_model,
)
from levkas.registration.model_selection import SETTINGS as SELECTION
from levkas.registration.models import Observations, fit_projective


@dataclass(frozen=True)
class JointSettings:
    """Constants of the joint adjustment.

    Parameters
    ----------
    rounds : int
        Of transferring the others' observations and fitting the shared map.
    same_place : float, reference px
        A homography that leaves more joins captures that were not taken from one place.
    blocks, least_in_block, least_blocks : int
        Blocks across in which two captures are compared; windows in a block; blocks.
    most_excess : float
        Variance between two captures over that of chance up to which they are joined. Windows overlap, so
        that chance alone reaches 2.7; panels of other depth and curvature reach 2.8 to 90, and what they
        share is not worth what they differ by.
    rim : float
        Share of its extent by which a map is evaluated beyond what it was fitted to.
    same_pose : float
        Captures turned or scaled by more have their chromatic shifts in other directions.
    """

    rounds: int = 2
    same_place: float = 0.5
    blocks: int = 6
    least_in_block: int = 4
    least_blocks: int = 6
    most_excess: float = 2.75
    rim: float = 0.1
    same_pose: float = 0.02


SETTINGS = JointSettings()
_OBSERVED = ("points", "target", "jacobian", "information")


@dataclass(frozen=True)
class SensorObservations:
    """One sensor of one capture, as its own registration left it; outlives the pictures.

    Parameters
    ----------
    sensor : str
    labels : tuple of str
        Its bands, in the order of `chromatic`.
    base : Transform
        Reference px → native px, without chromatic shifts.
    chromatic : ChromaticShifts
    held_out : float, reference px
        Error of `base` in blocks that it was not fitted to; 0 where nothing was fitted.
    observations : Observations or None
        What `base` was fitted to; None for the reference's own sensor.
    terms : SelectionTerms
        On which it was fitted.
    lines : Transform, optional
        Native px, lines put right → native px, where lines of this capture are displaced; `base` and `observations` end before it.
    """

    sensor: str
    labels: tuple[str, ...]
    base: Transform
    chromatic: ChromaticShifts
    held_out: float = 0.0
    observations: Observations | None = None
    terms: SelectionTerms = field(default_factory=SelectionTerms)
    lines: Transform | None = None

    @classmethod
    def of_reference(
        cls, sensor: str, labels: tuple[str, ...], chromatic: ChromaticShifts
    ) -> SensorObservations:
        """Return those of the reference's own sensor, which has no base map."""
        return cls(sensor, labels, Affine.identity(), chromatic)

    def enlarged(self, grow: Affine) -> SensorObservations:
        """Return the observations in larger native px: `grow` maps those of now to them."""
        if self.observations is None:
            return self
        jacobian = np.einsum("ab,nbc->nac", grow.matrix[:, :2], self.observations.jacobian)
        observations = replace(
            self.observations, target=grow(self.observations.target), jacobian=jacobian
        )
        lines = self.lines and Composed(Inverse(grow), self.lines, grow)
        return replace(self, base=Composed(self.base, grow), observations=observations, lines=lines)

    def without_depth_step(self) -> Observations:
        """Return what was observed as a painting without its step in depth would have shown it."""
        assert self.observations is not None
        step, _ = depth_step_of(self.base)
        return (
            self.observations
            if step is None
            else replace(self.observations, points=step(self.observations.points))
        )

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return arrays that hold all of it."""
        c = self.chromatic
        fields = {
            "sensor": self.sensor,
            "labels": self.labels,
            "base": self.base.to_dict(),
            "kind": c.kind,
            "spread": c.spread,
            "held_out": self.held_out,
            "terms": asdict(self.terms),
            "lines": self.lines and self.lines.to_dict(),
        }
        arrays = {"fields": np.array(json.dumps(fields)), "centre": c.centre, "amounts": c.amounts}
        if c.variances is not None:
            arrays["variances"] = c.variances
        if self.observations is not None:
            arrays |= {name: getattr(self.observations, name) for name in _OBSERVED}
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> SensorObservations:
        """Read what `to_arrays` gave; raises KeyError or ValueError on anything else."""
        fields = json.loads(str(arrays["fields"]))
        chromatic = ChromaticShifts(
            fields["kind"], arrays["centre"], fields["spread"], arrays["amounts"],
            arrays.get("variances"),
        )  # fmt: skip
        observations = (
            Observations(*(arrays[name] for name in _OBSERVED)) if "points" in arrays else None
        )
        return cls(
            fields["sensor"], tuple(fields["labels"]), from_dict(fields["base"]), chromatic,
            fields["held_out"], observations, SelectionTerms(**fields["terms"]),
            fields["lines"] and from_dict(fields["lines"]),
        )  # fmt: skip


@dataclass(frozen=True)
class JointResult:
    """A sensor of one capture after it was adjusted with others.

    Parameters
    ----------
    base : Transform
    chromatic : ChromaticShifts
    selected : SelectedModel or None
        The selection with the shared map in it; None where that was not taken.
    shared : SelectedModel or None
        The shared map itself, where it was taken.
    companions : tuple of int
        Which of the others took part.
    """

    base: Transform
    chromatic: ChromaticShifts
    selected: SelectedModel | None
    shared: SelectedModel | None
    companions: tuple[int, ...]


def adjust_jointly(mine: SensorObservations, others: Sequence[SensorObservations]) -> JointResult:
    """Adjust one sensor of a capture with what other captures observed with the same sensor.

    Parameters
    ----------
    mine : SensorObservations
    others : sequence of SensorObservations
        Of the same sensor, other objects or other lightings.

    Returns
    -------
    adjusted : JointResult
        As it was, where no other was taken from the same place or none makes it better.
    """
    found = _adjust(mine, others)
    return found if mine.lines is None else replace(found, base=Composed(found.base, mine.lines))


def _adjust(mine: SensorObservations, others: Sequence[SensorObservations]) -> JointResult:
    """Adjust it as `adjust_jointly` does; the base ends before displaced lines."""
    if mine.observations is None:
        posed = [k for k, other in enumerate(others) if _have_same_bands(mine, other)]
        pooled = pool_chromatic(mine.chromatic, [others[k].chromatic for k in posed])
        return JointResult(mine.base, pooled, None, None, tuple(posed))
    laid = [_transfer(mine, other, depth_step_of(mine.base)[1]) for other in others]
    posed = [
        k
        for k, one in enumerate(laid)
        if one is not None and one.moved < SETTINGS.same_pose and _have_same_bands(mine, others[k])
    ]
    companions = [
        k for k, one in enumerate(laid) if one is not None and one.excess < SETTINGS.most_excess
    ]
    pooled = pool_chromatic(mine.chromatic, [others[k].chromatic for k in posed])
    alone = JointResult(mine.base, pooled, None, None, tuple(posed))
    if not companions:
        return alone
    shared, fit = _fit_shared(mine, [others[k] for k in companions])
    selected = select_model(mine.observations, mine.terms, shared=fit)
    if selected.spec is None or not selected.spec.shared:
        return alone
    taking_part = tuple(sorted({*companions, *posed}))
    return JointResult(selected.transform, pooled, selected, shared, taking_part)


def _fit_shared(
    mine: SensorObservations, companions: Sequence[SensorObservations]
) -> tuple[SelectedModel, _SharedFit]:
    """Fit one map to all observations, each transferred to the frame of `mine`; return it, and its fit."""
    base, found = depth_step_of(mine.base)[1], None
    terms = SelectionTerms(spacing=mine.terms.spacing, apart=mine.terms.apart)
    for _ in range(SETTINGS.rounds):
        laid = [
            one for companion in companions if (one := _transfer(mine, companion, base)) is not None
        ]
        others = [_thinned(one.observations) for one in laid]
        whole = _thinned(mine.without_depth_step())
        for observations in others:
            whole = whole.joined(observations)
        selected = select_model(whole, terms)
        base = selected.transform
        if others and selected.fit is not None:
            found = selected, _SharedFit(others, selected.fit)
    assert found is not None
    return found


class _SharedFit:
    """Fits one map to observations and to those of others, once for the same observations."""

    def __init__(self, others: Sequence[Observations], fit: Fit) -> None:
        self._others, self._fit = others[0], fit
        for one in others[1:]:
            self._others = self._others.joined(one)
        self._known: dict[bytes, Transform] = {}

    def __call__(self, observations: Observations) -> Transform:
        parts = (observations.points, observations.target, observations.information)
        key = b"".join(part.tobytes() for part in parts)
        if key not in self._known:
            self._known[key] = self._fit(observations.joined(self._others))
        return self._known[key]


def _thinned(observations: Observations) -> Observations:
    """Return at most some thousand windows, with the information of all of them."""
    every = 1 + len(observations) // SELECTION.most_judged
    part = observations.part(np.arange(len(observations)) % every == 0)
    return part.weighted(np.full(len(part), float(every)))


@dataclass(frozen=True)
class _Transferred:
    """Observations of another capture on this frame, how far that is turned and scaled, and their excess."""

    observations: Observations
    moved: float
    excess: float


def _transfer(
    mine: SensorObservations, companion: SensorObservations, base: Transform
) -> _Transferred | None:
    """Transfer a capture's observations to the frame of `mine`; None where it was taken from another place."""
    least = MODELS[HOMOGRAPHY][0]
    if companion.observations is None or len(companion.observations) < least:
        return None
    observations = companion.without_depth_step()
    with np.errstate(all="ignore"):
        places = base.inverse(observations.target)
    known = _is_within(mine, places)
    if known.sum() < least:
        return None
    observations = observations.part(known)
    identity = np.broadcast_to(np.eye(2), (len(observations), 2, 2))
    there = replace(observations, target=places[known], jacobian=identity)
    between = fit_projective(there, lens=False)
    left = np.linalg.norm(there.residuals(between), axis=1)
    if not np.median(left) < SETTINGS.same_place:
        return None
    middle = observations.points.mean(0, keepdims=True)
    moved = float(np.abs(between.jacobian(middle)[0] - np.eye(2)).max())
    laid = replace(observations, points=between(observations.points))
    excess = _excess(mine.without_depth_step(), laid)
    trusted = laid.weighted(np.full(len(laid), 1 / max(excess, 1.0)))
    return _Transferred(trusted, moved, excess)


def _excess(mine: Observations, laid: Observations) -> float:
    """Return the variance between two captures in the same places, over that of chance.

    Both are compared in blocks with one map that is fitted to both: a lens bends them alike, and a panel
    of another shape shows as places where they differ by more than their windows scatter.
    """
    both = fit_projective(mine.joined(laid), lens=True)
    low, high = mine.points.min(0), mine.points.max(0)
    side = max(float((high - low).max()) / SETTINGS.blocks, 1e-9)
    apart = []
    mine_in, laid_in = (np.floor((one.points - low) / side).astype(int) for one in (mine, laid))
    left, theirs = mine.residuals(both), laid.residuals(both)
    for block in np.unique(mine_in, axis=0):
        here, there = (mine_in == block).all(1), (laid_in == block).all(1)
        if min(here.sum(), there.sum()) < SETTINGS.least_in_block:
            continue
        mean, variance = _weighted_mean(left[here], mine.information[here])
        other, more = _weighted_mean(theirs[there], laid.information[there])
        difference = other - mean
        apart.append(difference @ np.linalg.solve(variance + more, difference) / 2)
    return float(np.mean(apart)) if len(apart) >= SETTINGS.least_blocks else np.inf


def _weighted_mean(values: np.ndarray, information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted mean, (2,), and its covariance."""
    variance = np.linalg.inv(information.sum(0) + 1e-12 * np.eye(2))
    return variance @ np.einsum("nab,nb->a", information, values), variance


def _is_within(mine: SensorObservations, places: np.ndarray) -> np.ndarray:
    """Return which places lie where `mine` observed anything, or a little beyond."""
    assert mine.observations is not None
    low, high = mine.observations.points.min(0), mine.observations.points.max(0)
    rim = SETTINGS.rim * (high - low)
    with np.errstate(invalid="ignore"):
        return np.asarray(((places >= low - rim) & (places <= high + rim)).all(1))


def _have_same_bands(mine: SensorObservations, other: SensorObservations) -> bool:
    a, b = mine.chromatic, other.chromatic
    same = a.spread == b.spread and np.array_equal(a.centre, b.centre)
    return len(mine.labels) > 1 and mine.labels == other.labels and same
