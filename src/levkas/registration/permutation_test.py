"""How far a refined map is believed: what it explains beyond chance, where, and what bears it out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.geometry.transforms import Transform
from levkas.registration.local_shifts import Windows
from levkas.registration.predictors import LEAST_BANDS, compared
from levkas.registration.sampling import highpass
from levkas.registration.task import Task
from levkas.registration.verification import corroborate, reduction
from levkas.registration.window_fusion import usable

if TYPE_CHECKING:
    from levkas.registration.checks import Checks
    from levkas.registration.images import BandImage

#: Of the windows; fewer that are predicted beyond chance are only part of the object.
PARTLY = 0.8
#: Correlation of the detail of two channels that are one grey picture.
GREY = 0.98


@dataclass(frozen=True)
class Belief:
    """How far one band is predicted, on a grid about as fine as its picture.

    Parameters
    ----------
    seen : Windows
        Through the map that is judged.
    chance : float, 0..1
        What 19 of 20 windows that cannot match stay below in `seen.r2`.
    evidence : dict
        ``share_above_chance`` of the windows, ``cover`` of the reference, ``chance_r2``.
    """

    seen: Windows
    chance: float
    evidence: dict[str, float]

    @property
    def partly(self) -> bool:
        """Whether windows that chance explains lie together: something covers the object."""
        used = usable(self.seen.information)
        return bool(self.around(self.seen.centres)[used].sum() <= PARTLY * used.sum())

    @property
    def predicted(self) -> np.ndarray:
        """Centres, (n, 2) reference px, of usable windows that are predicted beyond chance as most near are."""
        used = usable(self.seen.information)
        return np.asarray(self.seen.centres[used & self.around(self.seen.centres)])

    def around(self, centres: np.ndarray) -> np.ndarray:
        """Tell at which places, (n, 2) reference px, most windows near are predicted beyond chance."""
        from scipy.spatial import cKDTree

        used = usable(self.seen.information)
        if not used.any():
            return np.zeros(len(centres), bool)
        above = (self.seen.r2[used] > self.chance).astype(float)
        near = cKDTree(self.seen.centres[used]).query(centres, k=min(9, int(used.sum())))[1]
        return np.asarray(above[near].reshape(len(centres), -1).mean(1) > 0.5)


def weigh(task: Task, band: BandImage, transform: Transform, step: int) -> Belief:
    """Compare what is explained with what a frame shifted by a third explains by chance.

    Parameters
    ----------
    task : Task
    band : BandImage
    transform : Transform
        Reference px → native px of the band.
    step : int
        Reference px per px of the grid.
    """
    predictor = task.scene.predictor(step)
    image = task.sampled(band, transform, step)
    seen = compared(predictor, image)
    used, able = usable(seen.information), predictor.counts.reshape(-1) > 0
    away = np.roll(image, (image.shape[0] // 3, image.shape[1] // 3), (0, 1))
    by_chance = compared(predictor, away)
    null = by_chance.r2[usable(by_chance.information)]
    level = float(np.quantile(null, 0.95)) if len(null) >= 10 else 0.5
    evidence = {
        "share_above_chance": float((seen.r2[used] > level).mean()) if used.any() else 0.0,
        "cover": float(used.sum() / max(able.sum(), 1)),
        "chance_r2": level,
    }
    return Belief(seen, level, evidence)


def bear_out(
    task: Task, band: BandImage, transform: Transform, step: int, belief: Belief
) -> tuple[dict[str, Any], Checks]:
    """Return what `corroborate` measures of a map, on a grid of `step` reference px or coarser.

    `belief` is of the same map, on the grid of `step`.
    """
    there = belief.predicted
    cell = float(task.scene.predictor(step).cell * step)
    step *= reduction(task.scene.shape, step)
    image = highpass(task.sampled(band, transform, step))
    predictors = task.scene.predictor(step).images
    valid = np.isfinite(task.images[band.label])
    return corroborate(predictors, image, step, transform, task.within, valid, there, cell)


def sees_alike(task: Task, band: BandImage, transform: Transform, step: int) -> bool:
    """Tell whether a band sees light that the reference sees too, so that little of it may be missed there.

    Its wavelength says so. Where it has none, the band of a colour camera does: one of three or more whose
    detail is not the same throughout, as that of a grey picture stored as colours is.
    """
    if np.isfinite(band.wavelength):
        return task.scene.sees(band.wavelength)
    if min(len(task.bands), task.scene.count) < LEAST_BANDS:
        return False
    mine = highpass(task.sampled(band, transform, step))
    for other in (task.bands[0], task.bands[-1]):
        theirs = highpass(task.sampled(other, transform, step))
        both = np.isfinite(mine) & np.isfinite(theirs)
        if both.any() and np.corrcoef(mine[both], theirs[both])[0, 1] < GREY:
            return True
    return False
