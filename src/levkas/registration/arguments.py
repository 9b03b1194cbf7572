"""Arguments of a registration, checked once at the rim and then trusted."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Problem
from levkas.registration.record import RegistrationRefused

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from levkas.registration.bands import BandImage

LEAST_SIDE_PX = 16


def check_arguments(
    reference: Sequence[BandImage],
    target: Sequence[BandImage],
    reference_band: str,
    method: str,
    methods: Iterable[str],
    reject: float | None,
    stop: float,
    region: Sequence[float] | None,
) -> None:
    """Raise `RegistrationRefused` with everything that is wrong with the arguments."""
    problems = [
        *_check_method(method, methods),
        *check_thresholds(reject, stop),
        *_check_bands("reference", reference),
        *([] if target is reference else _check_bands("target", target)),
    ]
    labels = [image.label for image in reference]
    if labels and reference_band not in labels:
        problems.append(
            Problem(
                "E_BAND_MISSING",
                f"there is no reference band {reference_band!r}",
                field="reference_band",
                found=reference_band,
                expected=", ".join(labels[:12]),
            )
        )
    problems += _check_region(region)
    if problems:
        raise RegistrationRefused(*problems)


def check_thresholds(reject: float | None, stop: float) -> list[Problem]:
    """Return what is wrong with T1 and T2: both finite and positive, `stop` below `reject`.

    >>> [p.field for p in check_thresholds(108.0, 0.0)]
    ['registration.stop']
    """
    problems = []
    for name, value in (("reject", reject), ("stop", stop)):
        if value is not None and not _positive(value):
            problems.append(_value_problem(name, value, "a finite number of reference pixels > 0"))
    if not problems and reject is not None and reject <= stop:
        problems.append(_value_problem("reject", reject, f"more than stop, which is {stop}"))
    return problems


def _positive(value: Any) -> bool:
    number = isinstance(value, (int, float, np.integer, np.floating))
    return bool(number and not isinstance(value, bool) and isfinite(value) and value > 0)


def _value_problem(name: str, value: Any, expected: str) -> Problem:
    return Problem(
        "E_VALUE",
        f"`{name}` cannot be used",
        field=f"registration.{name}",
        found=value,
        expected=expected,
        fix=f"Give `{name}` in reference pixels, or leave it out.",
    )


def _check_method(method: str, methods: Iterable[str]) -> list[Problem]:
    known = sorted(methods)
    if method in known:
        return []
    return [
        Problem(
            "E_VALUE",
            f"there is no registration method {method!r}",
            field="registration.method",
            found=method,
            expected=", ".join(known),
        )
    ]


def _check_bands(name: str, images: Sequence[BandImage]) -> list[Problem]:
    if not len(images):
        return [Problem("E_BAND_MISSING", f"the {name} has no bands", field=name, found=0)]
    problems = []
    labels = [image.label for image in images]
    twice = sorted({label for label in labels if labels.count(label) > 1})
    if twice:
        problems.append(
            Problem("E_BAND_TWICE", f"bands of the {name} share a label", found=", ".join(twice))
        )
    sizes: dict[str, tuple[int, int]] = {}
    for image in images:
        if sizes.setdefault(image.sensor, image.size) != image.size:
            problems.append(
                Problem(
                    "E_SIZE",
                    f"bands of one sensor of the {name} differ in size",
                    field=image.label,
                    found=image.size,
                    expected=sizes[image.sensor],
                )
            )
        if min(image.size) < LEAST_SIDE_PX:
            problems.append(
                Problem(
                    "E_SIZE",
                    f"a band of the {name} is too small to register",
                    field=image.label,
                    found=image.size,
                    expected=f"at least {LEAST_SIDE_PX} px a side",
                )
            )
    return problems


def _check_region(region: Sequence[float] | None) -> list[Problem]:
    if region is None:
        return []
    good = len(region) == 4 and all(isfinite(v) for v in region) and min(region[2:]) > 0
    return (
        [] if good else [_value_problem("region", tuple(region), "x, y, width, height; both > 0")]
    )
