"""Check the tables of campaign.toml against one another, and against the files they name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from itertools import islice
from math import degrees, radians, tan
from pathlib import Path
from typing import Any

from levkas.campaign.camera_kinds import KINDS, fields_of_others, keys_of_others
from levkas.campaign.chart_names import CHARTS, kind_of_chart
from levkas.campaign.discovery.patterns import Pattern
from levkas.campaign.schema.names import EXPECTED, why_unsafe
from levkas.campaign.schema.tables import (
    OPTIONS,
    CameraKeys,
    Document,
    Range,
    RegistrationKeys,
    SensorKeys,
    Setup,
)
from levkas.core.ownership import is_address
from levkas.core.problems import LONGEST_NAME, MOST_COMPARED, Problem, closest_match
from levkas.core.text import unusable_name, what_stands_at
from levkas.readers.compared_facts import OVERRULED
from levkas.readers.wavelengths import RANGE_NM, is_plausible
from levkas.registration.methods import DEFAULT_METHOD, METHODS, owners_of

MOST_LISTED = 20
MOST_BY_ANGLE = 0.3
"""What a white may have stood otherwise than the object, relative: 17 degrees at 45. With more the light is not known at all."""
MOST_CAMERAS, MOST_LAYERS, MOST_PATTERNS = 1000, 20_000, 1000
"""Cameras; objects times cameras; patterns for one camera: each is looked up among the files."""
LONGEST_ENDING = ".published"
"""Of the folders that stand beside a database under its name."""


def find_contradictions(document: Document, root: Path) -> Iterator[Problem]:
    """Yield everything that does not fit together; `file` is left to the caller."""
    if too_many := list(_sizes(document)):
        yield from too_many
        return
    yield from _names(document)
    yield from _targets(document)
    for name, camera in document.cameras.items():
        yield from check_camera(f"cameras.{name}", camera)
        yield from _white_chart(f"cameras.{name}.white", camera, document.targets.charts)
    yield from _setups(document)
    yield from _registration(document)
    yield from _files(document, root)
    output = document.campaign.output
    why = unusable_name(root / output)
    if is_address(output):
        yield value_problem(
            "campaign.output",
            "this is the address of a server, where no database can be built",
            output,
            "a folder of this machine",
            'Write output = "database", and copy that folder to the server.',
        )
    elif why := why or unusable_output((root / output).resolve(), root.resolve()):
        yield value_problem(
            "campaign.output", why, output, "a folder of its own", 'Write output = "database".'
        )


def unusable_output(output: Path, root: Path) -> str:
    """Return why no database can be written to a folder, whatever is there; ``""`` where one can.

    >>> unusable_output(Path("/"), Path("/data/icons"))
    'the database would replace a whole disk or a home folder'
    >>> unusable_output(Path("/data/icons/database"), Path("/data/icons"))
    ''
    """
    try:
        home = Path.home().resolve()
    except RuntimeError:  # a user without one
        home = root
    if output in (Path(output.anchor), home):
        return "the database would replace a whole disk or a home folder"
    if output in (root, *root.parents):
        return "the database would replace the campaign"
    return unusable_name(output.with_name(output.name + LONGEST_ENDING))


def listed(names: Collection[str]) -> str:
    """Return names as they are listed in a message, the first twenty of many.

    >>> listed(["nir", "vis"]), listed([str(n) for n in range(100)])[-8:]
    ('nir, vis', '18, 19 …')
    """
    more = " …" if len(names) > MOST_LISTED else ""
    return ", ".join(n[:LONGEST_NAME] for n in islice(names, MOST_LISTED)) + more


def _sizes(document: Document) -> Iterator[Problem]:
    cameras = document.cameras
    objects = document.targets.objects or document.objects
    lightings = 1 + len(document.setups)
    patterns = max((len(camera.patterns) for camera in cameras.values()), default=0)
    sizes = (
        ("cameras", "cameras", len(cameras), MOST_CAMERAS),
        ("setups", "lightings", lightings, MOST_CAMERAS),
        (
            "targets.objects",
            "objects times cameras",
            max(1, len(objects)) * len(cameras),
            MOST_LAYERS,
        ),
        ("cameras", "patterns for one camera", patterns, MOST_PATTERNS),
    )
    for field, what, count, most in sizes:
        if count > most:
            fix = "Divide it into several campaigns."
            yield Problem("E_SIZE", f"too many {what}", None, field, count, f"at most {most}", fix)


# --- names ------------------------------------------------------------------------------------


def _names(document: Document) -> Iterator[Problem]:
    cameras, reference = document.cameras, document.campaign.reference.camera
    if reference not in cameras:
        yield _unknown(
            "campaign.reference.camera", "the reference camera is not declared", reference, cameras
        )
    elif cameras[reference].traits.is_scanned and cameras[reference].has_tiles:
        yield value_problem(
            f"cameras.{reference}.files",
            "passes of a line scanner that is the reference are strips: as tiles, no other camera shows how their lines lie",
            ", ".join(cameras[reference].files),
            "a pattern without {tile}, {row} and {column}",
            "Write * instead, or take another camera as the reference.",
        )
    own = [document.campaign.setup] if document.campaign.setup else []
    tables = {"cameras": list(cameras), "setups": [*document.setups, *own]}
    tables |= {
        f"cameras.{n}.sensors": [s.name for s in camera.sensors] for n, camera in cameras.items()
    }
    tables["objects"] = [*document.objects, *(document.targets.objects or ())]
    tables["targets.charts"] = [*document.targets.charts]
    for table, names in tables.items():
        for name in dict.fromkeys(names):
            if why := why_unsafe(name):
                yield value_problem(
                    f"{table}.{name}",
                    f"this name cannot be part of a file name: {why}",
                    name,
                    EXPECTED,
                )
    if "grid" in cameras:
        yield value_problem(
            "cameras.grid", "grid is the name of the published frame", "grid", "another name"
        )
    layers = [(name, f"cameras.{name}") for name in cameras]
    for setup, keys in document.setups.items():
        layers += [(f"{c}_{setup}", f"setups.{setup}.cameras.{c}") for c in keys.cameras]
    yield from _twice(layers, "two layers would have the same file name")
    yield from _twice(
        [(n, f"objects.{n}") for n in set(tables["objects"])], "names differ in case only"
    )


def _twice(named: Iterable[tuple[str, str]], message: str) -> Iterator[Problem]:
    first: dict[str, str] = {}
    for name, field in named:
        other = first.setdefault(name.casefold(), field)
        if other != field:
            yield value_problem(field, message, name, f"a name that differs from {other}")


# --- targets ----------------------------------------------------------------------------------


def _targets(document: Document) -> Iterator[Problem]:
    targets = document.targets
    roles = {
        "dark": targets.dark,
        "white": targets.white.names if targets.white else (),
        "charts": tuple(targets.charts),
        "objects": targets.objects or (),
    }
    roles_of: dict[str, str] = {}
    for role, names in roles.items():
        for name in names:
            other = roles_of.setdefault(name, role)
            if other != role and {other, role} != {
                "charts",
                "objects",
            }:  # it is measured, and registered
                yield value_problem(
                    f"targets.{role}", f"{name!r} is declared twice", name, f"{other} or {role}"
                )
    yield from _boxes(document)
    known = tuple(targets.objects or ())
    # What is like none of them waits for another build.
    for name in islice(
        sorted(document.objects.keys() - set(known)), MOST_COMPARED // max(1, len(known))
    ):
        if closest_match(name, known):
            yield _unknown(
                f"objects.{name}", "this object is not listed in targets.objects", name, known
            )


def _boxes(document: Document) -> Iterator[Problem]:
    """Yield rectangles of slanted edges and light traps of a target that is not listed, or of an unknown camera."""
    targets = document.targets
    for kind, tables, known in (
        ("edges", targets.edges, tuple(targets.charts)),
        ("traps", targets.traps, (*targets.charts, *(targets.objects or targets.traps))),
    ):
        for target, frames in tables.items():
            field = f"targets.{kind}.{target}"
            if target not in known:
                fix = f'Write charts = {{ {target} = "{kind.rstrip("s")}" }} where it shows nothing else.'
                yield _unknown(field, "this target is not listed", target, known, fix)
            for frame in frames:
                name, _, setup = frame.partition(":")[0].partition("@")
                camera = document.cameras.get(name)
                if camera is None:
                    yield _unknown(field, "unknown camera", name, document.cameras)
                elif setup and setup not in document.setups:
                    yield _unknown(field, "unknown setup", setup, document.setups)
                elif kind == "traps" and not camera.has_frames:
                    message = f"stray light is not measured in what a camera of kind {camera.kind!r} captures"
                    yield value_problem(field, message, frame, fix="Take the frame out.")


# --- setups, registration, files ---------------------------------------------------------------


def _angle(where: str, setup: Setup) -> Iterator[Problem]:
    """Yield an uncertainty of an angle that is none, or with which the light is not known at all."""
    angle, error = setup.angle_deg, setup.angle_uncertainty_deg
    if error is None:
        return
    if angle is None:
        yield value_problem(
            f"{where}.angle_deg",
            "what `angle_uncertainty_deg` does to values depends on the angle",
            "no angle",
            "the angle between light and normal, degrees",
        )
    elif (change := tan(radians(angle)) * radians(error)) > MOST_BY_ANGLE:
        yield value_problem(
            f"{where}.angle_uncertainty_deg",
            f"at {angle:g} degrees this makes values uncertain by {100 * change:.0f} %",
            error,
            f"at most {degrees(MOST_BY_ANGLE / tan(radians(angle))):.2g}",
        )


def _setups(document: Document) -> Iterator[Problem]:
    for setup, keys in document.setups.items():
        yield from _angle(f"setups.{setup}", keys)
        if setup == document.campaign.setup and keys.cameras:
            yield value_problem(
                f"setups.{setup}.cameras",
                "the default lighting uses the files of the cameras",
                ", ".join(keys.cameras),
                "no cameras: it is campaign.setup",
            )
        for name, own in keys.cameras.items():
            field = f"setups.{setup}.cameras.{name}"
            camera = document.cameras.get(name)
            if camera is None:
                yield _unknown(
                    field, "a setup names a camera that is not declared", name, document.cameras
                )
                continue
            for text in own.files:
                yield from check_pattern(f"{field}.files", text, camera.kind)
            if (
                own.files
                and camera.traits.bands_in == "sensors"
                and "{sensor}" not in "".join(own.files)
            ):
                yield value_problem(
                    f"{field}.files", "the pattern has no {sensor}", " ".join(own.files)
                )
            if not own.files and not any("{setup}" in text for text in camera.patterns):
                yield Problem(
                    "E_KEY",
                    "files is required",
                    field=f"{field}.files",
                    fix=f"Write it here, or {{setup}} in cameras.{name}.files.",
                )


def _registration(document: Document) -> Iterator[Problem]:
    common = document.registration
    own = {name: camera.registration for name, camera in document.cameras.items()}
    methods = _methods_of(document)
    if common.use is not None and not any((common.points, *(k.points for k in own.values()))):
        yield value_problem("registration.use", "no control points are given", common.use)
    shared = common.method or DEFAULT_METHOD
    yield from _foreign_options("registration", common, {shared, *methods.values()}, shared)
    for name, keys in own.items():
        method, where = methods[name], f"cameras.{name}.registration"
        yield from _foreign_options(where, keys, {method}, method)
        if keys.use is not None and (keys.points or common.points) is None:
            yield value_problem(f"{where}.use", "no control points are given", keys.use)
        if (keys.use or common.use) == "start" and not METHODS[method].begins:
            yield _without_start(f"{where if keys.use else 'registration'}.use", method)
        if (keys.accept or common.accept) and (keys.use or common.use) != "seeds":
            table = where if keys.accept else "registration"
            message = "only points that are not check points place a camera"
            yield value_problem(
                f"{table}.accept", message, keys.accept or common.accept, 'use = "seeds"'
            )
        reject, stop = keys.reject or common.reject, keys.stop or common.stop or 1.0
        if reject is not None and reject <= stop:
            table = where if keys.declared() else "registration"
            yield value_problem(
                f"{table}.reject", "reject is not above stop", reject, f"> {stop:g} px"
            )


def _methods_of(document: Document) -> dict[str, str]:
    """Return the name of each camera's method."""
    common = document.registration.method or DEFAULT_METHOD
    return {name: c.registration.method or common for name, c in document.cameras.items()}


