"""The registration of [mirhashemi2019]_, section 3.5, nothing cleverer than the paper.

SIFT on the mean of all bands of each camera, matching, one cut at `reject` under scale alone, the
worst pair removed until the largest error is at most `stop`, and a third-order polynomial fitted
target → reference. Its inverse is what a resampling needs. All bands of a sensor share one map:
the paper leaves them as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Problem
from levkas.geometry.transforms import Affine, Composed, Inverse, Polynomial, Transform
from levkas.registration.alignment import align_sensors, camera_grey, measure_apart
from levkas.registration.bands import BandImage, area_average, region_mask, stretch
from levkas.registration.features import KeyPoints, find_key_points
from levkas.registration.foreground import ObjectArea
from levkas.registration.line_displacement import measure_line_displacement
from levkas.registration.local_shifts import highpass
from levkas.registration.manual_points import ManualPoints, MarkedMatches
from levkas.registration.matching import RATIO, match
from levkas.registration.outliers import Cleaned, RemovalTerms, clean, remove_outliers
from levkas.registration.record import (
    Matches,
    MatchState,
    Registration,
    RegistrationRefused,
    Verdict,
)
from levkas.registration.verdict import judge_matches
from levkas.registration.verdict_rules import lies_where_declared
from levkas.registration.verification import (
    Overlap,
    box_of,
    measure_shape,
    measure_support,
    measure_windows,
    of_object,
)
from levkas.registration.window_matching import SETTINGS as WINDOWS
from levkas.registration.window_matching import CheckWindows, search_windows

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from levkas.campaign.methods import PaperOptions
    from levkas.registration.request import Request

REASONS = {-1: "", 0: "farther than `reject` under scale alone"}


@dataclass(frozen=True)
class PaperSettings:
    """Constants of the paper's method, and of the evidence for its verdict.

    Parameters
    ----------
    reject_share : float
        T1 as a share of the reference's diagonal: the paper's 108 px of 1392 x 1040.
    most_px : int
        Pictures are reduced to so many pixels: SIFT takes some 250 bytes a pixel.
    folds : int
        Spatial folds of matches, cells along either side.
    chance_trials, chance_matches : int
        Removals of matches that are paired at random, and how many matches each takes.
    seed : int
        Of the random pairs.
    """

    reject_share: float = 1 / 16
    most_px: int = 4_000_000
    folds: int = 5
    chance_trials: int = 5
    chance_matches: int = 1000
    seed: int = 20190817


SETTINGS = PaperSettings()


@dataclass(frozen=True)
class AlignedCamera:
    """One camera in the frame of one of its sensors.

    Parameters
    ----------
    images : sequence of BandImage
    sensor : str
        Whose native px the frame is.
    alignments : dict of sensor name to Transform
        Frame → native px of the sensor.
    values, valid : ndarray, (h, w)
        The grey picture.
    """

    images: Sequence[BandImage]
    sensor: str
    alignments: dict[str, Transform]
    values: np.ndarray
    valid: np.ndarray

    @classmethod
    def of(
        cls, images: Sequence[BandImage], sensor: str, given: Mapping[str, Any] | None
    ) -> AlignedCamera:
        """Align the sensors of a camera and average its bands."""
        alignments = align_sensors(images, given=given, first=sensor)
        return cls(images, sensor, alignments, *camera_grey(images, alignments, sensor))

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the frame."""
        return self.values.shape[1], self.values.shape[0]


