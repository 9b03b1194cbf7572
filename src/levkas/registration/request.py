"""Request of a registration, and the checks of its bands, region and options."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, ValidationError

from levkas.core.problems import Problem
from levkas.core.requirements import requirement
from levkas.registration.methods import UNUSABLE
from levkas.registration.record import RegistrationRefused

if TYPE_CHECKING:
    from levkas.geometry.transforms import Transform
    from levkas.registration.bands import BandImage
    from levkas.registration.foreground import Corners
    from levkas.registration.manual_points import ManualPoints
    from levkas.registration.predictors import PreparedReference
    from levkas.registration.record import Sigma

LEAST_SIDE_PX = 16


@dataclass(frozen=True)
class Request:
    """Two cameras to be registered; a method uses the fields that it needs."""

    reference: Sequence[BandImage]
    target: Sequence[BandImage]
    """The same sequence for the reference camera's own bands."""
    reference_band: str
    """Label of the band of `reference` that defines reference px."""
    region: Sequence[float] | None = None
    """In reference px: of the published frame; nothing outside is used or judged."""
    outline: Corners | None = None
    """In reference px: of the object, where it is declared: nothing outside is used or judged."""
    layer: Corners | None = None
    """In reference px: of the published frame, of which shares are given; without it the region, or the whole frame."""
    target_region: Sequence[float] | None = None
    """The object in native px of the target's first sensor: scale alone maps one region to the other."""
    given: Mapping[str, ManualPoints] = field(default_factory=dict)
    """Pairs given by hand."""
    reference_transforms: Mapping[str, Transform] | None = None
    """Of the reference camera's own bands, from its own registration: saves measuring them again."""
    reference_sigma: Mapping[str, Sigma] | None = None
    """Uncertainty of those."""
    prepared: Callable[[], PreparedReference] | None = None
    """Returns the reference made ready: saves preparing it for every camera."""
    align: Mapping[str, Any] = field(default_factory=dict)
    """Of a target with several sensors, where it is declared: first sensor's px → this sensor's."""
    one_scan: bool = False
    """Whether bands of a sensor of the target share one map, and may be sampled up to 30 times as coarsely as the reference."""

    @property
    def is_own(self) -> bool:
        """Whether the reference camera's own bands are to be registered."""
        return self.target is self.reference


def read_options(model: type[BaseModel], options: Mapping[str, Any]) -> BaseModel:
    """Return the options of a method, checked; raises `RegistrationRefused` with all that is wrong."""
    known = {name: value for name, value in options.items() if value is not None}
    problems = check_thresholds(known.get("reject"), known.get("stop", 1.0))
    named = {problem.field for problem in problems}
    try:
        read = model.model_validate(known)
    except ValidationError as error:
        for one in error.errors():
            name, text = str(one["loc"][0]), requirement(str(one["msg"]))
            at = {"field": f"registration.{name}", "found": one["input"]}
            if at["field"] not in named:
                problems.append(Problem("E_VALUE", f"{name} {text}", **at))
    if problems:
        raise RegistrationRefused(*problems)
    return read


def check_request(request: Request, method: str, methods: Collection[str]) -> None:
    """Raise `RegistrationRefused` with everything that is wrong with a request."""
    problems, known = [], ", ".join(sorted(methods))
    if method not in methods:
        why = f": {UNUSABLE[method]}" if method in UNUSABLE else ""
        problems.append(_wrong("method", method, known, f"unknown method {method!r}{why}"))
    problems += _check_bands("reference", request.reference)
    problems += [] if request.is_own else _check_bands("target", request.target)
    labels, band = [image.label for image in request.reference], request.reference_band
    if labels and band not in labels:
        at = {"field": "reference_band", "found": band, "expected": ", ".join(labels[:12])}
        problems.append(Problem("E_BAND_MISSING", f"unknown reference band {band!r}", **at))
    region = request.region
    if region is not None and not (
        len(region) == 4 and all(map(isfinite, region)) and min(region[2:]) > 0
    ):
        problems.append(_wrong("region", tuple(region), "x, y, width, height; both > 0"))
    if request.outline is not None and labels:
        problems += check_outline(request.outline, request.reference[0].size)
    if problems:
        raise RegistrationRefused(*problems)


def check_thresholds(reject: float | None, stop: float) -> list[Problem]:
    """Return what is wrong with T1 and T2: both finite and positive, `stop` below `reject`.

    >>> [p.field for p in check_thresholds(108.0, 0.0)]
    ['registration.stop']
    """
    problems = [
        _wrong(name, value, "a finite number of reference pixels > 0")
        for name, value in (("reject", reject), ("stop", stop))
        if value is not None and not _is_positive(value)
    ]
    if not problems and reject is not None and reject <= stop:
        problems.append(_wrong("reject", reject, f"more than stop, which is {stop}"))
    return problems


def _is_positive(value: Any) -> bool:
    number = isinstance(value, (int, float, np.integer, np.floating))
    return bool(number and not isinstance(value, bool) and isfinite(value) and value > 0)


def _wrong(name: str, value: Any, expected: str, message: str = "") -> Problem:
    message = message or f"the value of `{name}` is not valid"
    return Problem("E_VALUE", message, field=f"registration.{name}", found=value, expected=expected)


def _check_bands(name: str, images: Sequence[BandImage]) -> list[Problem]:
    if not len(images):
        return [Problem("E_BAND_MISSING", f"the {name} has no bands", field=name, found=0)]
    problems = []
    labels = [image.label for image in images]
    twice = ", ".join(sorted({label for label in labels if labels.count(label) > 1}))
    if twice:
        text = f"two bands of the {name} have the same label"
        problems.append(Problem("E_BAND_TWICE", text, field=name, found=twice))
    sizes: dict[str, tuple[int, int]] = {}
    for image in images:
        size, whole = image.size, sizes.setdefault(image.sensor, image.size)
        differ, small = size != whole, min(size) < LEAST_SIDE_PX
        for wrong, text, expected in (
            (differ, f"bands of one sensor of the {name} differ in size", whole),
            (
                small,
                f"a band of the {name} is too small to register",
                f">= {LEAST_SIDE_PX} px a side",
            ),
        ):
            if wrong:
                problems.append(Problem("E_SIZE", text, None, image.label, size, expected))
    return problems


def check_outline(outline: Corners, size: tuple[int, int]) -> list[Problem]:
    """Return what is wrong with an outline, (n, 2) px, in a frame (width, height): few corners, or some outside.

    >>> [p.field for p in check_outline([(0, 0), (90, 0), (90, 50)], (80, 60))]
    ['outline']
    """
    corners = np.asarray(outline, float).reshape(-1, 2)
    if len(corners) < 3 or not np.isfinite(corners).all():
        return [_wrong("outline", len(corners), "three or more corners (x, y)")]
    # Half a pixel at the rim belongs to the frame, and hands write its width for its last column.
    outside = ((corners < -1) | (corners > np.array(size))).any(1)
    if not outside.any():
        return []
    return [
        Problem(
            "E_VALUE",
            "the outline has corners outside the reference",
            field="outline",
            found="; ".join(f"({x:g}, {y:g})" for x, y in corners[outside][:4]),
            expected=f"within {size[0]} x {size[1]} px, native px of the reference band",
            fix="Draw the outline within the frame; objects that it cuts end at its rim.",
        )
    ]