def _without_start(where: str, method: str) -> Problem:
    able = next(name for name, row in METHODS.items() if row.begins)
    return value_problem(
        where,
        f"the method {method!r} does not try pairs of another program",
        "start",
        fix=f'Write use = "check" or use = "seeds", or method = "{able}".',
    )


def _foreign_options(
    where: str, keys: RegistrationKeys, methods: Collection[str], method: str
) -> Iterator[Problem]:
    """Yield the options of a table that none of `methods` has; `method` is the one that it is written for."""
    known = {option for name in methods for option in METHODS[name].options.model_fields}
    for option in OPTIONS:
        if option not in known and getattr(keys, option) is not None:
            yield value_problem(
                f"{where}.{option}",
                f"the method {method!r} has no `{option}`",
                getattr(keys, option),
                fix=f'Remove it, or write method = "{owners_of(option)[0]}".',
            )


def find_ineffective(document: Document) -> Iterator[str]:
    """Yield options that are accepted and change nothing under the methods that the cameras use."""
    methods = _methods_of(document)
    tables = {"registration": (document.registration, set(methods.values()))}
    for name, camera in document.cameras.items():
        tables[f"cameras.{name}.registration"] = (camera.registration, {methods[name]})
    for where, (keys, used) in tables.items():
        ineffective = set.intersection(*(set(METHODS[name].ineffective) for name in used))
        for option in OPTIONS:
            if option in ineffective and getattr(keys, option) is not None:
                yield f"campaign.toml: {without_effect(f'{where}.{option}')}"


