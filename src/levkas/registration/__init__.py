"""Registration: which pixel of which band of which camera shows which point of the reference."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.registration.bands import BandImage
from levkas.registration.record import (
    Matches,
    Registration,
    RegistrationRefused,
    Trace,
    Verdict,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from levkas.registration.manual_points import ManualPoints

METHODS: dict[str, tuple[str, str]] = {
    "levkas": ("levkas.registration.levkas", "register_levkas"),
    "mirhashemi2019": ("levkas.registration.mirhashemi2019", "register_mirhashemi2019"),
}
DEFAULT_METHOD = "levkas"

__all__ = [
    "METHODS",
    "BandImage",
    "Matches",
    "Registration",
    "RegistrationRefused",
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
    reject: float | None = None,
    stop: float = 1.0,
    region: Sequence[float] | None = None,
    rng: np.random.Generator | None = None,
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
    reject, stop : float, reference px
        T1 (None: the method's default) and T2 of the paper.
    region : (x, y, width, height), reference px, optional
        Where the object lies; nothing outside is used or judged.
    rng : numpy.random.Generator, optional
        For what is drawn at random; a fixed seed without it.
    given : mapping of sensor name to Given, optional
        Pairs given by hand: added and pinned ones are never removed, deleted ones never used, check
        points are measured into ``errors["check_points"]``, each by the band that it was placed in.
    **options
        Of the method.

    Returns
    -------
    registration : Registration
        With the verdict ``"refuse"`` where there is an answer that cannot be believed.

    Raises
    ------
    RegistrationRefused
        Where there is no answer at all, or an argument is wrong.
    """
    from levkas.core.machine import steady_libraries
    from levkas.registration.arguments import check_arguments

    check_arguments(reference, target, reference_band, method, METHODS, reject, stop, region)
    module, name = METHODS[method]
    run: Callable[..., Registration] = getattr(import_module(module), name)
    given = {name: pairs for name, pairs in (given or {}).items() if pairs}
    if given:
        options["given"] = given
    with steady_libraries():
        found = run(
            reference,
            target,
            reference_band=reference_band,
            reject=reject,
            stop=stop,
            region=region,
            rng=rng,
            **options,
        )
    return _checked(found, target, given)


def _checked(
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
    told = {**found.errors, "check_points": report}
    return replace(found, matches=matches, others=others, errors=told)
