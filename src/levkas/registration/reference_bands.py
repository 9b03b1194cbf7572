"""Registration of the reference camera's own bands to its reference band.

The bands of either half, every other one in the order of wavelength, are predicted from those of the other half. Where a prediction lies
depends on where its bands lie: all positions are solved for together, that of the reference band being given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from levkas.core.threads import each
from levkas.geometry.transforms import Affine, Transform
from levkas.registration.bands import BandImage, by_wavelength, present_bands
from levkas.registration.chromatic import (
    ChromaticShifts,
    chromatic_of_all,
    fit_chromatic,
    is_smooth_in_wavelength,
    measured_bands,
    zero_displacement,
)
from levkas.registration.coarse_to_fine import (
    LARGE,
    RegisteredSensor,
    evenly_spread,
    frame_centre,
    pyramid_steps,
)
from levkas.registration.local_shifts import Predictor, WindowShifts
from levkas.registration.model_selection import SelectionTerms, scattered_information
from levkas.registration.models import Observations
from levkas.registration.predictors import (
    LINEAR,
    LOGARITHMIC,
    cell_px,
    measure_shifts,
    principal_components,
    resample_all,
)
from levkas.registration.uncertainty import measure_sigma
from levkas.registration.window_fusion import SETTINGS as FUSION
from levkas.registration.window_fusion import has_information

RIDGES = (1e-2, 1e-3, 3e-4, 1e-4)
"""Ridge of the predictions in each round. Bands that are not yet aligned differ by gradients, and a combination of them passes for a shift;
the price of small components falls as they come to be paint."""
FIRST, LAST = (LINEAR, LOGARITHMIC), (8, 4)
"""Principal components of reflectance, and of its logarithm, before the last round and in it: once bands are aligned, what a few images
leave of a band is paint that changes with the wavelength."""
HALVES_FROM = 6
"""Bands from which they are predicted in two halves; fewer are predicted one by one."""
FAR, STEADY = 0.5, 0.05
"""Px: shift of a band from which all are brought near by the reference band alone first; px of the grid: a grid twice as fine may move no
band by more: where noise drowns it, bands that look alike drift together, and farther than that."""
COMPARED = 8
"""Bands in which two grids are compared."""


def register_own_bands(
    bands: Sequence[BandImage], images: Mapping[str, np.ndarray], anchor: BandImage
) -> RegisteredSensor:
    """Register the bands of the reference's sensor to `anchor`; `images` are their square roots by label."""
    bands = by_wavelength(bands)
    labels = [band.label for band in bands]
    there = present_bands(bands, anchor)
    also = [band.label for band in there].index(anchor.label)
    shown = [there[i] for i in measured_bands(there, also=also)]
    model, shifts = _align(shown, images, anchor)
    if not is_smooth_in_wavelength(model, shown, there):
        shown = there
        model, shifts = _align(shown, images, anchor)
    model = chromatic_of_all(model, shown, bands)
    transforms: dict[str, Transform] = {
        label: Affine.identity() if label == anchor.label else model.transform(i)
        for i, label in enumerate(labels)
    }
    sigma = measure_sigma(anchor.values.shape, labels, model)
    windows = dict(zip([band.label for band in shown], shifts, strict=False))
    return RegisteredSensor(anchor.sensor, transforms, model, windows, sigma)


def lie_together(bands: Sequence[BandImage], anchor: BandImage) -> RegisteredSensor:
    """Return the registration of maps of one scan to `anchor`, one of them: they lie on one another as they are."""
    labels = [band.label for band in bands]
    model = zero_displacement(len(bands), *frame_centre(anchor.values.shape))
    sigma = measure_sigma(anchor.values.shape, labels, model)
    still: dict[str, Transform] = dict.fromkeys(labels, Affine.identity())
    return RegisteredSensor(anchor.sensor, still, model, {}, sigma)


def _align(
    bands: Sequence[BandImage], images: Mapping[str, np.ndarray], anchor: BandImage
) -> tuple[ChromaticShifts, list[WindowShifts]]:
    """Return the shifts of the bands against `anchor`, one of them, and the windows of the last round."""
    model = zero_displacement(len(bands), *frame_centre(anchor.values.shape))
    if len(bands) == 1:
        return model, []
    fixed = [band.label for band in bands].index(anchor.label)
    pictures = [images[band.label] for band in bands]
    return _Bands(pictures, [band.wavelength for band in bands], fixed).align(model)


