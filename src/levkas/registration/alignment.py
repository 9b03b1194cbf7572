"""Alignment of the sensors of one camera: first sensor's px → each sensor's px, given or measured."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Problem
from levkas.geometry.transforms import Affine, Composed, Inverse, Transform
from levkas.registration.bands import BandImage, grey, pull, stretch
from levkas.registration.features import find_key_points
from levkas.registration.matching import match
from levkas.registration.outliers import RemovalTerms, remove_outliers
from levkas.registration.record import RegistrationRefused

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

#: Share of the diagonal beyond which matches are cut, and largest error, px, that is kept.
REJECT_SHARE, STOP_PX = 1 / 16, 1.0
#: Matches that have to be kept.
LEAST_MATCHES = 12


def sensors_of(images: Sequence[BandImage]) -> dict[str, list[BandImage]]:
    """Group bands by sensor, in the order in which sensors are first met."""
    groups: dict[str, list[BandImage]] = {}
    for image in images:
        groups.setdefault(image.sensor, []).append(image)
    return groups


def align_sensors(
    images: Sequence[BandImage],
    *,
    given: Mapping[str, Any] | None = None,
    first: str | None = None,
) -> dict[str, Transform]:
    """Find how the sensors of one camera lie to one another.

    Parameters
    ----------
    images : sequence of BandImage
    given : mapping of sensor name to (2, 3) matrix or Transform, optional
        Native px of the first sensor → this sensor, where it is known.
    first : str, optional
        The sensor that all are aligned to instead of the first that is met.

    Returns
    -------
    alignments : dict of sensor name to Transform
        Px of that sensor → px of each; the identity for itself.

    Raises
    ------
    RegistrationRefused
        Where two sensors show too little in common, or a matrix is not (2, 3).

    Notes
    -----
    The sensors look through one lens, so that they differ by little: matches farther apart than
    1/16 of the diagonal are cut at once, and the worst removed until none is above 1 px.
    """
    groups = sensors_of(images)
    origin = next(iter(groups))
    known = read_alignments(given or {})
    alignments: dict[str, Transform] = {}
    for name in groups:
        if name == origin:
            alignments[name] = Affine.identity()
        elif name in known:
            alignments[name] = known[name]
        else:
            alignments[name] = _measure(groups[origin], groups[name])
    if first is None or first == origin:
        return alignments
    back = Inverse(alignments[first])
    return {
        name: Affine.identity() if name == first else Composed(back, transform)
        for name, transform in alignments.items()
    }


def read_alignments(given: Mapping[str, Any]) -> dict[str, Transform]:
    """Return declared alignments as maps; raises RegistrationRefused where a matrix is not (2, 3)."""
    return {name: _transform(name, matrix) for name, matrix in given.items()}


def declared_map(
    name: str, align: Mapping[str, Transform], known: Mapping[str, Transform]
) -> Transform | None:
    """Return reference px → px of a sensor by its declared alignment to one whose map is known; None without any.

    `align` are maps from the first sensor's px, `known` from reference px.

    Examples
    --------
    >>> align = {"ccd1": Affine.identity(), "ccd2": Affine(np.array([[1.0, 0, 5], [0, 1, 0]]))}
    >>> found = declared_map("ccd2", align, {"ccd1": Affine.scaling(2.0)})
    >>> found(np.array([[10.0, 20.0]])).tolist()
    [[25.5, 40.5]]
    """
    for other, transform in known.items():
        if other != name and other in align and name in align:
            return Composed(transform, Inverse(align[other]), align[name])
    return None


def measure_apart(images: Sequence[BandImage], given: Mapping[str, Any]) -> float | None:
    """Return how far declared alignments lie from what key points measure, px of a sensor, the median; of several the largest.

    None where nothing is declared, or nothing can be measured.
    """
    groups = sensors_of(images)
    origin = next(iter(groups))
    width, height = groups[origin][0].size
    x, y = np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 9))
    points = np.stack([x, y], -1).reshape(-1, 2)
    apart = []
    for name, declared in read_alignments(given).items():
        if name == origin or name not in groups:
            continue
        try:
            measured = _measure(groups[origin], groups[name])
        except RegistrationRefused:
            continue
        apart.append(np.median(np.linalg.norm(measured(points) - declared(points), axis=1)))
    return float(max(apart)) if apart else None


def camera_grey(
    images: Sequence[BandImage], alignments: Mapping[str, Transform], first: str
) -> tuple[np.ndarray, np.ndarray]:
    """Average all bands of a camera in the frame of its sensor `first`.

    Returns
    -------
    values, valid : ndarray, (h, w), float32 and bool
        As `bands.grey` gives them; a pixel is valid where every sensor saw it.
    """
    groups = sensors_of(images)
    values, valid = grey(groups[first])
    if len(groups) == 1:
        return values, valid
    total = values * np.float64(len(groups[first]))
    for name, bands in groups.items():
        if name != first:
            part, inside = pull(*grey(bands), alignments[name], values.shape)
            total += part * len(bands)
            valid &= inside
    return (total / len(images)).astype(np.float32), valid


def _measure(first: list[BandImage], other: list[BandImage]) -> Affine:
    """Fit first → other to key points that both greys share."""
    pictures = []
    for bands in (first, other):
        values, valid = grey(bands)
        pictures.append((stretch(values, valid), valid))
    points = [find_key_points(picture, valid) for picture, valid in pictures]
    rows, columns, _ = match(points[0], points[1])
    a, b = points[0].points[rows], points[1].points[columns]
    scale = Affine.scaling(*np.divide(first[0].size, other[0].size))
    reject = REJECT_SHARE * float(np.hypot(*first[0].size))
    try:
        rounds = list(remove_outliers(b, a, RemovalTerms(scale, reject, STOP_PX, order=1)))
    except RegistrationRefused as refusal:
        raise _apart(first, other, len(a)) from refusal
    kept = np.linalg.norm(scale(b) - a, axis=1) < reject
    kept[[step.worst for step in rounds if step.removed]] = False
    if kept.sum() < LEAST_MATCHES:
        raise _apart(first, other, int(kept.sum()))
    return Affine.fit(a[kept], b[kept])


def _transform(name: str, given: Any) -> Transform:
    if isinstance(given, Transform):
        return given
    matrix = np.asarray(given, float)
    if matrix.shape != (2, 3) or not np.isfinite(matrix).all():
        raise RegistrationRefused(
            Problem(
                "E_VALUE",
                f"the alignment of sensor {name!r} is not a matrix of numbers",
                field="align",
                found=str(matrix.shape),
                expected="2 rows of 3 numbers: px of the first sensor → px of this one",
            )
        )
    return Affine(matrix)


def _apart(first: list[BandImage], other: list[BandImage], found: int) -> RegistrationRefused:
    names = f"{first[0].sensor!r} and {other[0].sensor!r}"
    return RegistrationRefused(
        Problem(
            "E_MATCHES",
            f"sensors {names} have too little common detail to be aligned",
            field="align",
            found=f"{found} matches",
            expected=f"at least {LEAST_MATCHES}",
            fix="Give the 2x3 matrix as `align`, or align on an object with more structure.",
        )
    )
