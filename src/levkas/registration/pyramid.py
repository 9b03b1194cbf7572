"""From a start to a map that shows most: coarse to fine, freely, and stiffly where that is poor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.problems import Problem
from levkas.registration.chromatic import Chromatic, fit_chromatic, still
from levkas.registration.corroboration import corroborate, reduction
from levkas.registration.given import HAND_PX, Given
from levkas.registration.initial import Start, plausible
from levkas.registration.ladder import Rung, climb
from levkas.registration.models import Observations
from levkas.registration.prediction import Scene, cell_px, compared, sampled
from levkas.registration.record import RegistrationRefused
from levkas.registration.refinement import Windows
from levkas.registration.sampling import highpass
from levkas.transforms import Affine, Composed, Transform

if TYPE_CHECKING:
    from levkas.registration.images import BandImage

COARSE_BANDS = 4
ROUNDS = 2
STIFF_ROUNDS = 4
LARGE_PX = 600_000
LEAST_CELLS = 5
LEAST_WINDOWS = 12
PARTLY = 0.8
GOOD_PX = 0.25


@dataclass(frozen=True)
class Task:
    """One sensor to be refined.

    Parameters
    ----------
    bands : sequence of BandImage
        In the order of their wavelengths.
    images : mapping of label to ndarray
        As `images_of` gives them.
    scene : Scene
    within : ndarray of bool, reference px
        Where the object lies.
    found : Start
    given : Given
        Pairs by hand.
    """

    bands: Sequence[BandImage]
    images: Mapping[str, np.ndarray]
    scene: Scene
    within: np.ndarray
    found: Start
    given: Given

    @cached_property
    def scale(self) -> float:
        """Native px per reference px."""
        return _scale(self.found.transform, self.scene.shape)

    def sampled(self, band: BandImage, transform: Transform, step: int) -> np.ndarray:
        """Return a band on the grid of `step` reference px; blocks of about one reference px."""
        size = (self.scene.shape[0] // step, self.scene.shape[1] // step)
        block = max(1, round(self.scale / 1.2))
        return sampled(self.images[band.label], transform, size, step, block=block)

    def look(
        self, bands: Sequence[BandImage], own: Sequence[Transform], base: Transform, step: int
    ) -> list[Windows]:
        """Return what windows of each band see."""
        predictor = self.scene.predictor(step)
        return [
            compared(predictor, self.sampled(band, Composed(before, base), step))
            for band, before in zip(bands, own, strict=True)
        ]


@dataclass(frozen=True)
class Refined:
    """What one way of refining a start came to.

    Parameters
    ----------
    base : Transform
    step : int
        Reference px per px of the grid on which it was compared.
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
    """

    base: Transform
    step: int
    model: Chromatic
    rung: Rung
    seen: list[Windows]
    climbs: list[dict[str, Any]]
    evidence: dict[str, float]
    borne_out: dict[str, Any]

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
    for at in [step] * (STIFF_ROUNDS if stiff else ROUNDS) if small else [2 * step, step]:
        here = task.look(bands, [model.transform(i) for i in range(len(bands))], base, at)
        rung = _base(task, base, here, at, stiff=stiff, ledge=at == step)
        climbs.append(_climb(rung, at))
        _check(rung, task)
        if len(bands) > 1:
            moved = _correction(base, rung.transform, here[0].centres)
            model = fit_chromatic(here, model, [band.wavelength for band in bands], common=moved)
        base = rung.transform
    best = max(range(len(bands)), key=lambda i: float(here[i].r2.mean()))

    def weigh() -> dict[str, float]:
        image = task.sampled(bands[best], Composed(model.transform(best), base), step)
        return _evidence(scene, image, here[best], step)

    evidence = weigh()
    for _ in range(ROUNDS):
        believed = _believed(here[best], evidence["chance_r2"])
        if believed.sum() > PARTLY * _usable(here[best].information).sum():
            break
        # Something covers the object: what is seen there says nothing of where the object lies.
        rung = _base(task, base, here, step, stiff=True, among=believed)
        climbs.append(_climb(rung, step))
        _check(rung, task)
        base = rung.transform
        here = task.look(bands, [model.transform(i) for i in range(len(bands))], base, step)
        evidence = weigh()
    borne_out = _corroborate(task, bands[best], Composed(model.transform(best), base), step)
    return Refined(base, step, model, rung, here, climbs, evidence, borne_out)


def _approach(task: Task, climbs: list[dict[str, Any]], *, stiff: bool) -> tuple[Transform, int]:
    """Refine the start from coarse to fine; return the base map and the step that shows most.

    Fine grids of oversampled or noisy pictures know less than coarser ones, which average: the
    information of the windows tells.
    """
    bands, finest = _spread(task.bands, COARSE_BANDS), max(1, round(0.9 / task.scale))
    base = _stiffened(task.found) if stiff else task.found.transform
    step, known = finest, -np.inf
    identity = [Affine.identity()] * len(bands)
    for finer in steps_of(task.scene.shape, finest):
        here = task.look(bands, identity, base, finer)
        least = (2 if stiff else 1) * LEAST_WINDOWS
        if _usable(combine(here)[1]).sum() < least and finer > finest:
            continue  # too little to see at this size; the key points' map stands
        rung = _base(task, base, here, finer, coarse=True, stiff=stiff)
        climbs.append(_climb(rung, finer))
        if rung.knowledge < known:
            return base, step
        _check(rung, task)
        base, step, known = rung.transform, finer, rung.knowledge
    return base, step


def _stiffened(found: Start) -> Transform:
    """Return the similarity, homography or lens that the kept key points are nearest to."""
    p, q = found.reference[found.kept], found.target[found.kept]
    alike = np.broadcast_to(np.eye(2), (len(p), 2, 2))
    observed = Observations(p, q, found.transform.jacobian(p), alike)
    return climb(observed, spacing=1.0, reaching=True).transform if len(p) >= 6 else found.transform


def _climb(rung: Rung, step: int) -> dict[str, Any]:
    """What the ladder saw in one step: held-out error of every model, reference px."""
    return {
        "step": step,
        "windows": len(rung.observations),
        "model": rung.name,
        "held_out_px": {name: round(float(score), 5) for name, score in rung.scores.items()},
    }


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


def _evidence(scene: Scene, image: np.ndarray, seen: Windows, step: int) -> dict[str, float]:
    """Compare what is explained with what a frame shifted by a third explains by chance."""
    predictor = scene.predictor(step)
    used = np.trace(seen.information, axis1=1, axis2=2) > 0
    able = predictor.counts.reshape(-1) > 0
    away = np.roll(image, (image.shape[0] // 3, image.shape[1] // 3), (0, 1))
    chance = compared(predictor, away)
    null = chance.r2[np.trace(chance.information, axis1=1, axis2=2) > 0]
    level = float(np.quantile(null, 0.95)) if len(null) >= 10 else 0.5
    return {
        "share_above_chance": float((seen.r2[used] > level).mean()) if used.any() else 0.0,
        "cover": float(used.sum() / max(able.sum(), 1)),
        "chance_r2": level,
    }


def _believed(seen: Windows, chance: float) -> np.ndarray:
    """Tell which windows lie where most of their neighbours are predicted beyond chance, (n,)."""
    from scipy.spatial import cKDTree

    used = _usable(seen.information)
    above = (seen.r2 > chance).astype(float)
    near = cKDTree(seen.centres[used]).query(seen.centres, k=min(9, int(used.sum())))[1]
    believed = used & (above[used][near].reshape(len(used), -1).mean(1) > 0.5)
    return believed if believed.sum() >= LEAST_WINDOWS else used


def _corroborate(task: Task, band: BandImage, transform: Transform, step: int) -> dict[str, Any]:
    step *= reduction(task.scene.shape, step)
    image = highpass(task.sampled(band, transform, step))
    predictors = task.scene.predictor(step).images
    valid = np.isfinite(task.images[band.label])
    return corroborate(predictors, image, step, transform, task.within, valid)


def _scale(base: Transform, shape: tuple[int, int]) -> float:
    x, y = np.meshgrid(np.linspace(0.1, 0.9, 5) * shape[1], np.linspace(0.1, 0.9, 5) * shape[0])
    jacobian = base.jacobian(np.stack([x, y], -1).reshape(-1, 2))
    return float(np.sqrt(np.median(np.abs(np.linalg.det(jacobian)))))


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


def combine(seen: Sequence[Windows]) -> tuple[np.ndarray, np.ndarray]:
    """Return the shift of each window that all bands agree on, (n, 2), and its information.

    Bands are weighted by what they know; one that contradicts the others is turned down.
    """
    shifts = np.stack([w.shift for w in seen])
    information = np.stack([w.information for w in seen])
    weights = np.ones(shifts.shape[:2])
    for _ in range(4 if len(seen) > 2 else 1):
        scaled = information * weights[..., None, None]
        total = scaled.sum(0)
        common = np.einsum(
            "nab,nb->na",
            np.linalg.inv(total + 1e-9 * np.eye(2)),
            np.einsum("bnac,bnc->na", scaled, shifts),
        )
        apart = shifts - common
        distance = np.einsum("bna,bnac,bnc->bn", apart, information, apart)
        used = np.trace(information, axis1=2, axis2=3) > 0
        typical = np.median(distance[used]) / 1.386 + 1e-12 if used.any() else 1.0
        weights = 1 / (1 + distance / (4 * typical))
    return common, total


def _usable(information: np.ndarray) -> np.ndarray:
    return np.asarray(np.trace(information, axis1=1, axis2=2) > 0)


def _base(
    task: Task,
    base: Transform,
    seen: Sequence[Windows],
    step: int,
    *,
    coarse: bool = False,
    stiff: bool = False,
    among: np.ndarray | None = None,
    ledge: bool = False,
) -> Rung:
    common, information = combine(seen)
    centres = seen[0].centres
    used = _usable(information) & (True if among is None else among)
    if used.sum() < LEAST_WINDOWS:
        raise RegistrationRefused(
            Problem(
                "E_WINDOWS",
                "too few windows of this sensor can be compared with the reference",
                found=int(used.sum()),
                expected=f"at least {LEAST_WINDOWS}",
                fix="The frames overlap too little, or the picture is too small.",
            )
        )
    points = centres[used]
    jacobian = base.jacobian(points)
    target = base(points) - np.einsum("nab,nb->na", jacobian, common[used])
    finite = np.isfinite(target).all(1)
    observations = Observations(points, target, jacobian, information[used]).part(finite)
    hand = _by_hand(task.given.sure, base)
    cell = float(task.scene.predictor(step).cell * step) if ledge else 0.0
    return climb(
        observations.joined(hand), spacing=4.0 * step * cell_px((0, 0)), cell=cell, coarse=coarse,
        reaching=stiff, sure=len(hand),
    )  # fmt: skip


def _by_hand(pairs: np.ndarray, base: Transform) -> Observations:
    """Given pairs as observations: they weigh as a place that a person points at is known."""
    jacobian = base.jacobian(pairs[:, :2])
    # A hand errs in either picture: by a px of the coarser one.
    scale = np.sqrt(np.abs(np.linalg.det(jacobian)))
    known = 1 / (HAND_PX**2 * (1 + 1 / np.maximum(scale, 1e-6) ** 2))
    information = known[:, None, None] * np.eye(2)
    finite = np.isfinite(jacobian).all((1, 2)) & np.isfinite(known)
    return Observations(pairs[:, :2], pairs[:, 2:], jacobian, information).part(finite)


def _correction(before: Transform, after: Transform, centres: np.ndarray) -> np.ndarray:
    """Shift, reference px, that the step from one base map to the next takes care of."""
    miss = before(centres) - after(centres)
    return np.linalg.solve(before.jacobian(centres), miss[..., None])[..., 0]
