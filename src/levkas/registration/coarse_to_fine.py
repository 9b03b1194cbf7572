"""From a start to a map that shows most: coarse to fine, freely, and stiffly where that is poor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Problem
from levkas.geometry.transforms import Affine, Composed, Transform
from levkas.registration.chromatic import Chromatic, fit_chromatic, still
from levkas.registration.initial import Start, plausible
from levkas.registration.local_shifts import Windows
from levkas.registration.model_selection import Rung, climb
from levkas.registration.models import Observations
from levkas.registration.permutation_test import PARTLY, bear_out, sees_alike, weigh
from levkas.registration.predictors import cell_px
from levkas.registration.record import RegistrationRefused
from levkas.registration.task import Task
from levkas.registration.window_fusion import (
    LEAST_WINDOWS,
    combine,
    correction,
    fit_base,
    knowledge,
    noted,
    usable,
)

if TYPE_CHECKING:
    from levkas.registration.checks import Checks
    from levkas.registration.images import BandImage

COARSE_BANDS = 4
ROUNDS = 2
STIFF_ROUNDS = 4
MOST_ROUNDS = 8
#: A map that moves less, px of the grid, has settled.
STILL = 0.1
LARGE_PX = 600_000
LEAST_CELLS = 5
GOOD_PX = 0.25
#: By so much more neighbouring windows have to know on a finer grid that a model follows badly.
SHARPER = 8.0


@dataclass(frozen=True)
class Refined:
    """What one way of refining a start came to.

    Parameters
    ----------
    base : Transform
    step : int
        Reference px per px of the grid on which it was judged.
    model : Chromatic
    rung : Rung
    seen : list of Windows
        Shifts that the last round saw, before its correction; one a band.
    climbs : list of dict
        What the ladder saw and took at each step, JSON-ready.
    evidence : dict
        How far its best band is predicted above chance.
    borne_out : dict
        What `corroborate` measured.
    checks : Checks
        The windows that it looked for.
    course : dict
        ``rounds`` that were made, ``settled``: whether the map had come to rest in the last of them,
        ``moved``, reference px: by how much that moved it, the median over windows, ``band`` by which
        it was judged.
    alike : bool
        Whether the band by which it was judged sees light that the reference sees too.
    """

    base: Transform
    step: int
    model: Chromatic
    rung: Rung
    seen: list[Windows]
    climbs: list[dict[str, Any]]
    evidence: dict[str, float]
    borne_out: dict[str, Any]
    checks: Checks
    course: dict[str, Any]
    alike: bool

    @property
    def good(self) -> bool:
        """Whether no other way needs to be tried."""
        near = self.rung.scores[self.rung.name] < GOOD_PX * self.step
        return near and self.evidence["share_above_chance"] > PARTLY


def refine(task: Task) -> Refined:
    """Refine freely, and where that is poor with stiff models too; return what is borne out more.

    Yielding models follow windows that are off, and take the next ones along.

    Raises
    ------
    RegistrationRefused
        ``E_WINDOWS`` or ``E_FOLD``, where neither way comes to an end.
    """
    ways, refused = [], None
    for stiff in (False, True):
        try:
            ways.append(_refine(task, stiff=stiff))
        except RegistrationRefused as refusal:
            refused = refused or refusal
        if ways and ways[0].good:
            break
    if not ways and refused is not None:
        raise refused
    return max(ways, key=lambda way: int(way.borne_out["agreeing"]))


def _refine(task: Task, *, stiff: bool) -> Refined:
    bands, scene = task.bands, task.scene
    climbs: list[dict[str, Any]] = []
    base, step = _approach(task, climbs, stiff=stiff)
    model = still(len(bands), *frame_of(scene.shape))
    small = scene.shape[0] * scene.shape[1] < LARGE_PX * step**2
    # In large frames bands are pixels apart, and a coarser grid brings them near at a quarter of the cost.
    planned = [step] * (STIFF_ROUNDS if stiff else ROUNDS) if small else [2 * step, step]
    rounds = 0
    settled, shift = False, np.inf
    for rounds, at in enumerate(planned + [step] * (MOST_ROUNDS - len(planned)), 1):
        here = task.look(bands, [model.transform(i) for i in range(len(bands))], base, at)
        rung = _settle(task, base, here, at, climbs, stiff=stiff, ledge=at == step)
        moved = correction(base, rung.transform, rung.observations.points)
        if len(bands) > 1:
            common = correction(base, rung.transform, here[0].centres)
            model = fit_chromatic(here, model, [band.wavelength for band in bands], common=common)
        base = rung.transform
        shift = float(np.sqrt(np.median((moved**2).sum(1))))
        settled = shift < STILL * step
        if rounds >= len(planned) and settled:
            break
    best = max(range(len(bands)), key=lambda i: float(here[i].r2.mean()))
    course = {
        "rounds": rounds, "settled": settled, "moved": round(shift, 5), "band": bands[best].label,
    }  # fmt: skip
    judged = max(step, task.plain)
    belief = weigh(task, bands[best], Composed(model.transform(best), base), judged)
    for _ in range(ROUNDS):
        if not belief.partly:
            break
        # Something covers the object: what is seen there says nothing of where the object lies.
        among = belief.around(here[0].centres)
        rung = _settle(task, base, here, step, climbs, stiff=True, among=among)
        base = rung.transform
        here = task.look(bands, [model.transform(i) for i in range(len(bands))], base, step)
        belief = weigh(task, bands[best], Composed(model.transform(best), base), judged)
    borne_out, checks = bear_out(
        task, bands[best], Composed(model.transform(best), base), judged, belief
    )
    return Refined(
        base, judged, model, rung, here, climbs, belief.evidence, borne_out, checks, course,
        sees_alike(task, bands[best], Composed(model.transform(best), base), judged),
    )  # fmt: skip


def _settle(
    task: Task,
    base: Transform,
    here: Sequence[Windows],
    step: int,
    climbs: list[dict[str, Any]],
    **how: Any,
) -> Rung:
    """Fit the base map to what is seen through the one before, note it and check it."""
    rung = fit_base(task, base, here, step, **how)
    climbs.append(noted(rung, step))
    _check(rung, task)
    return rung


def _approach(task: Task, climbs: list[dict[str, Any]], *, stiff: bool) -> tuple[Transform, int]:
    """Refine the start from coarse to fine; return the base map and the step that shows most.

    Fine grids of oversampled or noisy pictures know less than coarser ones, which average: the
    information of the windows tells.
    """
    bands, finest = _spread(task.bands, COARSE_BANDS), task.finest
    base = _stiffened(task.found) if stiff else task.found.transform
    step, known = finest, None
    identity = [Affine.identity()] * len(bands)
    for finer in steps_of(task.scene.shape, finest):
        here = task.look(bands, identity, base, finer)
        least = (2 if stiff else 1) * LEAST_WINDOWS
        if usable(combine(here)[1]).sum() < least and finer > finest:
            continue  # too little to see at this size; the key points' map stands
        rung = fit_base(task, base, here, finer, coarse=True, stiff=stiff)
        climbs.append(noted(rung, finer))
        now = (knowledge(here), rung.knowledge)
        if known is not None and _is_less(now, known):
            return base, step
        _check(rung, task)
        base, step, known = rung.transform, finer, now
    return base, step


def _is_less(now: tuple[float | None, float], before: tuple[float | None, float]) -> bool:
    """Tell whether a finer grid knows less, by how windows lie about the model.

    Unless neighbours know that much more on it: then it is the model that is short, of a ledge say. Windows
    are four times as many there, and have to be twice as sure.
    """
    if now[1] >= before[1]:
        return False
    return now[0] is None or before[0] is None or now[0] < SHARPER * before[0]


def _stiffened(found: Start) -> Transform:
    """Return the similarity, homography or lens that the kept key points are nearest to."""
    p, q = found.reference[found.kept], found.target[found.kept]
    alike = np.broadcast_to(np.eye(2), (len(p), 2, 2))
    observed = Observations(p, q, found.transform.jacobian(p), alike)
    return climb(observed, spacing=1.0, reaching=True).transform if len(p) >= 6 else found.transform


def _check(rung: Rung, task: Task) -> None:
    points = rung.observations.points
    if not plausible(rung.transform, (*points.min(0), *points.max(0)), task.found.mirrored):
        raise RegistrationRefused(
            Problem(
                "E_FOLD",
                "the map of this sensor folds or stretches beyond belief",
                field=task.bands[0].sensor or None,
                fix="Check that both show the same object; give control points if they do.",
            )
        )


def _spread(bands: Sequence[BandImage], most: int) -> list[BandImage]:
    picks = np.unique(np.linspace(0, len(bands) - 1, min(most, len(bands))).round().astype(int))
    return [bands[i] for i in picks]


def frame_of(shape: tuple[int, int]) -> tuple[np.ndarray, float]:
    """Return centre and half the longer side of a frame: coordinates of the chromatic fields."""
    return np.array([shape[1] - 1, shape[0] - 1]) / 2, max(shape) / 2


def steps_of(shape: tuple[int, int], finest: int) -> list[int]:
    """Return the steps of the pyramid from coarse to `finest`; at least five cells across."""
    steps = [finest]
    while min(shape) // (steps[-1] * 2) >= LEAST_CELLS * cell_px((0, 0)) and len(steps) < 4:
        steps.append(steps[-1] * 2)
    return steps[::-1]