class _Bands:
    """Pictures of one sensor's bands, their wavelengths, nm, and the number of the fixed one."""

    def __init__(
        self, pictures: Sequence[np.ndarray], wavelengths: Sequence[float], fixed: int
    ) -> None:
        self.pictures, self.wavelengths, self.fixed = pictures, wavelengths, fixed
        self.shape, self.count = pictures[fixed].shape, len(pictures)

    def align(self, model: ChromaticShifts) -> tuple[ChromaticShifts, list[WindowShifts]]:
        """Return the shifts of all bands, and the windows of the last round."""
        small = self.pictures[self.fixed].size < LARGE
        step = max(self._most_informative_step(), 1 if small else 2)
        near = self._bring_near(model)
        if near is not model:  # the reference band alone predicts other bands badly
            explained = [
                np.mean([_explained(one) for one in self._adjust(tried, step, RIDGES[0])[1]])
                for tried in (model, near)
            ]
            model = near if explained[1] > explained[0] else model
        shifts: list[WindowShifts] = []
        for ridge in RIDGES:
            model, shifts = self._adjust(model, step, ridge)
        if step == 1:
            return model, shifts
        # Half the step is kept if its windows hold more information.
        finer, finer_shifts = self._adjust(model, step // 2, RIDGES[-1])
        width = model.amounts.shape[1]
        moved = np.sqrt(((finer.amounts[:, :width] - model.amounts) ** 2).sum(1)).max()
        before, after = (
            sum(each(_information, evenly_spread(windows, COMPARED)))
            for windows in (shifts, finer_shifts)
        )
        better = after > before and moved < STEADY * step
        return (finer, finer_shifts) if better else (model, shifts)

    def _resample(self, model: ChromaticShifts, step: int) -> list[np.ndarray]:
        maps = [model.transform(i) for i in range(self.count)]
        return resample_all(self.pictures, maps, self._size(step), step)

    def _size(self, step: int) -> tuple[int, int]:
        return self.shape[0] // step, self.shape[1] // step

    def _alone(self, picture: np.ndarray, step: int) -> Predictor:
        """Return the predictor that the reference band makes alone."""
        basis = principal_components(picture[None]).high_passed()
        return Predictor(basis.images, step=step, cell=cell_px(self._size(step)))

    def _most_informative_step(self) -> int:
        """Return the step at which windows hold most information: fine grids of oversampled frames hold less."""
        near = sorted(range(self.count), key=lambda i: abs(i - self.fixed))[:3]
        shown, best, most = [self.pictures[i] for i in near], 1, -np.inf
        for step in pyramid_steps(self.shape, 1):
            still = [Affine.identity()] * len(shown)
            anchor, *rest = resample_all(shown, still, self._size(step), step)
            predictor = self._alone(anchor, step)
            total = sum(_information(w) for w in each(partial(measure_shifts, predictor), rest))
            if total > most:
                best, most = step, total
        return best

    def _bring_near(self, first: ChromaticShifts) -> ChromaticShifts:
        """Bring bands that are pixels apart near by the reference band; return `first` where none is."""
        model = first
        for step in pyramid_steps(self.shape, 1):
            warped = self._resample(model, step)
            shifts = each(partial(measure_shifts, self._alone(warped[self.fixed], step)), warped)
            model = fit_chromatic(
                shifts, model, self.wavelengths, highest="affine", fixed=self.fixed
            )
            if np.sqrt((model.amounts**2).sum(1)).max() < FAR:
                return first
        return model

    def _adjust(
        self, model: ChromaticShifts, step: int, ridge: float
    ) -> tuple[ChromaticShifts, list[WindowShifts]]:
        """Predict each group of bands from the others, and fit the shifts of all together."""
        count, warped = self.count, self._resample(model, step)
        sensitivity, shifts = np.zeros((count, count)), {}
        halves = [list(range(k, count, 2)) for k in ((self.fixed + 1) % 2, self.fixed % 2)]
        for group in halves if count >= HALVES_FROM else [[i] for i in range(count)]:
            others = [i for i in range(count) if i not in group]
            stack = np.stack([warped[i] for i in others])
            basis = principal_components(stack, LAST if ridge == RIDGES[-1] else FIRST)
            basis = basis.high_passed()
            predictor = Predictor(basis.images, step=step, cell=cell_px(self._size(step)))
            measure = partial(measure_shifts, predictor, ridge=ridge)
            for i, windows in zip(group, each(measure, [warped[i] for i in group]), strict=True):
                shifts[i] = windows
                sensitivity[i, others] = basis.position_sensitivity(windows)
        found = [shifts[i] for i in range(count)]
        fitted = fit_chromatic(
            found, model, self.wavelengths, fixed=self.fixed, sensitivity=sensitivity
        )
        return fitted, found


def _information(windows: WindowShifts) -> float:
    """Return the information of all windows, 1/px², by how they scatter about a smooth field."""
    used = has_information(windows.information)
    if used.sum() < FUSION.least_windows:
        return 0.0
    points, one = windows.centres[used], np.broadcast_to(np.eye(2), (int(used.sum()), 2, 2))
    observed = Observations(points, points - windows.shift[used], one, windows.information[used])
    return scattered_information(observed, SelectionTerms(coarse=True))


def _explained(windows: WindowShifts) -> float:
    used = has_information(windows.information)
    return float(windows.r2[used].mean()) if used.any() else 0.0