def register_mirhashemi2019(request: Request, options: PaperOptions) -> Registration:
    """Register one camera by the paper's method.

    Of pairs given by hand those of the target's first sensor are used.

    Raises
    ------
    RegistrationRefused
        Where no polynomial can be fitted at all; with the trace so far.
    """
    named = (image.sensor for image in request.reference if image.label == request.reference_band)
    sensor = next(named)
    if request.is_own:
        return _own(request.reference, sensor, request.align)
    ours = AlignedCamera.of(request.reference, sensor, None)
    area = ObjectArea.of(np.ones(ours.valid.shape), request.region, request.outline)
    if request.outline is not None:  # nothing outside is used or judged
        ours = replace(ours, valid=ours.valid & area.compared)
    theirs = AlignedCamera.of(request.target, request.target[0].sensor, request.align)
    kind: dict[str, Any] = {
        "detector": options.detector or "sift",
        "matching": options.matching or "mutual-ratio",
        "ratio": options.ratio or RATIO,
    }
    region = request.region
    inside = request.target_region
    scale = scale_only(ours.size, theirs.size)
    if region is not None and inside is not None:
        scale = _scale_of_regions(region, inside)
    reject = options.reject or float(np.hypot(*ours.size)) * SETTINGS.reject_share
    terms = RemovalTerms(scale, reject, options.stop or 1.0, options.order or 3)
    hand = request.given.get(theirs.sensor, ManualPoints())
    matched = find_matches(
        ours, theirs, scale, (region, inside), may_be_none=len(hand.fixed) > 0, **kind
    )
    found = hand.mark(matched.reference, matched.target)
    cleaned = clean(
        found.target, found.reference, terms, size=ours.size, target_size=theirs.size,
        pinned=found.fixed, dropped=found.dropped,
    )  # fmt: skip
    matches, transform = _describe(found, cleaned, terms.stop), Inverse(cleaned.model)
    evidence = Evidence(
        transform, matches, (ours.values, ours.valid), (theirs.values, theirs.valid), terms,
        None if region is None else tuple(region), measure_apart(request.target, request.align),
        area.share_of(request.layer), area.compared,
    )  # fmt: skip
    if request.outline is not None:
        evidence = replace(evidence, region=box_of(area.compared))
    return Registration(
        method="mirhashemi2019",
        transforms=_spread(theirs, transform),
        verdict=judge(evidence),
        errors=_statistics(matches),
        matches=matches,
        trace=cleaned.trace,
        model={
            "kind": "polynomial",
            "order": terms.order,
            "direction": "target to reference",
            "parameters": 2 * len(cleaned.model.coefficients),
            "reject": terms.reject,
            "stop": terms.stop,
            **kind,
            "mask": area.to_dict(),
            "sensors": {name: t.to_dict() for name, t in theirs.alignments.items()},
        },
    )


def scale_only(size: tuple[int, int], target_size: tuple[int, int]) -> Affine:
    """Return the scale-only map target → reference of two frames (width, height): one scale, centre upon centre.

    Examples
    --------
    >>> scale_only((100, 80), (200, 160))(np.array([[0.5, 0.5], [199.5, 159.5]]))
    array([[ 0. ,  0. ], [99.5, 79.5]])
    """
    return _scale_of_regions((0, 0, *size), (0, 0, *target_size))


def _scale_of_regions(region: Sequence[float], target_region: Sequence[float]) -> Affine:
    ours, theirs = np.array(region, float), np.array(target_region, float)
    scale = float(np.sqrt(np.prod(ours[2:] / theirs[2:])))
    shift = (ours[:2] + ours[2:] / 2 - 0.5) - scale * (theirs[:2] + theirs[2:] / 2 - 0.5)
    return Affine(np.column_stack([scale * np.eye(2), shift]))


def find_matches(
    ours: AlignedCamera,
    theirs: AlignedCamera,
    scale: Affine,
    regions: tuple[Sequence[float] | None, Sequence[float] | None],
    *,
    detector: str,
    matching: str,
    ratio: float,
    may_be_none: bool = False,
) -> Matches:
    """Match key points of the grey pictures, a finer target brought to the reference's sampling."""
    most = [min(1.0, float(np.sqrt(SETTINGS.most_px / c.values.size))) for c in (ours, theirs)]
    a, back_a = _key_points(ours, regions[0], most[0], detector)
    matched = float(scale.matrix[0, 0]) * most[0]
    b, back_b = _key_points(theirs, regions[1], min(matched, most[1]), detector)
    rows, columns, _ = match(a, b, matching=matching, ratio=ratio)
    if not len(rows) and not may_be_none:
        raise _no_matches(a, b)
    return Matches.of(back_a(a.points[rows]), back_b(b.points[columns]))


def _key_points(
    camera: AlignedCamera, region: Sequence[float] | None, scale: float, detector: str
) -> tuple[KeyPoints, Affine]:
    valid = camera.valid & region_mask(region, camera.valid.shape)
    values, valid, back = area_average(camera.values, valid, scale)
    return find_key_points(stretch(values, valid), valid, detector=detector), back


def _describe(found: MarkedMatches, cleaned: Cleaned, stop: float) -> Matches:
    """Return the matches with their state: kept, or when and why they left."""
    reasons = np.array(
        [REASONS.get(r, f"worst of its round, above {stop:g} px") for r in cleaned.round], object
    )
    reasons = np.where(found.reason == "", reasons, found.reason)
    return Matches(
        reference=found.reference,
        target=found.target,
        residual=cleaned.residual,
        leave_one_out=cleaned.leave_one_out,
        weight=cleaned.kept.astype(float),
        state=np.where(cleaned.kept, MatchState.KEPT, MatchState.REMOVED).astype(object),
        reason=reasons,
        round=cleaned.round,
    )


