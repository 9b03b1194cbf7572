"""The reference camera's own bands against its reference band."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from levkas.registration.chromatic import Chromatic, fit_chromatic, still
from levkas.registration.prediction import cell_px, compared, condense, sampled
from levkas.registration.refinement import Predictor, Windows
from levkas.registration.sensors import Sensor, frame_of, ordered, steps_of
from levkas.transforms import Affine, Transform

if TYPE_CHECKING:
    from levkas.registration.images import BandImage

#: Bands that are not yet aligned differ by gradients, and a combination of them passes for a shift.
#: The price of small components falls as they come to mean paint.
RIDGES = (1e-2, 1e-3, 3e-4, 1e-4)
HALVES_FROM = 6
FAR_PX = 0.5


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
        model = _approach(pictures, places, fixed, model)
        for ridge in RIDGES:
            model, seen = _adjust(pictures, places, fixed, model, ridge)
    identity = Affine.identity()
    transforms: dict[str, Transform] = {
        label: identity if i == fixed else model.transform(i) for i, label in enumerate(labels)
    }
    windows = dict(zip(labels, seen, strict=False))
    return Sensor(anchor.sensor, transforms, identity, model, None, windows)


def _approach(
    pictures: Sequence[np.ndarray], places: Sequence[float], fixed: int, model: Chromatic
) -> Chromatic:
    """Bring bands that are pixels apart near, by the anchor alone; leave what is near as it is."""
    first, shape = model, pictures[fixed].shape
    for step in [*steps_of(shape, 1), 1]:
        size = (shape[0] // step, shape[1] // step)
        warped = [sampled(p, model.transform(i), size, step) for i, p in enumerate(pictures)]
        palette = condense(warped[fixed][None]).ready()
        predictor = Predictor(palette.images, step=step, cell=cell_px(size))
        seen = [compared(predictor, image) for image in warped]
        model = fit_chromatic(seen, model, places, highest="affine", fixed=fixed)
        if step > 1:
            continue
        apart = np.sqrt((model.amounts**2).sum(1))
        if apart.max() < FAR_PX:
            return first
    return model


def _adjust(
    pictures: Sequence[np.ndarray],
    places: Sequence[float],
    fixed: int,
    model: Chromatic,
    ridge: float,
) -> tuple[Chromatic, list[Windows]]:
    count, shape = len(pictures), pictures[fixed].shape
    warped = [sampled(p, model.transform(i), shape, 1) for i, p in enumerate(pictures)]
    leaning, seen = np.zeros((count, count)), {}
    for group in _groups(count, fixed):
        others = [i for i in range(count) if i not in group]
        palette = condense(np.stack([warped[i] for i in others])).ready()
        predictor = Predictor(palette.images, cell=cell_px(shape))
        for i in group:
            seen[i] = compared(predictor, warped[i], ridge=ridge)
            leaning[i, others] = palette.leaning(seen[i])
    windows = [seen[i] for i in range(count)]
    return fit_chromatic(windows, model, places, fixed=fixed, leaning=leaning), windows


def _groups(count: int, fixed: int) -> list[list[int]]:
    if count < HALVES_FROM:
        return [[i] for i in range(count)]
    return [list(range(k, count, 2)) for k in ((fixed + 1) % 2, fixed % 2)]
