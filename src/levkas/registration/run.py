"""A registration by any method: arguments and options are checked, a target that is too fine is reduced, check points are measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.registration.advice import advise
from levkas.registration.bands import BandImage
from levkas.registration.methods import DEFAULT_METHOD, METHODS
from levkas.registration.record import Registration, RegistrationRefused, refusal
from levkas.registration.request import Request, check_request, read_options

if TYPE_CHECKING:
    from levkas.registration.manual_points import ManualPoints

BUILT_IN = {
    "levkas": ("levkas.registration.levkas", "register_levkas"),
    "mirhashemi2019": ("levkas.registration.mirhashemi2019", "register_mirhashemi2019"),
}
"""Module and function of the built-in methods, imported when first used."""
OF_PICTURES = {"E_MATCHES", "E_WINDOWS", "E_SCALE", "E_FOLD"}
"""Codes of refusals for which a person's pairs help."""
FURTHER = {field.name for field in fields(Request)} - {"region", "given"}
"""Fields of the request that are given by name."""


def register(
    reference: np.ndarray | Sequence[BandImage],
    target: np.ndarray | Sequence[BandImage],
    *,
    reference_band: str | None = None,
    method: str = DEFAULT_METHOD,
    region: Sequence[float] | None = None,
    given: Mapping[str, ManualPoints] | None = None,
    **options: Any,
) -> Registration:
    """Find the map from reference px to native px of every band of one camera.

    `reference` and `target` are arrays, (h, w) or (h, w, bands), of which bands are labelled ``"1"``, ``"2"``, …, or sequences of
    `BandImage`, at least 16 px a side, in any unit; the same object for the reference camera's own bands. A value that is not finite is
    not used. `reference_band` labels the band that defines reference px, by default the middle one. `method` is a key of `METHODS`:
    ``"levkas"`` (docs/explanation/registration.md), ``"mirhashemi2019"`` (section 3.5 of [mirhashemi2019]_, doi:10.3390/computation7030047),
    or one of an installed package. The object lies in `region`, (x, y, width, height) in reference px: nothing outside is used or judged.
    `given`, by sensor, are pairs given by hand: added and pinned ones are never removed, deleted ones never used, check points are measured
    into ``errors["check_points"]``, each by the band that it was placed in; where they are `accepted`, the map of their sensor is fitted to
    them alone. `options` are those of the method, as campaign.toml names them, None for the default, and further fields of the `Request`.

    A map with the verdict ``"refuse"`` is not reliable. Raises `RegistrationRefused`: ``E_MATCHES`` and others where no map is found;
    ``E_VALUE``, ``E_SIZE``, ``E_BAND_MISSING`` or ``E_BAND_TWICE`` where an argument is wrong.

    Examples
    --------
    A picture, and the same scene moved by 5 px and 3 px:

    >>> import numpy as np
    >>> from scipy.ndimage import gaussian_filter
    >>> scene = gaussian_filter(np.random.default_rng(1).random((260, 330)), 2)
    >>> found = register(scene[:240, :300], scene[3:243, 5:305])
    >>> found.verdict.decision
    'accept'
    >>> found.transforms["1"](np.array([[150.0, 120.0]])).round(1).tolist()
    [[145.0, 117.0]]
    """
    from levkas.core.machine import steady_libraries

    own = target is reference
    reference = _bands_of(reference, "reference")
    target = reference if own else _bands_of(target, "target")
    if reference_band is None:
        reference_band = reference[len(reference) // 2].label if len(reference) else ""
    given = {name: pairs for name, pairs in (given or {}).items() if pairs}
    further = {name: options.pop(name) for name in FURTHER & options.keys()}
    request = Request(reference, target, reference_band, region=region, given=given, **further)
    check_request(request, method, METHODS)
    chosen = read_options(METHODS[method].options, options)
    placed = any(pairs.accepted for pairs in given.values())
    if placed and method != DEFAULT_METHOD:  # it places by pairs, with no option of another's
        method, chosen = DEFAULT_METHOD, read_options(METHODS[DEFAULT_METHOD].options, {})
    pairs_given = max((len(pairs.fixed) for pairs in given.values()), default=0)
    try:
        with steady_libraries():
            found = _run(_function(method), request, chosen)
    except RegistrationRefused as refused:
        # Problems of the pictures, not of the arguments, name the workbench.
        problems = (
            replace(one, fix=advise(one.fix or "", pairs_given)) if one.code in OF_PICTURES else one
            for one in refused.problems
        )
        if placed:
            raise
        raise RegistrationRefused(*problems, trace=refused.trace) from None
    _require_maps(found, request, method)
    if not placed:
        step = advise(found.verdict.next_step, pairs_given, found.verdict.decision)
        found = replace(found, verdict=replace(found.verdict, next_step=step))
    return _with_checks(found, target, given)


def _run(
    run: Callable[[Request, Any], Registration], request: Request, chosen: Any
) -> Registration:
    """Run a method; once more with the target reduced where it is too fine, a macro photograph of a part."""
    from levkas.registration.reduced import enlarged, reduce_target

    try:
        return run(request, chosen)
    except RegistrationRefused as refused:
        if request.is_own or "E_SCALE" not in {problem.code for problem in refused.problems}:
            raise
        try:
            return enlarged(run(reduce_target(request), chosen))
        except RegistrationRefused:
            raise refused from None


def _require_maps(found: Registration, request: Request, method: str) -> None:
    """Refuse a registration that lacks the map of a band: a fault of its method, not of the pictures."""
    lacking = [band.label for band in request.target if band.label not in found.transforms]
    if lacking:
        raise refusal(
            "E_METHOD",
            f"the registration method {method!r} returns no map for {len(lacking)} of {len(request.target)} bands",
            field="registration.method", found=", ".join(lacking[:12]), expected="a transform of every band of the target, by its label",
            fix="Report this to the author of the method, or choose another one.",
        )  # fmt: skip


def _bands_of(pixels: np.ndarray | Sequence[BandImage], name: str) -> Sequence[BandImage]:
    """Return the bands of an array, labelled by their number from 1; other sequences as they are."""
    found, fix = type(pixels).__name__, None
    if hasattr(pixels, "__array__"):
        array = np.asarray(pixels)
        if isinstance(pixels, np.ma.MaskedArray):
            array = np.where(np.ma.getmaskarray(pixels), np.float32(np.nan), array)
        if array.ndim in (2, 3) and array.dtype.kind in "uif" and np.isfinite(array).any():
            planes = np.moveaxis(np.atleast_3d(array), -1, 0)
            return [BandImage.of(str(i), plane) for i, plane in enumerate(planes, 1)]
        finite = array.dtype.kind not in "f" or np.isfinite(array).any()
        found = f"{array.dtype} {array.shape}{'' if finite else ', no finite value'}"
    elif isinstance(pixels, Sequence) and not isinstance(pixels, str):
        if all(isinstance(band, BandImage) for band in pixels):
            return pixels
        found = f"{found} of {type(pixels[0]).__name__}"
        fix = "Give one array; np.stack(pictures, axis=-1) makes it."
    expected = "an array (height, width) or (height, width, bands) of integers or floats"
    raise refusal(
        "E_VALUE", f"the {name} is no picture", field=name, found=found, expected=expected, fix=fix
    )


def _function(method: str) -> Callable[[Request, Any], Registration]:
    """Return the function of a method; of a built-in one it is imported now."""
    found: Callable[[Request, Any], Registration] | None = METHODS[method].register
    if method in BUILT_IN:
        module, name = BUILT_IN[method]
        found = getattr(import_module(module), name)
    assert found is not None, f"the method {method!r} has no function"
    return found


def _with_checks(
    found: Registration, target: Sequence[BandImage], given: Mapping[str, ManualPoints]
) -> Registration:
    """Measure every check point by the map of the band in which it was placed."""
    from levkas.registration.manual_points import measure_checks, with_checks

    report: list[dict[str, Any]] = []
    tables = {target[0].sensor: found.matches, **found.others}
    for sensor, pairs in given.items():
        first = next((image.label for image in target if image.sensor == sensor), None)
        if first is None or not len(pairs.checks):
            continue
        labels = [label or first for label in pairs.placed or ("",) * len(pairs.checks)]
        errors = np.concatenate(
            [
                measure_checks(pair[None], found.transforms[label])
                for label, pair in zip(labels, pairs.checks, strict=True)
            ]
        )
        if sensor in tables:
            tables[sensor] = with_checks(tables[sensor], pairs.checks, errors)
        report += [
            {
                "band": b,
                "reference": pair[:2].tolist(),
                "target": pair[2:].tolist(),
                "error": float(e),
            }
            for b, pair, e in zip(labels, pairs.checks, errors, strict=True)
        ]
    if not report:
        return found
    matches = tables.pop(target[0].sensor)
    errors_found = {**found.errors, "check_points": report}
    return replace(found, matches=matches, others=tables, errors=errors_found)
