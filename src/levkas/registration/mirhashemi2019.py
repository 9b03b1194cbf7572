"""The registration of [mirhashemi2019]_, section 3.5, as a named mode: nothing cleverer than the paper.

SIFT on the mean of all bands of each camera, matching, one cut at `reject` under scale alone, the
worst pair removed until the largest error is at most `stop`, and a third-order polynomial fitted
target → reference. Its inverse is what a resampling needs. All bands of a sensor share one map:
the paper leaves them as they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Problem
from levkas.geometry.transforms import Affine, Composed, Inverse, Transform
from levkas.registration.alignment import align_sensors, camera_grey
from levkas.registration.arguments import check_thresholds
from levkas.registration.features import KeyPoints, find_key_points
from levkas.registration.images import BandImage, area_average, stretch
from levkas.registration.manual_points import Given, Marked
from levkas.registration.matching import RATIO, match
from levkas.registration.outliers import Cleaned, clean
from levkas.registration.record import Matches, Registration, RegistrationRefused, Verdict
from levkas.registration.verdict import Evidence, judge

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

REJECT_SHARE = 1 / 16
#: SIFT takes some 250 bytes a pixel: larger pictures are reduced first.
MOST_PX = 4_000_000
REASONS = {-1: "", 0: "farther than `reject` under scale alone"}


@dataclass(frozen=True)
class Camera:
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
    ) -> Camera:
        """Align the sensors of a camera and average its bands."""
        alignments = align_sensors(images, given=given, first=sensor)
        return cls(images, sensor, alignments, *camera_grey(images, alignments, sensor))

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the frame."""
        return self.values.shape[1], self.values.shape[0]


def register_mirhashemi2019(
    reference: Sequence[BandImage],
    target: Sequence[BandImage],
    *,
    reference_band: str,
    reject: float | None = None,
    stop: float = 1.0,
    region: Sequence[float] | None = None,
    rng: np.random.Generator | None = None,
    target_region: Sequence[float] | None = None,
    align: Mapping[str, Any] | None = None,
    order: int = 3,
    detector: str = "sift",
    matching: str = "mutual-ratio",
    ratio: float = RATIO,
    given: Mapping[str, Given] | None = None,
) -> Registration:
    """Register one camera by the paper's method.

    Parameters
    ----------
    reference, target, reference_band, stop, rng
        As `levkas.registration.register` takes them.
    reject : float, reference px, optional
        T1; without it 1/16 of the reference's diagonal, which is the paper's 108 px for 1392x1040.
    region, target_region : (x, y, width, height), optional
        Where the object lies in reference px, and in native px of the target's first sensor; the
        paper crops both. Scale alone maps one to the other where both are given, else the frames.
    align : mapping of sensor name to (2, 3) matrix or Transform, optional
        Of a target with several sensors: first sensor's px → this sensor's; measured without it.
    order : int
        Of the polynomial.
    detector, matching : str
        Keys of `features.DETECTORS` and `matching.METHODS`.
    ratio : float
        Largest ratio of nearest to second nearest descriptor.
    given : mapping of sensor name to Given, optional
        Pairs by hand; those of the target's first sensor are used.

    Returns
    -------
    registration : Registration

    Raises
    ------
    RegistrationRefused
        Where no polynomial can be fitted at all; with the trace so far.
    """
    problems = check_thresholds(reject, stop)
    if problems:
        raise RegistrationRefused(*problems)
    sensor = next(image.sensor for image in reference if image.label == reference_band)
    if target is reference:
        return _own(reference, sensor, align)
    ours = Camera.of(reference, sensor, None)
    theirs = Camera.of(target, target[0].sensor, align)
    reject = float(np.hypot(*ours.size)) * REJECT_SHARE if reject is None else float(reject)
    scale = scale_only(ours.size, theirs.size, region, target_region)
    hand = (given or {}).get(theirs.sensor, Given())
    matched = find_matches(
        ours, theirs, scale, region, target_region,
        detector=detector, matching=matching, ratio=ratio, none_is_well=len(hand.sure) > 0,
    )  # fmt: skip
    found = hand.mark(matched.reference, matched.target)
    cleaned = clean(
        found.target, found.reference, scale=scale, reject=reject, stop=stop,
        size=ours.size, target_size=theirs.size, order=order,
        pinned=found.sure, dropped=found.dropped,
    )  # fmt: skip
    matches = _describe(found, cleaned, stop)
    transform = Inverse(cleaned.model)
    evidence = Evidence(
        transform=transform,
        matches=matches,
        reference=(ours.values, ours.valid),
        target=(theirs.values, theirs.valid),
        region=None if region is None else tuple(region),
        scale=scale,
        reject=reject,
        stop=stop,
        order=order,
    )
    return Registration(
        method="mirhashemi2019",
        transforms=_spread(theirs, transform),
        verdict=judge(evidence, rng=rng),
        errors=_statistics(matches),
        matches=matches,
        trace=cleaned.trace,
        model={
            "kind": "polynomial",
            "order": order,
            "direction": "target to reference",
            "parameters": 2 * len(cleaned.model.coefficients),
            "reject": reject,
            "stop": stop,
            "detector": detector,
            "matching": matching,
            "ratio": ratio,
            "sensors": {name: t.to_dict() for name, t in theirs.alignments.items()},
        },
    )