def _statistics(matches: Matches) -> dict[str, Any]:
    kept = matches.residual[matches.kept]
    without = matches.leave_one_out[matches.kept]
    return {
        "matches": len(matches),
        "kept": len(kept),
        "mean": float(kept.mean()),
        "rms": float(np.sqrt(np.square(kept).mean())),
        "p95": float(np.percentile(kept, 95)),
        "max": float(kept.max()),
        "leave_one_out_mean": float(without.mean()),
        "leave_one_out_max": float(without.max()),
    }


def _spread(camera: AlignedCamera, transform: Transform) -> dict[str, Transform]:
    """Return for every band the map of the camera's frame, then that of its sensor."""
    transforms: dict[str, Transform] = {}
    for image in camera.images:
        same = image.sensor == camera.sensor
        transforms[image.label] = (
            transform if same else Composed(transform, camera.alignments[image.sensor])
        )
    return transforms


def _own(images: Sequence[BandImage], sensor: str, align: Mapping[str, Any] | None) -> Registration:
    """Return the reference camera itself: its bands stay, its other sensors are aligned."""
    aligned = align_sensors(images, given=align, first=sensor)
    reason = "The paper's method does not register the reference camera's own bands."
    numbers = {"align_apart_px": measure_apart(images, align or {}), "align_is_map": True}
    against = lies_where_declared(numbers)
    verdict = Verdict("accept", (reason,))
    if against is not None:
        verdict = Verdict("refuse", (against.reason,), against.next_step, numbers)
    return Registration(
        method="mirhashemi2019",
        transforms={image.label: aligned[image.sensor] for image in images},
        verdict=verdict,
        errors={},
        matches=Matches.none(),
        model={
            "kind": "identity",
            "sensors": {name: t.to_dict() for name, t in aligned.items()},
        },
    )


def _no_matches(a: KeyPoints, b: KeyPoints) -> RegistrationRefused:
    blank = [n for n, points in (("reference", a), ("target", b)) if len(points) == 0]
    message = (
        f"the {' and the '.join(blank)} have too little structure to match"
        if blank
        else "no key points match between the two pictures"
    )
    return RegistrationRefused(
        Problem(
            "E_MATCHES",
            message,
            field="registration",
            found=f"{len(a)} key points in the reference, {len(b)} in the target",
            expected="hundreds in both",
            fix="Check exposure and focus of both pictures, and that they show the same object.",
        )
    )


# --- evidence for the verdict


@dataclass(frozen=True)
class Evidence:
    """Evidence on a registration that rests on matches.

    Parameters
    ----------
    transform : Transform
        Reference px → px of the target's grey picture.
    matches : Matches
    reference, target : (values, valid), each (h, w), float32 and bool
        The grey pictures.
    terms : RemovalTerms
        On which outliers were removed.
    region : (x, y, width, height), reference px, or None
        Where the object lies.
    apart : float or None
        How far declared alignments lie from measured ones, px.
    object_share : float
        Share of the layer that shows the object.
    mask : ndarray of bool, (h, w), optional
        Where the object lies.
    """

    transform: Transform
    matches: Matches
    reference: tuple[np.ndarray, np.ndarray]
    target: tuple[np.ndarray, np.ndarray]
    terms: RemovalTerms
    region: tuple[float, ...] | None = None
    apart: float | None = None
    object_share: float = 1.0
    mask: np.ndarray | None = None

    @property
    def overlap(self) -> Overlap:
        """The part of the object that both pictures show."""
        return Overlap(self.transform, self.reference[1], self.target[1], self.region)


def judge(evidence: Evidence) -> Verdict:
    """Decide whether a registration on matches is accepted."""
    return judge_matches(measure(evidence))


