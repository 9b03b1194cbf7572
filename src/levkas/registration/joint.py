"""Several captures by one camera, adjusted together on the frame of each.

A camera looks at every painting through the same lens, and a rig that stands still looks from the same
place. What others of its captures saw is laid on the frame of one of them by a homography each (the
paintings may lie anywhere), and one map is fitted to all of it and to what this capture saw. That map
takes part in the ladder of the capture as one model more, also behind plain ones for how this painting
lies: it is taken only where it predicts blocks of this very capture, left out of the fit, better than
all that the capture found alone. What sets the bands apart is shared as `shared_colour` says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from levkas.geometry.depth_step import LedgeShift
from levkas.geometry.transforms import Composed, Transform
from levkas.registration.cross_validation import Fit
from levkas.registration.model_selection import MOST_JUDGED, RUNGS, Rung, climb
from levkas.registration.models import Observations, fit_projective
from levkas.registration.pooled_chromatic import share

if TYPE_CHECKING:
    from levkas.registration.chromatic import Chromatic
    from levkas.registration.observations import Sighting

ROUNDS = 2
#: A homography that leaves more, reference px, joins what was not seen from one place.
SAME_PLACE_PX = 0.5
#: Blocks in which two captures are compared. Windows overlap, so that chance alone reaches 2.7; panels
#: of other depth and curvature reach 2.8 to 90, and what they share is not worth what they differ by.
BLOCKS, LEAST_IN_BLOCK, LEAST_BLOCKS, MOST_EXCESS = 6, 4, 6, 2.75
#: A map says little beyond what it was fitted to: so much of its extent.
RIM = 0.1
#: Turned or scaled by more, colour does not lie in the same directions.
SAME_POSE = 0.02


@dataclass(frozen=True)
class Adjusted:
    """A sensor of one capture after it was adjusted with others.

    Parameters
    ----------
    base : Transform
    chromatic : Chromatic
    rung : Rung or None
        The ladder with the rig's map in it; None for the reference's own sensor.
    behind : Rung or None
        The rig's own map, where it was taken.
    mates : tuple of int
        Which of the others took part.
    """

    base: Transform
    chromatic: Chromatic
    rung: Rung | None
    behind: Rung | None
    mates: tuple[int, ...]


def adjust(mine: Sighting, others: Sequence[Sighting]) -> Adjusted:
    """Adjust one sensor of a capture with what other captures saw of the same sensor.

    Parameters
    ----------
    mine : Sighting
    others : sequence of Sighting
        Of the same sensor, other objects or other lightings.

    Returns
    -------
    adjusted : Adjusted
        As it was, where no other is of the same rig or none makes it better.
    """
    if mine.seen is None or mine.terms is None:
        alike = [k for k, other in enumerate(others) if _same_bands(mine, other)]
        shared = share([mine.chromatic, *(others[k].chromatic for k in alike)])
        return Adjusted(mine.base, shared, None, None, tuple(alike))
    laid = [_laid(mine, other, _smooth(mine.base)) for other in others]
    posed = [k for k, one in enumerate(laid) if _same_bands(mine, others[k]) and _alike(one)]
    mates = [k for k, one in enumerate(laid) if one is not None and one.excess < MOST_EXCESS]
    shared = share([mine.chromatic, *(others[k].chromatic for k in posed)])
    if not mates:
        return Adjusted(mine.base, shared, None, None, tuple(posed))
    pooled, whole = _pool(mine, [others[k] for k in mates])
    terms = mine.terms
    rung = climb(
        mine.seen, spacing=terms.spacing, apart=terms.apart, cell=terms.cell,
        reaching=terms.reaching, sure=terms.sure, rig=whole,
    )  # fmt: skip
    if not rung.name.startswith("rig"):
        return Adjusted(mine.base, shared, None, None, tuple(posed))
    return Adjusted(rung.transform, shared, rung, pooled, tuple(sorted({*mates, *posed})))


def _pool(mine: Sighting, mates: Sequence[Sighting]) -> tuple[Rung, _Together]:
    """Fit one map to what all saw, each laid on the frame of `mine`; return it, and how it is fitted."""
    assert mine.terms is not None and mine.seen is not None
    rig, found = _smooth(mine.base), None
    for _ in range(ROUNDS):
        laid = [one.seen for mate in mates if (one := _laid(mine, mate, rig)) is not None]
        others = [_thinned(seen) for seen in laid]
        whole = _thinned(_lowered(mine))
        for seen in others:
            whole = whole.joined(seen)
        rung = climb(whole, spacing=mine.terms.spacing, apart=mine.terms.apart)
        rig = rung.transform
        if others and rung.fit is not None:
            found = rung, _Together(others, rung.fit)
    assert found is not None
    return found


class _Together:
    """Fits a map to observations and to those of others; what it was asked last it remembers."""

    def __init__(self, others: Sequence[Observations], fit: Fit) -> None:
        self._others, self._fit = others[0], fit
        for one in others[1:]:
            self._others = self._others.joined(one)
        self._known: dict[bytes, Transform] = {}

    def __call__(self, observations: Observations) -> Transform:
        key = observations.points.tobytes()
        if key not in self._known:
            self._known[key] = self._fit(observations.joined(self._others))
        return self._known[key]


def _thinned(seen: Observations) -> Observations:
    """At most some thousand windows, which know as much together as all of them."""
    every = 1 + len(seen) // MOST_JUDGED
    part = seen.part(np.arange(len(seen)) % every == 0)
    return part.weighted(np.full(len(part), float(every)))


def _lowered(one: Sighting) -> Observations:
    """What was seen, as a painting without its ledge would have shown it."""
    assert one.seen is not None
    steps = one.base.steps if isinstance(one.base, Composed) else ()
    if steps and isinstance(steps[0], LedgeShift):
        return replace(one.seen, points=steps[0](one.seen.points))
    return one.seen


@dataclass(frozen=True)
class _Laid:
    """What a mate saw, on another frame; `moved` by how much that is turned and scaled."""

    seen: Observations
    moved: float
    excess: float


def _laid(mine: Sighting, mate: Sighting, rig: Transform) -> _Laid | None:
    """Lay what a mate saw on the frame of `mine`; None where that cannot be of the same rig."""
    if mate.seen is None or len(mate.seen) < RUNGS["homography"][0]:
        return None
    seen = _lowered(mate)
    with np.errstate(all="ignore"):
        places = rig.inverse(seen.target)
    known = _within(mine, places)
    if known.sum() < RUNGS["homography"][0]:
        return None
    seen = seen.part(known)
    alike = np.broadcast_to(np.eye(2), (len(seen), 2, 2))
    there = replace(seen, target=places[known], jacobian=alike)
    lay = fit_projective(there, lens=False)
    left = np.linalg.norm(there.residuals(lay), axis=1)
    if not np.median(left) < SAME_PLACE_PX:
        return None
    middle = seen.points.mean(0, keepdims=True)
    moved = float(np.abs(lay.jacobian(middle)[0] - np.eye(2)).max())
    laid = replace(seen, points=lay(seen.points))
    excess = _excess(_lowered(mine), laid)
    trusted = laid.weighted(np.full(len(laid), 1 / max(excess, 1.0)))
    return _Laid(trusted, moved, excess)


def _excess(mine: Observations, laid: Observations) -> float:
    """Return the variance of what two captures see apart in the same places, over that of chance.

    Both are compared in blocks with one map that is fitted to both: a lens bends them alike, and a panel
    of another shape shows as places where they differ by more than their windows scatter.
    """
    both = fit_projective(mine.joined(laid), lens=True)
    low, high = mine.points.min(0), mine.points.max(0)
    side = max(float((high - low).max()) / BLOCKS, 1e-9)
    apart = []
    mine_in, laid_in = (np.floor((seen.points - low) / side).astype(int) for seen in (mine, laid))
    left, theirs = mine.residuals(both), laid.residuals(both)
    for block in np.unique(mine_in, axis=0):
        here, there = (mine_in == block).all(1), (laid_in == block).all(1)
        if min(here.sum(), there.sum()) < LEAST_IN_BLOCK:
            continue
        mean, variance = _mean(left[here], mine.information[here])
        other, more = _mean(theirs[there], laid.information[there])
        difference = other - mean
        apart.append(difference @ np.linalg.solve(variance + more, difference) / 2)
    return float(np.mean(apart)) if len(apart) >= LEAST_BLOCKS else np.inf


def _mean(values: np.ndarray, information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted mean, (2,), and its covariance."""
    variance = np.linalg.inv(information.sum(0) + 1e-12 * np.eye(2))
    return variance @ np.einsum("nab,nb->a", information, values), variance


def _within(mine: Sighting, places: np.ndarray) -> np.ndarray:
    """Tell which places lie where `mine` saw anything, or a little beyond."""
    assert mine.seen is not None
    low, high = mine.seen.points.min(0), mine.seen.points.max(0)
    rim = RIM * (high - low)
    with np.errstate(invalid="ignore"):
        return np.asarray(((places >= low - rim) & (places <= high + rim)).all(1))


def _smooth(base: Transform) -> Transform:
    """A base map without the term of a ledge: that is the painting's, not the rig's."""
    if isinstance(base, Composed) and isinstance(base.steps[0], LedgeShift):
        return Composed(*base.steps[1:])
    return base


def _alike(laid: _Laid | None) -> bool:
    return laid is not None and laid.moved < SAME_POSE


def _same_bands(mine: Sighting, other: Sighting) -> bool:
    a, b = mine.chromatic, other.chromatic
    same = a.spread == b.spread and np.array_equal(a.centre, b.centre)
    return len(mine.labels) > 1 and mine.labels == other.labels and same