def scale_only(
    size: tuple[int, int],
    target_size: tuple[int, int],
    region: Sequence[float] | None = None,
    target_region: Sequence[float] | None = None,
) -> Affine:
    """Return the scale-only map target → reference: one scale, centre upon centre.

    Parameters
    ----------
    size, target_size : (width, height)
    region, target_region : (x, y, width, height), optional
        The object in either picture; used where both are given.

    Examples
    --------
    >>> scale_only((100, 80), (200, 160))(np.array([[0.5, 0.5], [199.5, 159.5]]))
    array([[ 0. ,  0. ], [99.5, 79.5]])
    """
    if region is None or target_region is None:
        region, target_region = (0, 0, *size), (0, 0, *target_size)
    ours, theirs = np.array(region, float), np.array(target_region, float)
    scale = float(np.sqrt(np.prod(ours[2:] / theirs[2:])))
    shift = (ours[:2] + ours[2:] / 2 - 0.5) - scale * (theirs[:2] + theirs[2:] / 2 - 0.5)
    return Affine(np.column_stack([scale * np.eye(2), shift]))


def find_matches(
    ours: Camera,
    theirs: Camera,
    scale: Affine,
    region: Sequence[float] | None,
    target_region: Sequence[float] | None,
    *,
    detector: str,
    matching: str,
    ratio: float,
    none_is_well: bool = False,
) -> Matches:
    """Match key points of the grey pictures, a finer target brought to the reference's sampling."""
    most = [min(1.0, float(np.sqrt(MOST_PX / c.values.size))) for c in (ours, theirs)]
    a, back_a = _key_points(ours, region, most[0], detector)
    matched = float(scale.matrix[0, 0]) * most[0]
    b, back_b = _key_points(theirs, target_region, min(matched, most[1]), detector)
    rows, columns, _ = match(a, b, matching=matching, ratio=ratio)
    if not len(rows) and not none_is_well:
        raise _no_matches(a, b)
    return Matches.of(back_a(a.points[rows]), back_b(b.points[columns]))


def _key_points(
    camera: Camera, region: Sequence[float] | None, scale: float, detector: str
) -> tuple[KeyPoints, Affine]:
    valid = camera.valid
    if region is not None:
        x, y, w, h = (round(float(v)) for v in region)
        inside = np.zeros_like(valid)
        inside[max(y, 0) : max(y + h, 0), max(x, 0) : max(x + w, 0)] = True
        valid = valid & inside
    values, valid, back = area_average(camera.values, valid, scale)
    return find_key_points(stretch(values, valid), valid, detector=detector), back


def _describe(found: Marked, cleaned: Cleaned, stop: float) -> Matches:
    """Say of every match whether it was kept, or when and why it left."""
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
        state=np.where(cleaned.kept, "kept", "removed").astype(object),
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


def _spread(camera: Camera, transform: Transform) -> dict[str, Transform]:
    """Give every band the map of the camera's frame, then that of its sensor."""
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
    empty = np.empty((0, 2))
    reason = "The paper's method leaves the reference camera's own bands where they are."
    return Registration(
        method="mirhashemi2019",
        transforms={image.label: aligned[image.sensor] for image in images},
        verdict=Verdict("accept", (reason,)),
        errors={},
        matches=Matches.of(empty, empty),
        model={
            "kind": "identity",
            "sensors": {name: t.to_dict() for name, t in aligned.items()},
        },
    )


def _no_matches(a: KeyPoints, b: KeyPoints) -> RegistrationRefused:
    blank = [n for n, points in (("reference", a), ("target", b)) if len(points) == 0]
    message = (
        f"the {' and the '.join(blank)} show no structure to match"
        if blank
        else "no key point of one picture looks like one of the other"
    )
    return RegistrationRefused(
        Problem(
            "E_MATCHES",
            message,
            field="registration",
            found=f"{len(a)} key points in the reference, {len(b)} in the target",
            expected="hundreds in both",
            fix="Look at both pictures: exposure, focus, and whether they show the same object.",
        )
    )