def measure(evidence: Evidence) -> dict[str, Any]:
    """Return the numbers that the rules of the verdict take, by name."""
    matches = evidence.matches
    search = search_windows(
        evidence.reference, evidence.target, evidence.transform, region=evidence.region
    )
    # What a working pixel of the comparison cannot show is not held against the map.
    tolerance = max(evidence.terms.stop, search.step)
    checks = CheckWindows(
        search.centres, search.shift, search.found, tolerance, WINDOWS.window * search.step
    )
    return {
        "matches": len(matches),
        "kept": int(matches.kept.sum()),
        "terms": evidence.terms.coefficients,
        "stop": evidence.terms.stop,
        "tolerance": tolerance,
        **measure_chance(evidence, np.random.default_rng(SETTINGS.seed)),
        **measure_held_out(evidence),
        **_measure_shape(evidence),
        **measure_windows(checks),
        "second_peak_ratio": float(search.second_peak_ratio),
        **measure_support(evidence.overlap, checks, matches.reference[matches.kept]),
        **_measure_lines(evidence),
        "object_share": evidence.object_share,
        "align_apart_px": evidence.apart,
        "align_is_map": True,
    }


def _measure_shape(evidence: Evidence) -> dict[str, Any]:
    """Return the shape of the map over the overlap, which is a share of the object."""
    overlap, mask = evidence.overlap, evidence.mask
    shape = measure_shape(overlap)
    if mask is not None:
        shape["overlap"] = of_object(shape["overlap"], mask, overlap.box)
    return shape


def _measure_lines(evidence: Evidence) -> dict[str, Any]:
    """Return how lines of either grey picture lie beside the map."""
    (ours, valid), (theirs, shown) = evidence.reference, evidence.target
    inside = valid & region_mask(evidence.region, valid.shape)
    known = highpass(np.where(inside, ours, np.float32(np.nan)))[None]
    target = np.where(shown, theirs, np.float32(np.nan))
    lines = measure_line_displacement(known, target, evidence.transform)
    return {"line_displacement": lines and lines.to_dict()}


def measure_held_out(evidence: Evidence) -> dict[str, Any]:
    """Fit without one spatial block of matches at a time and predict those.

    Blocks, not single matches: neighbours err alike, so that single ones left out are no independent
    evidence.

    Returns
    -------
    numbers : dict
        ``held_out_median``, ``held_out_p90``, reference px; infinite where a fit is not possible.
    """
    kept = evidence.matches.kept
    reference, target = evidence.matches.reference[kept], evidence.matches.target[kept]
    errors = np.full(len(reference), np.inf)
    fold = _folds(reference)
    for k in np.unique(fold):
        out = fold == k
        if (~out).sum() >= evidence.terms.coefficients:
            model = Polynomial.fit(target[~out], reference[~out], order=evidence.terms.order)
            errors[out] = np.linalg.norm(model(target[out]) - reference[out], axis=1)
    if not len(errors):
        return {"held_out_median": np.inf, "held_out_p90": np.inf}
    # Order statistics, not interpolation, which is undefined between two infinities.
    middle, high = np.percentile(errors, (50, 90), method="lower")
    return {"held_out_median": float(middle), "held_out_p90": float(high)}


def _folds(points: np.ndarray) -> np.ndarray:
    """Deal the cells of a 5 x 5 grid to folds so that no two neighbours share one."""
    if not len(points):
        return np.empty(0, int)
    n = SETTINGS.folds
    low, high = points.min(0), points.max(0)
    cell = np.clip(((points - low) / np.maximum(high - low, 1e-9) * n).astype(int), 0, n - 1)
    return (cell[:, 0] + 2 * cell[:, 1]) % n


def measure_chance(evidence: Evidence, rng: np.random.Generator) -> dict[str, Any]:
    """Count how many matches the same removal keeps where they are paired at random.

    Returns
    -------
    numbers : dict
        ``chance_kept``: the most that were kept in five trials with as many matches, each paired
        with a random place within `reject`.
    """
    matches, terms, limit = evidence.matches, evidence.terms, SETTINGS.chance_matches
    near = matches.round != 0
    placed = terms.scale(matches.target[near])
    used = placed if len(placed) <= limit else rng.permutation(placed)[:limit]
    most = 0
    for _ in range(SETTINGS.chance_trials):
        angle = rng.uniform(0, 2 * np.pi, len(used))
        radius = terms.reject * np.sqrt(rng.uniform(0, 1, len(used)))
        paired = used + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
        most = max(most, _count_kept(used, paired, terms))
    # Beyond what the coefficients absorb, the count grows with the number of matches.
    more = most - terms.coefficients
    return {"chance_kept": round(terms.coefficients + more * max(1.0, len(placed) / limit))}


def _count_kept(target: np.ndarray, reference: np.ndarray, terms: RemovalTerms) -> int:
    near = replace(terms, scale=Affine.identity(), reject=2 * terms.reject)
    try:
        return len(target) - sum(step.removed for step in remove_outliers(target, reference, near))
    except RegistrationRefused:
        return terms.coefficients
