"""Coarse to fine: from an initial transform to the map of every band of one sensor, and the evidence on it.

On each grid of a pyramid the windows of all bands are shifted, their shifts fused and a base map selected;
on the finest grid that rounds are repeated, with the lateral chromatic aberration of each band, until the
map moves no more.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from levkas.core.threads import each
from levkas.geometry.transforms import Affine, Composed, Transform
from levkas.registration.advice import POINTS
from levkas.registration.bands import by_wavelength, present_bands, sqrt_images
from levkas.registration.chromatic import (
    ChromaticShifts,
    chromatic_of_all,
    fit_chromatic,
    is_smooth_in_wavelength,
    zero_displacement,
)
from levkas.registration.initial import SETTINGS as INITIAL
from levkas.registration.initial import (
    InitialTransform,
    find_initial_transform,
    implausible,
    is_plausible,
)
from levkas.registration.line_correction import LineCorrection, find_correction
from levkas.registration.line_displacement import LineDisplacement, measure_line_displacement
from levkas.registration.local_shifts import WindowShifts, highpass
from levkas.registration.manual_points import ManualPoints
from levkas.registration.model_selection import SelectedModel, SelectionTerms
from levkas.registration.orientation_correlation import match_blocks
from levkas.registration.predictors import (
    ReferenceStack,
    cell_px,
    has_colours,
    measure_shifts,
    resample_band,
)
from levkas.registration.record import RegistrationRefused, Sigma, refusal
from levkas.registration.starts import seed_with_points
from levkas.registration.uncertainty import measure_sigma
from levkas.registration.verdict import SCALES, Evidence, Light
from levkas.registration.verification import (
    PermutationTest,
    coarsening,
    run_permutation_test,
    verify,
)
from levkas.registration.window_fusion import (
    FusionSettings,
    base_change,
    fit_base,
    fuse_windows,
    has_information,
    total_information,
)

if TYPE_CHECKING:
    from levkas.registration.bands import BandImage
    from levkas.registration.features import CameraFeatures
    from levkas.registration.placed_by_hand import PlacedByHand
    from levkas.registration.window_matching import CheckWindows

Item = TypeVar("Item")
Begin = Callable[["CameraFeatures", "CameraFeatures"], InitialTransform | None]


COARSE_BANDS = 4
"""Bands compared on grids before the finest, evenly over the wavelengths."""
ROUNDS, MOST_ROUNDS = 2, 8
"""On the finest grid, that are always made, and at most."""
CONVERGED = 0.1
"""In px of the grid: a map that moves less, the median over windows, has converged."""
LARGE = 600_000
"""In px of the grid: larger frames make the first round on a grid twice as coarse, at a quarter of the cost."""
LEAST_CELLS = 5
"""Cells of windows across the coarsest grid."""
SHARPER = 8.0
"""Factor by which the total information must grow on a finer grid that is taken although its model fits worse."""
FINEST_SAMPLING, PLAIN_SAMPLING = 0.45, 0.9
"""In native px per px of the finest grid, and of the grid on which a map is judged, about as fine as the picture."""
SURE_COVERAGE = 0.5
"""Share of cells that windows confirm; below, blocks are compared by their outlines too."""
LINE_BANDS, NEARLY = 8, 0.9
"""Bands of which the mean is looked at for displaced lines, and their explained share over that of the best band."""
LINE_ROUNDS = 3
"""Of putting lines right and registering again, at most: under ±1.5 px the third changes little."""
COARSE_SCALES = (1 / 30, INITIAL.scales[1])
"""Native px per reference px of maps of one scan."""


@dataclass(frozen=True)
class SensorTask:
    """One sensor to be registered."""

    bands: Sequence[BandImage]
    """In the order of their wavelengths."""
    images: Mapping[str, np.ndarray]
    """Square roots of the bands, as `sqrt_images` gives them."""
    reference: ReferenceStack
    mask: np.ndarray
    """In reference px: where the object lies."""
    initial: InitialTransform
    by_hand: ManualPoints

    @property
    def one_scan(self) -> bool:
        """Whether the bands are pictures of one scan: they share one map, and what checks it is gathered over all."""
        return self.bands[0].one_scan

    @property
    def scales(self) -> tuple[float, float]:
        """Native px per reference px of a plausible map."""
        return COARSE_SCALES if self.one_scan else INITIAL.scales

    @cached_property
    def scale(self) -> float:
        """Native px per reference px, the median over the frame."""
        height, width = self.reference.shape
        x, y = np.meshgrid(np.linspace(0.1, 0.9, 5) * width, np.linspace(0.1, 0.9, 5) * height)
        jacobian = self.initial.transform.jacobian(np.stack([x, y], -1).reshape(-1, 2))
        return float(np.sqrt(np.median(np.abs(np.linalg.det(jacobian)))))

    def step(self, sampling: float) -> int:
        """Return the reference px per px of a grid, `sampling` native px in each of its px."""
        return max(1, round(sampling / self.scale))

    def cell(self, step: int) -> float:
        """Return the side of a window's cell on a grid, reference px."""
        return float(self.reference.predictor(step).cell * step)

    def resample(self, band: BandImage, transform: Transform, step: int) -> np.ndarray:
        """Return a band on the grid of `step` reference px.

        A mosaic's band is taken at its own sites: between them is detail of other bands, and blocks that begin at one sensel lie otherwise.
        """
        size = (self.reference.shape[0] // step, self.reference.shape[1] // step)
        scale, sites, image = self.scale, band.sites, self.images[band.label]
        if sites is not None and self._block(scale, step) == 1:
            image = sites.filled(image)
        elif sites is not None:
            image, scale = sites.picture(image), scale / sites.period
            transform = Composed(transform, sites.transform)
        return resample_band(image, transform, size, step, count=self._block(scale, step))

    def _block(self, scale: float, step: int) -> int:
        """Return the side of the blocks that are averaged, about one reference px, or px of the grid where all grids are coarser than that."""
        if self.step(FINEST_SAMPLING) > 1:
            return max(1, round(scale * step / 1.2))
        return max(1, round(scale / 1.2)) * step

    def measure_shifts(
        self, bands: Sequence[BandImage], own: Sequence[Transform], base: Transform, step: int
    ) -> list[WindowShifts]:
        """Return the windows of each band, resampled through its own map and then `base`."""
        predictor = self.reference.predictor(step)

        def windows_of(band: BandImage, before: Transform) -> WindowShifts:
            return measure_shifts(predictor, self.resample(band, Composed(before, base), step))

        return each(windows_of, bands, own)

    def measure_lines(self, found: RefinedMap) -> LineDisplacement | None:
        """Measure how lines lie beside the map, of the best band, else of the mean of all nearly as good: a scanner exposes them at once."""
        explained = np.array([windows.r2.mean() for windows in found.windows])
        best = int(explained.argmax())
        alike = np.flatnonzero(explained >= NEARLY * explained[best]).tolist()
        whole = Composed(found.chromatic.transform(best), found.base)
        step = self.step(PLAIN_SAMPLING)
        predictors = self.reference.predictor(step).images
        results: list[LineDisplacement] = []
        for among in ([best], evenly_spread(alike, LINE_BANDS)):
            if len(among) in (1, LINE_BANDS) and not any(one.displaced for one in results):
                image = np.mean([self.images[self.bands[i].label] for i in among], 0)
                measured = measure_line_displacement(predictors, image, whole, step=step)
                results += [measured] if measured else []
        return max(results, key=lambda one: one.deviations, default=None)

    def light_of(self, band: BandImage, transform: Transform, step: int) -> Light:
        """Return whether a band sees light that the reference sees too: by its wavelength; without one, two pictures in colours do."""
        if self.one_scan:
            return "other"
        if np.isfinite(band.wavelength):
            return "same" if self.reference.covers(band.wavelength) else "other"
        among = evenly_spread(self.bands, 3) if self.reference.has_colours else []
        shown = [self.resample(one, transform, step) for one in among]
        return "same" if has_colours(shown) else "unknown"


@dataclass(frozen=True)
class RefinedMap:
    """Map of one sensor after one refinement."""

    base: Transform
    """Reference px → native px, without the chromatic aberration of single bands."""
    band: str
    """By which it was judged."""
    chromatic: ChromaticShifts
    selected: SelectedModel
    windows: list[WindowShifts]
    """Shifts of the last round, before its correction; one a band."""
    numbers: dict[str, Any]
    """Fields of `Evidence`."""
    checks: CheckWindows


@dataclass(frozen=True)
class RegisteredSensor:
    """One sensor registered."""

    name: str
    transforms: dict[str, Transform]
    chromatic: ChromaticShifts
    windows: dict[str, WindowShifts]
    sigma: dict[str, Sigma] = field(default_factory=dict)
    base: Transform | None = None
    """Reference px → native px without the chromatic shifts of bands; None for the reference's own sensor."""
    initial: InitialTransform | None = None
    refined: RefinedMap | None = None
    """None, as `initial` and `evidence`, for the reference's own sensor."""
    evidence: Evidence | None = None
    lines: LineDisplacement | None = None
    """How single lines lie beside the map; None where too few show enough."""
    correction: LineCorrection | None = None
    """Of lines that are displaced, which the maps follow; `refined` is of the picture put right."""
    placed: PlacedByHand | None = None
    """The map where it is fitted to a person's pairs alone; there is no `initial` and no `refined` then."""

    def knowing(self, **known: Any) -> RegisteredSensor:
        """Return the sensor with more evidence; of one without evidence nothing is known."""
        if self.evidence is None:
            return self
        return replace(self, evidence=replace(self.evidence, **known))


def register_sensor(
    bands: Sequence[BandImage],
    images: Mapping[str, np.ndarray],
    reference: ReferenceStack,
    ours: CameraFeatures,
    theirs: CameraFeatures,
    by_hand: ManualPoints,
    reference_sigma: Mapping[str, Sigma] | None = None,
    begin: Begin = find_initial_transform,
) -> RegisteredSensor:
    """Register the bands of one sensor of another camera to the reference.

    `images` are square roots of the bands that are measured; of `ours` and `theirs`, key points, `begin` returns the initial transform,
    else pairs by hand do. Raises RegistrationRefused: ``E_MATCHES``, ``E_WINDOWS``, ``E_SCALE`` or ``E_FOLD``.
    """
    initial = begin(ours, theirs)
    if by_hand:
        initial = seed_with_points(initial, by_hand, ours, theirs)
    sensor = bands[0].sensor
    if initial is None:
        raise refusal(
            "E_MATCHES",
            "too few key points match between this sensor and the reference",
            field=sensor or None,
            fix=f"Check that both pictures show the same object, in focus and well exposed; if they do, {POINTS}"
            + (", or declare the sensor's `align`." if sensor else "."),
        )
    bands, there = by_wavelength(bands), present_bands(by_wavelength(bands))
    mask = np.ones(reference.shape, bool) if ours.within is None else ours.within
    shown = [band for band in bands if band.label in images]
    task = SensorTask(shown, images, reference, mask, initial, by_hand)
    found = refine_map(task)
    if not is_smooth_in_wavelength(found.chromatic, shown, there):
        images = {**images, **sqrt_images([band for band in there if band.label not in images])}
        task = replace(task, bands=there, images=images)
        found = refine_map(task)
    found, lines, correction = _put_lines_right(task, found)
    native = () if correction is None else (correction.transform(),)
    whole, outlines = Composed(found.base, *native), None
    if found.numbers["coverage"] < SURE_COVERAGE or np.isinf(found.selected.held_out_error):
        outlines = match_blocks(ours.greys, theirs.greys, whole, ours.within)
    labels = [band.label for band in bands]
    chromatic = chromatic_of_all(found.chromatic, task.bands, bands)
    sigma = measure_sigma(
        reference.shape, labels, chromatic, found.selected, reference_sigma, found.checks,
        outlines and outlines.tolerance, max((one.sigma for one in (lines, correction) if one), default=0.0),
    )  # fmt: skip
    return RegisteredSensor(
        name=sensor,
        transforms={name: Composed(chromatic.transform(i), whole) for i, name in enumerate(labels)},
        chromatic=chromatic,
        windows=dict(zip([band.label for band in task.bands], found.windows, strict=True)),
        sigma=sigma,
        base=whole,
        initial=initial,
        refined=found,
        evidence=_evidence(task, found, outlines and outlines.to_dict(), lines, correction),
        lines=lines,
        correction=correction,
    )


def _evidence(
    task: SensorTask,
    found: RefinedMap,
    outlines: dict[str, float] | None,
    lines: LineDisplacement | None,
    correction: LineCorrection | None,
) -> Evidence:
    """Return all that is known of a map."""
    initial, selected = task.initial, found.selected
    return Evidence(
        basis="windows",
        kept=int(initial.kept.sum()),
        begun="outlines" if initial.by_outlines else "pairs" if initial.by_pairs else "key points",
        terms=selected.coefficients,
        held_out_px=selected.held_out_error,
        window_sigma_px=selected.window_sigma,
        scales=task.scales if task.one_scan else SCALES,
        outlines=outlines,
        line_displacement=None if lines is None else lines.to_dict(),
        line_correction=None if correction is None else correction.to_dict(),
        **found.numbers,
    )


def _put_lines_right(
    task: SensorTask, found: RefinedMap
) -> tuple[RefinedMap, LineDisplacement | None, LineCorrection | None]:
    """Put displaced lines right, of rows and columns those displaced more, and register again for as long as less is left.

    Returns the map of the picture put right, how lines lie beside that, and the correction; None without one.
    """
    whole, lines = None, task.measure_lines(found)
    for _ in range(LINE_ROUNDS):
        rest = find_correction(lines, task.scale) if lines else None
        if lines is None or rest is None or (whole and rest.lines != whole.lines):
            break
        correction = rest if whole is None else whole.followed_by(rest)
        again = replace(task, images=correction.put_right(task.images))
        try:
            better = refine_map(again)
        except RegistrationRefused:
            break
        left = again.measure_lines(better)
        if left is None or left.rms >= lines.rms:
            break
        whole, found, lines = correction, better, left
    return found, lines, whole


def refine_map(task: SensorTask) -> RefinedMap:
    """Refine the map of one sensor from coarse to fine; raises RegistrationRefused (``E_WINDOWS``, ``E_SCALE``, ``E_FOLD``)."""
    way = _Refinement(task)
    way.approach()
    way.converge()
    best = max(range(len(task.bands)), key=lambda i: float(way.windows[i].r2.mean()))
    judged = max(way.step, task.step(PLAIN_SAMPLING))
    test = way.exclude_covered(best, judged)
    band, whole = task.bands[best], Composed(way.chromatic.transform(best), way.base)
    step = judged * coarsening(task.reference.shape, judged)
    bands = task.bands if task.one_scan else [band]
    image = np.stack([highpass(task.resample(one, whole, step)) for one in bands])
    predictors, valid = task.reference.predictor(step).images, np.isfinite(task.images[band.label])
    numbers, checks = verify(
        predictors, image, step, whole, task.mask, valid, test.predicted, task.cell(judged)
    )
    light = task.light_of(band, whole, judged)
    numbers |= way.course | {"step": judged, "share_above_chance": test.share, "light": light}
    return RefinedMap(
        way.base, band.label, way.chromatic, way.selected, way.windows, numbers, checks
    )


class _Refinement:
    """State of one refinement: base map, grid, chromatic shifts and windows of the last round."""

    selected: SelectedModel
    windows: list[WindowShifts]
    course: dict[str, Any]
    """``rounds``, whether they ``converged``, and by how much the last one ``moved`` the map."""

    def __init__(self, task: SensorTask) -> None:
        self.task, self.base = task, task.initial.transform
        self.step = task.step(FINEST_SAMPLING)
        self.chromatic = zero_displacement(len(task.bands), *frame_centre(task.reference.shape))

    def approach(self) -> None:
        """Refine the base map from coarse to fine; stop at the grid that shows most: fine grids of noisy pictures hold less."""
        task, finest = self.task, self.task.step(FINEST_SAMPLING)
        bands = evenly_spread(task.bands, COARSE_BANDS)
        identity = [Affine.identity()] * len(bands)
        known = None
        for step in pyramid_steps(task.reference.shape, finest):
            windows = task.measure_shifts(bands, identity, self.base, step)
            usable = has_information(fuse_windows(windows)[1]).sum()
            if usable < FusionSettings.least_windows and step > finest:
                continue  # too little to see at this size; the initial transform stands
            selected = self._fit(windows, step, SelectionTerms(coarse=True))
            now = (total_information(windows), selected.total_information)
            if known is not None and now[1] < known[1]:
                # Where neighbouring windows have that much more information, it is the model that lacks a term.
                near, before = now[0], known[0]
                if near is None or before is None or near < SHARPER * before:
                    return
            self._take(selected)
            self.step, known = step, now

    def converge(self) -> None:
        """Fit base map and chromatic shifts in turns on the finest grid until the map moves no more."""
        bands, wavelengths = self.task.bands, [band.wavelength for band in self.task.bands]
        height, width = self.task.reference.shape
        small = height * width < LARGE * self.step**2
        planned = [self.step] * ROUNDS if small else [2 * self.step, self.step]
        steps = planned + [self.step] * (MOST_ROUNDS - len(planned))
        for number, step in enumerate(steps, 1):
            self.windows = self._measure_windows(step)
            before = self.base
            terms = SelectionTerms(depth_step=step == self.step)
            self._take(self._fit(self.windows, step, terms))
            moved = base_change(before, self.base, self.selected.observations.points)
            if len(bands) > 1 and not self.task.one_scan:
                common = base_change(before, self.base, self.windows[0].centres)
                self.chromatic = fit_chromatic(
                    self.windows, self.chromatic, wavelengths, common=common
                )
            shift = float(np.sqrt(np.median((moved**2).sum(1))))
            converged = shift < CONVERGED * self.step
            self.course = {"rounds": number, "converged": converged, "moved": round(shift, 5)}
            if number >= len(planned) and converged:
                return

    def exclude_covered(self, best: int, judged: int) -> PermutationTest:
        """Refit to windows that lie among predicted ones, where something covers part of the object."""
        test = self._test(best, judged)
        for _ in range(ROUNDS):
            if not test.is_partly_covered:
                break
            among = test.is_predicted_around(self.windows[0].centres)
            self._take(self._fit(self.windows, self.step, SelectionTerms(stiff=True), among))
            self.windows = self._measure_windows(self.step)
            test = self._test(best, judged)
        return test

    def _measure_windows(self, step: int) -> list[WindowShifts]:
        own = [self.chromatic.transform(i) for i in range(len(self.task.bands))]
        return self.task.measure_shifts(self.task.bands, own, self.base, step)

    def _fit(
        self, windows: list[WindowShifts], step: int, terms: SelectionTerms, among: np.ndarray | None = None,
    ) -> SelectedModel:  # fmt: skip
        by_hand, cell = self.task.by_hand.fixed, self.task.cell(step)
        return fit_base(self.base, windows, by_hand, step, cell, terms, among)

    def _take(self, selected: SelectedModel) -> None:
        """Take a map as the base; raises RegistrationRefused of one that no camera makes."""
        task, points = self.task, selected.observations.points
        box, mirrored = (*points.min(0), *points.max(0)), task.initial.mirrored
        if not is_plausible(selected.transform, box, mirrored, task.scales):
            share = (box[2] - box[0]) * (box[3] - box[1]) / np.prod(task.reference.shape)
            sensor = task.bands[0].sensor or None
            raise RegistrationRefused(
                implausible(selected.transform, box, mirrored, sensor, float(share), task.scales)
            )
        self.selected, self.base = selected, selected.transform

    def _test(self, best: int, step: int) -> PermutationTest:
        whole = Composed(self.chromatic.transform(best), self.base)
        bands = self.task.bands if self.task.one_scan else [self.task.bands[best]]
        images = [self.task.resample(band, whole, step) for band in bands]
        return run_permutation_test(self.task.reference.predictor(step), images)


def evenly_spread(items: Sequence[Item], most: int) -> list[Item]:
    """Return at most `most` of the items, evenly over their order."""
    picks = np.unique(np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int))
    return [items[i] for i in picks]


def frame_centre(shape: tuple[int, int]) -> tuple[np.ndarray, float]:
    """Return centre and half the longer side of a frame: the coordinates of the chromatic fields."""
    return np.array([shape[1] - 1, shape[0] - 1]) / 2, max(shape) / 2


def pyramid_steps(shape: tuple[int, int], finest: int) -> list[int]:
    """Return the steps of the pyramid, four at most, from coarse to `finest`, reference px.

    >>> pyramid_steps((600, 800), 1)
    [8, 4, 2, 1]
    """
    steps = [finest]
    least = LEAST_CELLS * cell_px((0, 0))
    while min(shape) // (steps[-1] * 2) >= least and len(steps) < 4:
        steps.append(steps[-1] * 2)
    return steps[::-1]
