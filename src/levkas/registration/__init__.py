"""Registration: which pixel of which band of which camera shows which point of the reference.

A method is a row of `levkas.campaign.methods.METHODS`: the model of its options, and a function of a `Request`
and these options that returns a `Registration`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.campaign.methods import DEFAULT_METHOD, METHODS, Method
from levkas.registration.bands import BandImage
from levkas.registration.record import (
    Matches,
    Registration,
    RegistrationRefused,
    Trace,
    Verdict,
)
from levkas.registration.request import Request

if TYPE_CHECKING:
    from levkas.registration.manual_points import ManualPoints

#: Module and function of the built-in methods, imported when first used.
BUILT_IN = {
    "levkas": ("levkas.registration.levkas", "register_levkas"),
    "mirhashemi2019": ("levkas.registration.mirhashemi2019", "register_mirhashemi2019"),
}
#: Fields of the request that are given by name.
FURTHER = {"target_region", "align", "reference_transforms", "reference_sigma", "prepared"}

__all__ = [
    "METHODS",
    "BandImage",
    "Matches",
    "Method",
    "Registration",
    "RegistrationRefused",
    "Request",
    "Trace",
    "Verdict",
    "register",
]


def register(
    reference: Sequence[BandImage],
    target: Sequence[BandImage],
    *,
    reference_band: str,
    method: str = DEFAULT_METHOD,
    region: Sequence[float] | None = None,
    given: Mapping[str, ManualPoints] | None = None,
    **options: Any,
) -> Registration:
    """Find the map from reference px to native px of every band of one camera.

    Parameters
    ----------
    reference : sequence of BandImage
        Bands of the reference camera.
    target : sequence of BandImage
        Bands of the camera to register; the same sequence for the reference camera itself.
    reference_band : str
        Label of the band of `reference` that defines reference px.
    method : str
        A key of `METHODS`.
    region : (x, y, width, height), reference px, optional
        Where the object lies; nothing outside is used or judged.
    given : mapping of sensor name to ManualPoints, optional
        Pairs given by hand: added and pinned ones are never removed, deleted ones never used, check
        points are measured into ``errors["check_points"]``, each by the band that it was placed in.
    **options
        Of the method, as campaign.toml names them; None stands for a default. Further fields of the
        `Request` are taken too, e.g. `reference_transforms`.

    Returns
    -------
    registration : Registration
        With the verdict ``"refuse"`` where there is an answer that cannot be relied on.

    Raises
    ------
    RegistrationRefused
        Where there is no answer at all, or an argument is wrong.
    """
    from levkas.core.machine import steady_libraries
    from levkas.registration.request import check_request, read_options

    given = {name: pairs for name, pairs in (given or {}).items() if pairs}
    further = {name: options.pop(name) for name in FURTHER & options.keys()}
    request = Request(reference, target, reference_band, region=region, given=given, **further)
    check_request(request, method, METHODS)
    chosen = read_options(METHODS[method].options, options)
    run = _function(method)
    with steady_libraries():
        found = run(request, chosen)
    return _with_checks(found, target, given)


def _function(method: str) -> Callable[[Request, Any], Registration]:
    """Return the function of a method; of a built-in one it is imported now."""
    if method not in BUILT_IN:
        row = METHODS[method].register
        assert row is not None, f"the method {method!r} has no function"
        return row
    module, name = BUILT_IN[method]
    found: Callable[[Request, Any], Registration] = getattr(import_module(module), name)
    return found


def _with_checks(
    found: Registration, target: Sequence[BandImage], given: Mapping[str, ManualPoints]
) -> Registration:
    """Measure every check point by the map of the band in which it was placed."""
    from levkas.registration.manual_points import measure_checks, with_checks

    report: list[dict[str, Any]] = []
    matches, others = found.matches, dict(found.others)
    for sensor, pairs in given.items():
        first = next((image.label for image in target if image.sensor == sensor), None)
        if first is None or not len(pairs.checks):
            continue
        labels = [label or first for label in pairs.placed or ("",) * len(pairs.checks)]
        errors = np.full(len(labels), np.nan)
        for label in dict.fromkeys(labels):
            here = np.array([one == label for one in labels])
            errors[here] = measure_checks(pairs.checks[here], found.transforms[label])
        if sensor == target[0].sensor:
            matches = with_checks(matches, pairs.checks, errors)
        elif sensor in others:
            others[sensor] = with_checks(others[sensor], pairs.checks, errors)
        report += [
            {
                "band": label,
                "reference": pair[:2].tolist(),
                "target": pair[2:].tolist(),
                "error": float(error),
            }
            for label, pair, error in zip(labels, pairs.checks, errors, strict=True)
        ]
    if not report:
        return found
    return replace(
        found, matches=matches, others=others, errors={**found.errors, "check_points": report}
    )
