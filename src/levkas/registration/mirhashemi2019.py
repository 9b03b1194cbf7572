"""The registration of [mirhashemi2019]_, section 3.5, nothing cleverer than the paper.

SIFT on the mean of all bands of each sensor, matching, one cut at `reject` under scale alone, the
worst pair removed until the largest error is at most `stop`, and a third-order polynomial fitted
target → reference. Its inverse is what a resampling needs. All bands of a sensor share one map:
the paper leaves them as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas.geometry.transforms import Affine, Inverse, Polynomial, Transform
from levkas.registration.bands import area_average, grey, region_mask, stretch
from levkas.registration.features import KeyPoints, find_key_points
from levkas.registration.foreground import ObjectArea
from levkas.registration.manual_points import ManualPoints
from levkas.registration.matching import RATIO, match
from levkas.registration.outliers import Cleaned, RemovalTerms, clean
from levkas.registration.record import (
    Matches,
    MatchState,
    Registration,
    Verdict,
    refusal,
)
from levkas.registration.starts import declared_map, distance_between, read_alignments
from levkas.registration.verdict import ONLY, Evidence, judge
from levkas.registration.verification import Overlap, box_of, measure_shape, measure_windows
from levkas.registration.window_matching import SETTINGS as WINDOWS
from levkas.registration.window_matching import CheckWindows, search_windows

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.registration.methods import PaperOptions
    from levkas.registration.request import Request

REJECT_SHARE = 1 / 16
"""T1 as a share of the reference's diagonal: the paper's 108 px of 1392 x 1040."""
MOST_PX = 4_000_000
"""Pictures are reduced to so many pixels: SIFT takes some 250 bytes a pixel."""
FOLDS = 5
"""Spatial folds of matches, cells along either side."""


@dataclass(frozen=True)
class SensorPicture:
    """Grey picture of one sensor, (h, w), and the region (x, y, width, height) of it that shows the object, px."""

    values: np.ndarray
    valid: np.ndarray
    region: tuple[float, ...] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.values.shape[1], self.values.shape[0]

    def key_points(self, scale: float, detector: str) -> tuple[KeyPoints, Affine]:
        """Return the key points of the picture reduced to `scale`, and reduced px → px."""
        valid = self.valid & region_mask(self.region, self.valid.shape)
        values, valid, back = area_average(self.values, valid, scale)
        return find_key_points(stretch(values, valid), valid, detector=detector), back


class MatchedSensor(NamedTuple):
    """One sensor registered: px of the reference → its px, pairs, and what the verdict rests on."""

    transform: Transform
    matches: Matches
    cleaned: Cleaned
    evidence: Evidence


def register_mirhashemi2019(request: Request, options: PaperOptions) -> Registration:
    """Register one camera by the paper's method, every sensor by itself.

    Raises RegistrationRefused where no polynomial can be fitted at all; with the trace so far.
    """
    sensor = next(i.sensor for i in request.reference if i.label == request.reference_band)
    area, ours = _reference(request, sensor)
    names = list(dict.fromkeys(image.sensor for image in request.target))
    known: dict[str, Transform] = {sensor: Affine.identity()} if request.is_own else {}
    align = {names[0]: Affine.identity()} | read_alignments(request.align)
    found: dict[str, MatchedSensor] = {}
    for name in names:
        if name in known:
            continue
        images = [image for image in request.target if image.sensor == name]
        inside = request.target_region if name == names[0] else None
        theirs = SensorPicture(*grey(images), None if inside is None else tuple(inside))
        mask = area.compared if request.outline is not None else None
        one = _register_sensor(ours, theirs, options, request.given.get(name, ManualPoints()), mask)
        declared = declared_map(name, align, known)
        apart = None
        if declared is not None:
            apart = distance_between(one.transform, declared, ours.values.shape)
        found[name] = one._replace(evidence=replace(one.evidence, align_apart_px=apart))
        known[name] = one.transform
    transforms = {image.label: known[image.sensor] for image in request.target}
    if not found:
        reason = "The paper's method does not register the reference camera's own bands."
        return Registration(
            "mirhashemi2019", transforms, Verdict("accept", (reason,)), {}, Matches.none(),
            model={"kind": "identity"},
        )  # fmt: skip
    first, *rest = found
    cleaned, share = found[first].cleaned, area.share_of(request.layer)
    evidence = {n or ONLY: replace(o.evidence, object_share=share) for n, o in found.items()}
    return Registration(
        method="mirhashemi2019",
        transforms=transforms,
        verdict=judge(evidence, share),
        errors=_statistics(found[first].matches),
        matches=found[first].matches,
        trace=cleaned.trace,
        model={
            "kind": "polynomial",
            "order": cleaned.trace.order,
            "direction": "target to reference",
            "parameters": 2 * len(cleaned.model.coefficients),
            "reject": cleaned.trace.reject,
            "stop": cleaned.trace.stop,
            **_kind(options),
            "mask": area.to_dict(),
        },
        others={name: found[name].matches for name in rest},
    )


def _reference(request: Request, sensor: str) -> tuple[ObjectArea, SensorPicture]:
    """Return where the object lies in the reference, and its grey picture; nothing outside a declared outline is used or judged."""
    values, valid = grey([image for image in request.reference if image.sensor == sensor])
    area = ObjectArea.of(np.ones(valid.shape), request.region, request.outline)
    region = None if request.region is None else tuple(request.region)
    if request.outline is not None:
        valid, region = valid & area.compared, box_of(area.compared)
    return area, SensorPicture(values, valid, region)


def _kind(options: PaperOptions) -> dict[str, Any]:
    return {
        "detector": options.detector or "sift",
        "matching": options.matching or "mutual-ratio",
        "ratio": options.ratio or RATIO,
    }


def _register_sensor(
    ours: SensorPicture,
    theirs: SensorPicture,
    options: PaperOptions,
    hand: ManualPoints,
    mask: np.ndarray | None,
) -> MatchedSensor:
    """Register one sensor, and measure what a verdict needs; `mask`, (h, w) bool, is where the object is declared to lie."""
    scale = scale_only(ours.size, theirs.size)
    if ours.region is not None and theirs.region is not None:
        scale = _scale_of_regions(ours.region, theirs.region)
    reject = options.reject or float(np.hypot(*ours.size)) * REJECT_SHARE
    terms = RemovalTerms(scale, reject, options.stop or 1.0, options.order or 3)
    matched = find_matches(ours, theirs, scale, may_be_none=len(hand.fixed) > 0, **_kind(options))
    found = hand.mark(matched.reference, matched.target)
    cleaned = clean(
        found.target, found.reference, terms, size=ours.size, target_size=theirs.size,
        pinned=found.fixed, dropped=found.dropped,
    )  # fmt: skip
    reasons = np.full(len(found.reason), f"worst of its round, above {terms.stop:g} px", object)
    reasons[cleaned.round == 0] = "farther than `reject` under scale alone"
    reasons[cleaned.kept] = ""
    matches = Matches.of(
        found.reference,
        found.target,
        residual=cleaned.residual,
        leave_one_out=cleaned.leave_one_out,
        weight=cleaned.kept.astype(float),
        state=np.where(cleaned.kept, MatchState.KEPT, MatchState.REMOVED).astype(object),
        reason=np.where(found.reason == "", reasons, found.reason),
        round=cleaned.round,
    )
    transform = Inverse(cleaned.model)
    evidence = measure(transform, matches, ours, theirs, terms, mask)
    return MatchedSensor(transform, matches, cleaned, evidence)


def scale_only(size: tuple[int, int], target_size: tuple[int, int]) -> Affine:
    """Return the scale-only map target → reference of two frames (width, height): one scale, centre upon centre.

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
    ours: SensorPicture,
    theirs: SensorPicture,
    scale: Affine,
    *,
    detector: str,
    matching: str,
    ratio: float,
    may_be_none: bool = False,
) -> Matches:
    """Match key points of the grey pictures, a finer target brought to the reference's sampling."""
    most = [min(1.0, float(np.sqrt(MOST_PX / one.values.size))) for one in (ours, theirs)]
    a, back_a = ours.key_points(most[0], detector)
    matched = float(scale.matrix[0, 0]) * most[0]
    b, back_b = theirs.key_points(min(matched, most[1]), detector)
    rows, columns, _ = match(a, b, matching=matching, ratio=ratio)
    if not len(rows) and not may_be_none:
        blank = [n for n, points in (("reference", a), ("target", b)) if len(points) == 0]
        raise refusal(
            "E_MATCHES",
            f"the {' and the '.join(blank)} have too little structure to match"
            if blank
            else "no key points match between the two pictures",
            field="registration",
            found=f"{len(a)} key points in the reference, {len(b)} in the target",
            expected="hundreds in both",
            fix="Check exposure and focus of both pictures, and that they show the same object.",
        )
    return Matches.of(back_a(a.points[rows]), back_b(b.points[columns]))


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