def without_effect(field: str) -> str:
    """Return the warning about an option that the default method accepts and does not use."""
    owner = owners_of(field.rpartition(".")[2])[0]
    return f'{field} has no effect with the default method; it is an option of method = "{owner}"'


def _files(document: Document, root: Path) -> Iterator[Problem]:
    white = document.targets.white
    named = {f"cameras.{n}.sensitivity": c.sensitivity for n, c in document.cameras.items()}
    charts = {n: c.white_chart for n, c in document.cameras.items()}
    named |= {f"cameras.{n}.positions": c.positions for n, c in document.cameras.items()}
    named |= {f"cameras.{n}.white.reference": w.reference for n, w in charts.items() if w}
    if white and isinstance(white.reflectance, str):
        named["targets.white.reflectance"] = white.reflectance
    named |= {f"setups.{n}.spectrum": setup.spectrum for n, setup in document.setups.items()}
    tables = {"registration": document.registration}
    tables |= {f"cameras.{n}.registration": c.registration for n, c in document.cameras.items()}
    for where, keys in tables.items():
        if keys.points is not None and "{" not in keys.points:
            named[f"{where}.points"] = keys.points
    for field, name in named.items():
        if name is not None and what_stands_at(root / name) != "a file":
            yield Problem(
                "E_UNREADABLE",
                "the named table does not exist",
                field=field,
                found=name,
                expected="a CSV file, named relative to campaign.toml",
            )


