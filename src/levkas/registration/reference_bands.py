"""The reference camera's own bands against its reference band."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.threads import each
from levkas.geometry.transforms import Affine, Transform
from levkas.registration.chromatic import LEAST_WINDOWS, Chromatic, fit_chromatic, still
from levkas.registration.coarse_to_fine import LARGE_PX, frame_of, steps_of
from levkas.registration.local_shifts import Predictor, Windows
from levkas.registration.model_selection import climb
from levkas.registration.models import Observations
from levkas.registration.predictors import all_sampled, cell_px, compared, condense
from levkas.registration.sensors import Sensor, ordered
from levkas.registration.uncertainty import measure_sigma

if TYPE_CHECKING:
    from levkas.registration.images import BandImage

#: Bands that are not yet aligned differ by gradients, and a combination of them passes for a shift.
#: The price of small components falls as they come to mean paint.
RIDGES = (1e-2, 1e-3, 3e-4, 1e-4)
#: Once they are aligned, what a few images leave of a band is paint that leans with the wavelength.
FIRST, LAST = (5, 3), (8, 4)
HALVES_FROM = 6
FAR_PX = 0.5
STEADY = 0.05
ASKED = 8


def align_own(
    bands: Sequence[BandImage], images: Mapping[str, np.ndarray], anchor: BandImage
) -> Sensor:
    """Register the bands of the reference's sensor to `anchor`.

    The bands of either half, every other one in the order of wavelength, are predicted from those
    of the other half. Where a prediction lies depends on where its bands lie: all positions are
    solved for together, the anchor's being given.
    """
    bands = ordered(bands)
    labels = [band.label for band in bands]
    fixed = labels.index(anchor.label)
    pictures = [images[label] for label in labels]
    places = [band.wavelength for band in bands]
    model = still(len(bands), *frame_of(anchor.values.shape))
    seen: list[Windows] = []
    if len(bands) > 1:
        step = _telling(pictures, fixed)
        step = max(step, 1 if anchor.values.size < LARGE_PX else 2)
        model = _nearer(pictures, places, fixed, model, step)
        for ridge in RIDGES:
            model, seen = _adjust(pictures, places, fixed, model, step, ridge)
        if step > 1:
            model, seen = _finer(pictures, places, fixed, model, step, seen)
    identity = Affine.identity()
    transforms: dict[str, Transform] = {
        label: identity if i == fixed else model.transform(i) for i, label in enumerate(labels)
    }
    windows = dict(zip(labels, seen, strict=False))
    sigma = measure_sigma(anchor.values.shape, labels, model)
    return Sensor(anchor.sensor, transforms, identity, model, None, windows, sigma=sigma)


def _finer(
    pictures: Sequence[np.ndarray],
    places: Sequence[float],
    fixed: int,
    model: Chromatic,
    step: int,
    seen: list[Windows],
) -> tuple[Chromatic, list[Windows]]:
    """Adjust once more at half the step, and keep that if its windows know more.

    What was measured on the coarser grid holds to a part of its pixel: where noise drowns the
    finer one, bands that look alike drift together, and farther than that.
    """
    finer, looked = _adjust(pictures, places, fixed, model, step // 2, RIDGES[-1])
    width = model.amounts.shape[1]
    moved = np.sqrt(((finer.amounts[:, :width] - model.amounts) ** 2).sum(1)).max()
    asked = np.unique(np.linspace(0, len(seen) - 1, min(len(seen), ASKED)).round().astype(int))
    before, after = (sum(each(_knowledge, [w[i] for i in asked])) for w in (seen, looked))
    return (finer, looked) if after > before and moved < STEADY * step else (model, seen)


def _telling(pictures: Sequence[np.ndarray], fixed: int) -> int:
    """Return the step at which windows know most: fine grids of oversampled frames know less."""
    near = sorted((i for i in range(len(pictures)) if i != fixed), key=lambda i: abs(i - fixed))[:2]
    identity, shape = Affine.identity(), pictures[fixed].shape
    best, known = 1, -np.inf
    for step in steps_of(shape, 1):
        size = (shape[0] // step, shape[1] // step)
        shown = [pictures[i] for i in (fixed, *near)]
        anchor, *others = all_sampled(shown, [identity] * len(shown), size, step)
        predictor = Predictor(condense(anchor[None]).ready().images, step=step, cell=cell_px(size))
        seen = each(partial(compared, predictor), others)
        total = sum(_knowledge(windows) for windows in seen)
        if total > known:
            best, known = step, total
    return best


def _knowledge(seen: Windows) -> float:
    """All information of the windows, 1/px², by how they really scatter about a smooth field."""
    used = np.trace(seen.information, axis1=1, axis2=2) > 0
    if used.sum() < LEAST_WINDOWS:
        return 0.0
    points, one = seen.centres[used], np.broadcast_to(np.eye(2), (int(used.sum()), 2, 2))
    observed = Observations(points, points - seen.shift[used], one, seen.information[used])
    return climb(observed, spacing=1.0, coarse=True).knowledge


def _nearer(
    pictures: Sequence[np.ndarray], places: Sequence[float], fixed: int, model: Chromatic, step: int
) -> Chromatic:
    """Return the start from which the bands predict each other better: as they are, or brought near.

    The anchor alone predicts other bands badly: what it says is of use only where bands are far.
    """
    near = _approach(pictures, places, fixed, model)
    if near is model:
        return model
    explained = []
    for tried in (model, near):
        seen = _adjust(pictures, places, fixed, tried, step, RIDGES[0])[1]
        explained.append(float(np.mean([_explained(windows) for windows in seen])))
    return near if explained[1] > explained[0] else model


def _explained(windows: Windows) -> float:
    used = np.trace(windows.information, axis1=1, axis2=2) > 0
    return float(windows.r2[used].mean()) if used.any() else 0.0


def _approach(
    pictures: Sequence[np.ndarray], places: Sequence[float], fixed: int, model: Chromatic
) -> Chromatic:
    """Bring bands that are pixels apart near, by the anchor alone; leave what is near as it is."""
    first, shape = model, pictures[fixed].shape
    for step in steps_of(shape, 1):
        size = (shape[0] // step, shape[1] // step)
        maps = [model.transform(i) for i in range(len(pictures))]
        warped = all_sampled(pictures, maps, size, step)
        palette = condense(warped[fixed][None]).ready()
        predictor = Predictor(palette.images, step=step, cell=cell_px(size))
        seen = each(partial(compared, predictor), warped)
        model = fit_chromatic(seen, model, places, highest="affine", fixed=fixed)
        if np.sqrt((model.amounts**2).sum(1)).max() < FAR_PX:
            return first
    return model


def _adjust(
    pictures: Sequence[np.ndarray],
    places: Sequence[float],
    fixed: int,
    model: Chromatic,
    step: int,
    ridge: float,
) -> tuple[Chromatic, list[Windows]]:
    count, (height, width) = len(pictures), pictures[fixed].shape
    size = (height // step, width // step)
    maps = [model.transform(i) for i in range(count)]
    warped = all_sampled(pictures, maps, size, step)
    leaning, seen = np.zeros((count, count)), {}
    for group in _groups(count, fixed):
        others = [i for i in range(count) if i not in group]
        counts = LAST if ridge == RIDGES[-1] else FIRST
        palette = condense(np.stack([warped[i] for i in others]), counts).ready()
        predictor = Predictor(palette.images, step=step, cell=cell_px(size))
        found = each(partial(compared, predictor, ridge=ridge), [warped[i] for i in group])
        for i, windows in zip(group, found, strict=True):
            seen[i] = windows
            leaning[i, others] = palette.leaning(windows)
    looked = [seen[i] for i in range(count)]
    return fit_chromatic(looked, model, places, fixed=fixed, leaning=leaning), looked


def _groups(count: int, fixed: int) -> list[list[int]]:
    if count < HALVES_FROM:
        return [[i] for i in range(count)]
    return [list(range(k, count, 2)) for k in ((fixed + 1) % 2, fixed % 2)]