# --- evidence for the verdict


def measure(
    transform: Transform,
    matches: Matches,
    ours: SensorPicture,
    theirs: SensorPicture,
    terms: RemovalTerms,
    mask: np.ndarray | None = None,
) -> Evidence:
    """Return the evidence on a map; `mask`, (h, w) bool, is where the object lies in the reference."""
    search = search_windows(
        (ours.values, ours.valid), (theirs.values, theirs.valid), transform, region=ours.region
    )
    # What a working pixel of the comparison cannot show is not held against the map.
    tolerance = max(terms.stop, search.step)
    checks = CheckWindows(
        search.centres, search.shift, search.found, tolerance, WINDOWS.window * search.step
    )
    overlap = Overlap(transform, ours.valid, theirs.valid, ours.region)
    median, worst = measure_held_out(matches, terms)
    return Evidence(
        basis="matches",
        kept=int(matches.kept.sum()),
        terms=terms.coefficients,
        held_out_px=median,
        held_out_p90=worst,
        second_peak_ratio=float(search.second_peak_ratio),
        **measure_shape(overlap, mask),
        **measure_windows(overlap, checks, matches.reference[matches.kept]),
    )


def measure_held_out(matches: Matches, terms: RemovalTerms) -> tuple[float, float]:
    """Return the median error and that of one in ten of matches, reference px, in spatial blocks that were not fitted; infinite where no fit is possible.

    Neighbours err alike, so that single matches left out are no independent evidence.
    """
    reference, target = matches.reference[matches.kept], matches.target[matches.kept]
    errors = np.full(len(reference), np.inf)
    fold = np.empty(0, int)
    if len(reference):  # cells of a 5 x 5 grid, dealt to folds so that no two neighbours share one
        low, high = reference.min(0), reference.max(0)
        cell = ((reference - low) / np.maximum(high - low, 1e-9) * FOLDS).astype(int)
        fold = np.minimum(cell, FOLDS - 1) @ (1, 2) % FOLDS
    for k in np.unique(fold):
        out = fold == k
        if (~out).sum() >= terms.coefficients:
            model = Polynomial.fit(target[~out], reference[~out], order=terms.order)
            errors[out] = np.linalg.norm(model(target[out]) - reference[out], axis=1)
    if not len(errors):
        return np.inf, np.inf
    # Order statistics, not interpolation, which is undefined between two infinities.
    middle, high = np.percentile(errors, (50, 90), method="lower")
    return float(middle), float(high)