def value_problem(
    field: str, message: str, found: Any = None, expected: str | None = None, fix: str | None = None
) -> Problem:
    """Return a value's problem."""
    return Problem("E_VALUE", message, field=field, found=found, expected=expected, fix=fix)


def _unknown(
    field: str, message: str, name: str, known: Collection[str], fix: str | None = None
) -> Problem:
    """Return the problem of a name that is none of those known, with the nearest of them."""
    return value_problem(
        field, message, name, f"one of {listed(known)}", closest_match(name, known) or fix
    )


def check_camera(where: str, camera: CameraKeys) -> Iterator[Problem]:
    """Yield what does not fit together in the table `where`, such as ``cameras.nir``."""
    for key, kinds in keys_of_others(camera.kind).items():
        if getattr(camera, key):
            per_sensor = key in ("pattern", "bands") and camera.traits.bands_in == "sensors"
            yield value_problem(
                f"{where}.{key}",
                f"a camera of kind {camera.kind!r} does not have the key `{key}`",
                expected=" or ".join(f'kind = "{kind}"' for kind in kinds),
                fix="Write it in each [[sensors]] table." if per_sensor else "Take it out.",
            )
    if camera.traits.bands_in == "sensors":
        yield from _sensors(where, camera)
    elif not camera.files:
        yield Problem("E_KEY", "files is required", field=f"{where}.files")
    for text in camera.files:
        yield from check_pattern(f"{where}.files", text, camera.kind)
    if camera.positions and not camera.has_tiles:
        expected = "{tile}, or {row} and {column}, in `files`"
        message = "the camera has no tiles"
        yield value_problem(f"{where}.positions", message, camera.positions, expected)
    yield from _wavelengths(where, camera)
    mosaic = camera.pattern if camera.traits.bands_in == "pattern" else None
    yield from _channels(where, mosaic, camera.bands)
    if camera.black is not None and camera.saturation and camera.black >= camera.saturation:
        expected = f"< {camera.saturation:g}"
        yield value_problem(
            f"{where}.black", "black is not below saturation", camera.black, expected
        )
    for name in camera.overrule:
        if name not in OVERRULED:
            yield _unknown(
                f"{where}.overrule", "this is no fact that files are compared by", name, OVERRULED
            )
    dark, white = set(camera.dark or ()), set(camera.white_names or ())
    if dark & white:
        yield value_problem(
            f"{where}.white", "a target is declared both dark and white", min(dark & white)
        )


def _white_chart(where: str, camera: CameraKeys, charts: Collection[str]) -> Iterator[Problem]:
    """Yield what is wrong with a chart in place of a white frame."""
    white = camera.white_chart
    if white is None:
        return
    if not camera.traits.by_chart:
        message = f"a camera of kind {camera.kind!r} cannot be calibrated by a chart"
        able = " or ".join(f'kind = "{name}"' for name, kind in KINDS.items() if kind.by_chart)
        fix = "Capture a white, or write white = []."
        yield value_problem(f"{where}.chart", message, white.chart, able, fix)
    if white.chart not in charts and kind_of_chart(white.chart) is None:
        message = "this is neither a declared chart target nor the name of a known chart"
        fix = 'Declare it: charts = { macbeth = "ColorChecker24" } in [targets].'
        known = [*charts, *sorted(set(CHARTS.values()))]
        yield _unknown(f"{where}.chart", message, white.chart, known, fix)


def _sensors(where: str, camera: CameraKeys) -> Iterator[Problem]:
    if not camera.sensors:
        yield Problem("E_KEY", "[[sensors]] tables are required", field=f"{where}.sensors")
    for name, count in Counter(s.name for s in camera.sensors).items():
        if count > 1:
            yield value_problem(f"{where}.sensors.{name}", "two sensors have the same name", name)
    for sensor in camera.sensors:
        at = f"{where}.sensors.{sensor.name}"
        if not sensor.files and not any("{sensor}" in text for text in camera.files):
            yield Problem(
                "E_KEY",
                "files is required",
                field=f"{at}.files",
                fix=f"Write it here, or {{sensor}} in {where}.files.",
            )
        for text in sensor.files:
            yield from check_pattern(f"{at}.files", text, camera.kind)
        yield from _channels(at, sensor.pattern, sensor.bands)
    yield from _sensor_alignment(where, camera.sensors)


def _sensor_alignment(where: str, sensors: tuple[SensorKeys, ...]) -> Iterator[Problem]:
    identity = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    if sensors and sensors[0].align not in ("measure", identity):
        field = f"{where}.sensors.{sensors[0].name}.align"
        yield value_problem(field, "the others are aligned to the first sensor", fix="Take it out.")


def check_pattern(field: str, text: str, kind: str) -> Iterator[Problem]:
    """Yield what is wrong with a pattern of files for a camera of some kind."""
    try:
        fields = Pattern.parse(text).fields
    except ValueError as error:
        yield value_problem(
            field, str(error), text, "a pattern such as raw/NAME/{target}/{shot}.tif"
        )
        return
    if "target" not in fields:
        yield value_problem(field, "the pattern has no {target}", text, "raw/NAME/{target}/*.tif")
    for name, kinds in fields_of_others(kind).items():
        if name in fields:
            message = f"only a camera of kind {' or '.join(map(repr, kinds))} has {{{name}}}"
            yield value_problem(field, message, text, fix="Write * instead.")
    if "tile" in fields and fields & {"row", "column"}:
        message = "a tile has one name: {tile}, or its {row} and {column}"
        yield value_problem(field, message, text, fix="Write * in place of the other.")
    if "object" in fields and not KINDS[kind].is_calibrated:
        message = "an image has neither darks nor whites, which {object} is for"
        yield value_problem(field, message, text, fix="Take it out.")


def _wavelengths(where: str, camera: CameraKeys) -> Iterator[Problem]:
    centres, keys = camera.centres, camera.wavelengths
    if centres is None:
        return
    field = f"{where}.wavelengths"
    if not centres and isinstance(keys, Range):
        message = (
            f"{keys.start:g} to {keys.stop:g} nm is not a whole number of steps of {keys.step:g} nm"
        )
        yield value_problem(field, message)
    elif not centres:
        fix = "Remove it: the files give their wavelengths."
        yield value_problem(field, "the list is empty", fix=fix)
    elif len(set(centres)) < len(centres):
        twice = Counter(centres).most_common(1)[0][0]
        yield value_problem(field, "a wavelength is listed twice", twice)
    elif odd := [nm for nm in centres if not is_plausible(nm)]:
        expected = f"{RANGE_NM[0]:g} to {RANGE_NM[1]:g}, in nm"
        yield value_problem(field, "no camera has a band there", odd[0], expected)
    elif camera.bands and len(camera.bands) != len(centres):
        yield Problem(
            "E_BAND_COUNT",
            "`bands` and `wavelengths` differ in length",
            field=field,
            found=f"{len(centres)} wavelengths",
            expected=f"{len(camera.bands)}, one per band",
        )
    elif not camera.bands and any("{band}" in text for text in camera.files):
        yield Problem(
            "E_KEY",
            "the assignment of wavelengths to bands is unknown",
            field=f"{where}.bands",
            fix="Write `bands` in the order of `wavelengths`.",
        )


def _channels(
    where: str, pattern: tuple[tuple[str, ...], ...] | None, bands: tuple[str, ...] | None
) -> Iterator[Problem]:
    for name, count in Counter(bands or ()).items():
        if count > 1:
            yield Problem(
                "E_BAND_TWICE", "two bands have the same name", field=f"{where}.bands", found=name
            )
    channels = {name for row in pattern or () for name in row}
    if pattern and bands and len(bands) != len(channels):
        yield Problem(
            "E_BAND_COUNT",
            "`bands` and `pattern` disagree",
            field=f"{where}.bands",
            found=len(bands),
            expected=f"{len(channels)}: {', '.join(sorted(channels))}",
        )
