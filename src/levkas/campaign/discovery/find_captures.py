"""Find the captures of a campaign: frames and bands of every sensor, with the darks and whites they need."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING

from levkas.campaign.discovery.bands import (
    bad_reference,
    band_key,
    bands_by_name,
    bands_in_file,
    bands_of_mosaic,
    count_problem,
    in_order,
    label_templates,
    page_of,
    with_declared_centres,
)
from levkas.campaign.discovery.captures import (
    Capture,
    CaptureRefused,
    FrameRef,
    Refusals,
    Rows,
    SensorFrames,
    require_name,
)
from levkas.campaign.discovery.chart_whites import (
    bands_beyond,
    no_chart_frames,
    nothing_known,
    other_chart_bands,
)
from levkas.campaign.discovery.darks_and_whites import Templates, check_every_band
from levkas.campaign.discovery.file_index import (
    FileIndex,
    FoundFile,
    declared_targets,
    files_of_other_case,
    nearest,
    patterns_of,
    scan_folders,
)
from levkas.campaign.discovery.patterns import Pattern, natural
from levkas.campaign.discovery.tiles import joined_tiles, tiles_of
from levkas.core.cube import find_band
from levkas.core.internal_errors import InternalError, as_refusal
from levkas.core.problems import Problem, Refused, closest_match

LONGEST_STEM = 200
"""Bytes of OBJECT_CAMERA_SETUP_SENSOR in the names of a layer's files; the longest ending has 50, a name 255."""

if TYPE_CHECKING:
    from levkas.campaign.campaign import Camera, Campaign
    from levkas.campaign.discovery.file_index import FileIndex
    from levkas.campaign.schema.tables import SensorKeys
    from levkas.core.cube import Band

__all__ = [
    "Capture",
    "CaptureRefused",
    "FrameRef",
    "Refusals",
    "SensorFrames",
    "find_captures",
    "find_charts",
]


def find_captures(
    campaign: Campaign, index: FileIndex | None = None
) -> tuple[list[Capture], Refusals]:
    """Find every capture of a campaign.

    A camera or setup that has frames of some objects did not take the others, without a refusal. One
    that has frames of none is refused for each; so is an object without a reference image.

    Parameters
    ----------
    campaign : Campaign
        As `load_campaign` returns it.
    index : FileIndex, optional
        What `scan_folders` found, where the folders were walked already.

    Returns
    -------
    captures : list of Capture
        Object by object, the reference camera first, other setups last.
    refusals : dict
        (object, camera, setup) → what is wrong with that capture alone.

    Raises
    ------
    CaptureRefused
        Where there is neither an object nor a chart.

    Examples
    --------
    >>> from levkas.campaign.campaign import load_campaign
    >>> captures, refusals = find_captures(load_campaign(plates))
    >>> [capture.camera for capture in captures], refusals
    (['photo', 'infrared'], {})
    """
    index = index or scan_folders(campaign)
    index.objects = _objects(index)
    reference = campaign.reference.camera
    order = sorted(index.frames, key=lambda key: (key != (reference, ""), bool(key[1])))
    captures: list[Capture] = []
    refusals = _misspelt(index)
    for name in index.objects:
        for camera_name, setup in order:
            if not _is_promised(index, name, camera_name, setup):
                continue
            try:
                _require_frames(index, name, camera_name, setup)
                capture = _capture(index, name, campaign.cameras[camera_name], setup)
                _check_reference_bands(campaign, capture)
                captures.append(capture)
            except Exception as error:
                refusals[name, camera_name, setup] = _refusal(error, name, camera_name, setup)
    return captures, refusals


def find_charts(
    campaign: Campaign, index: FileIndex | None = None
) -> tuple[list[Capture], Refusals]:
    """Find every capture of a declared chart, by the cameras and setups that took it.

    Takes and returns as `find_captures`.
    """
    index = index or scan_folders(campaign)
    captures: list[Capture] = []
    refusals: Refusals = {}
    for name in campaign.targets.charts:
        for camera, setup in index.frames:
            if not index.of(name, camera, setup):
                continue
            try:
                sensors = frames_of_sensors(index, name, campaign.cameras[camera], setup)
                captures.append(Capture(name, camera, setup, sensors))
            except Exception as error:
                refusals[name, camera, setup] = _refusal(error, name, camera, setup)
    return captures, refusals


def _refusal(error: Exception, name: str, camera: str, setup: str) -> Refused:
    """Return why a capture is refused whose frames were looked for; never more than this one."""
    return as_refusal(error, f"{name}/{Capture(name, camera, setup, ()).layer} frames")


# --- objects ----------------------------------------------------------------------------------


def _objects(index: FileIndex) -> list[str]:
    """Return the declared objects; else every target without another role, of any camera."""
    campaign = index.campaign
    if campaign.targets.objects:
        return list(campaign.targets.objects)
    others = set(declared_targets(campaign)) - set(campaign.objects)
    captured = {f.target for found in index.frames.values() for f in found}
    names = (captured - others) | set(campaign.objects)
    if not names and captured.isdisjoint(campaign.targets.charts):  # charts alone are measured
        raise _no_objects(index)
    return sorted(names, key=lambda n: (natural(n), n))


def _no_objects(index: FileIndex) -> Refused:
    """Return the refusal of an empty campaign: a folder, a pattern, or names that are all templates."""
    reference = index.campaign.reference.camera
    found = index.frames[reference, ""]
    if (reference, "") in index.broken:
        return index.broken[reference, ""]
    if not found:
        return CaptureRefused(_no_frames(index, reference, "", "an object", None))
    return CaptureRefused(
        Problem(
            "E_NO_FRAMES",
            f"{reference}: no file of an object matches the pattern",
            str(index.campaign.path),
            f"cameras.{reference}.files",
            f"only {', '.join(sorted({f.target for f in found}, key=natural))}",
            "a {target} other than dark, white or chart in "
            + " or ".join(p.text for p in patterns_of(index, reference)),
            "Move the object's frames to match the pattern, or correct the pattern.",
        )
    )


def _is_promised(index: FileIndex, name: str, camera: str, setup: str) -> bool:
    """Whether a camera is expected to have taken an object under a setup."""
    if index.of(name, camera, setup) or (camera, setup) in index.broken:
        return True
    if (camera, setup) == (index.campaign.reference.camera, ""):
        return True
    if index.frames[camera, setup] and not any(index.of(name, *key) for key in index.frames):
        return False  # nothing has it: the refusal of the reference says so
    if index.has_objects(camera, setup):
        return False
    only_in_setups = not setup and any(
        "{setup}" in t for t in index.campaign.cameras[camera].patterns
    )
    return not (only_in_setups and any(c == camera and s for c, s in index.frames))


def _require_short(index: FileIndex, name: str, camera: str, setup: str) -> None:
    """Refuse a layer whose files would have names that no disk takes."""
    sensors = index.campaign.cameras[camera].sensors
    parts = (name, camera, setup, max((s.name for s in sensors), key=len, default=""))
    if (size := len(os.fsencode("_".join(filter(None, parts))))) > LONGEST_STEM:
        what = f"the names of object, camera and lighting are too long for the files of {name!r}"
        expected = f"at most {LONGEST_STEM} bytes together"
        fix = "Rename the frames, or shorten the name of the camera or of the lighting."
        problem = Problem("E_VALUE", what, None, "{target}", f"{size} bytes", expected, fix)
        raise CaptureRefused(problem)


def _require_frames(index: FileIndex, name: str, camera: str, setup: str) -> None:
    require_name(name)
    _require_short(index, name, camera, setup)
    if (camera, setup) in index.broken:
        raise index.broken[camera, setup]
    frames = index.frames[camera, setup]
    if index.of(name, camera, setup):
        return
    if (camera, setup) != (index.campaign.reference.camera, "") or not frames:
        raise CaptureRefused(_no_frames(index, camera, setup, repr(name), name))
    others = sorted({c for c, under in index.frames if index.of(name, c, under)})
    known = sorted({f.target for f in frames}, key=natural)
    raise CaptureRefused(
        Problem(
            "E_NO_FRAMES",
            f"{name}: the reference camera {camera} has no image of this object",
            str(index.campaign.path),
            f"cameras.{camera}.files",
            f"captured by {', '.join(others)}" if others else f"targets {', '.join(known)}",
            f"{{target}} = {name} in {' or '.join(p.text for p in patterns_of(index, camera))}",
            closest_match(name, known)
            if not others
            else "Add the image, or list only objects with an image in `targets.objects`.",
        )
    )


def _no_frames(index: FileIndex, camera: str, setup: str, what: str, target: str | None) -> Problem:
    """Return the problem of a pattern that no file fits, with the nearest names."""
    patterns = patterns_of(index, camera, setup)
    wanted = patterns[0].with_value("target", target) if target else patterns[0]
    folder, names = nearest(index.campaign.root, wanted, folders=index.folders)
    where = f"setups.{setup}.cameras.{camera}.files" if setup else f"cameras.{camera}.files"
    return Problem(
        "E_NO_FRAMES",
        f"{camera}{f' under {setup}' if setup else ''}: no file of {what} matches the pattern",
        file=str(folder),
        field=where,
        found=", ".join(names) if names else "nothing there",
        expected=" or ".join(dict.fromkeys(p.text for p in patterns)),
        fix=_meant(wanted, names) or "Correct the pattern, or move the frames to match it.",
    )


def _meant(wanted: Pattern, names: Sequence[str]) -> str | None:
    """Return which of some names a folder or file of a pattern may mean."""
    plain = (part for part in wanted.text.split("/") if part not in names and "{" not in part)
    return next((fix for part in plain if (fix := closest_match(part, names))), None)


def _misspelt(index: FileIndex) -> Refusals:
    """Return the refusals of captures whose files are there in other upper and lower case."""
    campaign, refusals = index.campaign, Refusals()
    others = set(declared_targets(campaign)) - set(index.objects)
    for (name, camera, setup), (path, pattern) in files_of_other_case(index).items():
        expected = name in index.objects
        if name in others or (campaign.targets.objects and not expected):
            continue
        if expected and _is_promised(index, name, camera, setup):
            continue  # it is built, or refused for what is missing
        refusals[name, camera, setup] = CaptureRefused(
            Problem(
                "E_NO_FRAMES",
                f"{camera}: a file of {name} differs from the pattern in upper and lower case",
                str(path),
                f"setups.{setup}.cameras.{camera}.files" if setup else f"cameras.{camera}.files",
                path.relative_to(campaign.root).as_posix(),
                pattern.with_value("target", name).text,
                "Rename the files, or correct the name in campaign.toml.",
            )
        )
    return refusals


def _check_reference_bands(campaign: Campaign, capture: Capture) -> None:
    """Refuse a declared reference band that the capture does not have."""
    camera = campaign.cameras[capture.camera]
    declared = {f"cameras.{camera.name}.reference_band": camera.reference_band}
    if capture.camera == campaign.reference.camera:
        declared["campaign.reference.band"] = campaign.reference.band
    for where, band in declared.items():
        if band is None:
            continue
        try:
            labels, centres = zip(*((b.label, b.wavelength) for b in capture.bands), strict=True)
            if capture.bands[find_band(labels, band, centres)].bad:
                raise CaptureRefused(bad_reference(band, capture))
        except Refused as refused:
            problems = (replace(p, file=str(campaign.path), field=where) for p in refused.problems)
            raise CaptureRefused(*problems) from None


def _capture(index: FileIndex, name: str, camera: Camera, setup: str) -> Capture:
    """Return an object by a camera, with its parts where its frames are tiles."""
    tiles = tiles_of(index.of(name, camera.name, setup), camera)
    if not tiles:
        return Capture(name, camera.name, setup, frames_of_sensors(index, name, camera, setup))
    problems: list[Problem] = []
    parts: list[Capture] = []
    for tile in tiles:
        try:
            sensors = frames_of_sensors(index, name, camera, setup, tile=tile)
            parts.append(Capture(name, camera.name, setup, sensors, tile=tile))
        except InternalError:
            raise
        except Refused as refused:
            problems.extend(refused.problems)
    if problems:
        raise CaptureRefused(*problems)
    return joined_tiles(parts, camera)


def frames_of_sensors(
    index: FileIndex, name: str, camera: Camera, setup: str, *, tile: str | None = None
) -> tuple[SensorFrames, ...]:
    """Return what every sensor of a camera saw of an object, or of one `tile` of it, everything declared found.

    Raises
    ------
    CaptureRefused
        With the problems of all sensors.
    """
    problems: list[Problem] = []
    sensors: list[SensorFrames] = []
    for sensor in camera.sensors or (None,):
        try:
            sensors.append(_sensor(index, name, camera, setup, sensor, tile))
        except InternalError:
            raise
        except Refused as refused:
            problems.extend(refused.problems)
    if problems:
        raise CaptureRefused(*problems)
    bands = [band for s in sensors for band in s.bands]
    twice = [label for label, n in Counter(b.label for b in bands).items() if n > 1]
    if twice:
        raise CaptureRefused(_same_names(index, camera, twice))
    if camera.traits.is_demosaiced:
        bands = list(with_declared_centres(camera, bands, sensors[0].object[0].path))
    left = iter(bands)
    return tuple(replace(s, bands=tuple(islice(left, len(s.bands)))) for s in sensors)


def _sensor(
    index: FileIndex,
    name: str,
    camera: Camera,
    setup: str,
    sensor: SensorKeys | None,
    tile: str | None,
) -> SensorFrames:
    """Return the frames of one sensor of an object, with its bands, darks and whites."""
    label = sensor.name if sensor else ""

    found = index.of(name, camera.name, setup)
    found = [f for f in found if f.sensor == label and tile in (None, f.tile)]
    if not found:
        whose = f"{name} {tile}" if tile else name
        raise CaptureRefused(_no_sensor(index, whose, camera, label))
    campaign = index.campaign
    templates = Templates(index, camera, label, setup, found)
    names = {"dark": campaign.darks_of(camera), "white": campaign.whites_of(camera)}
    darks = [f.ref for f in templates.of("dark", names["dark"], [setup, ""])]
    whites = [f.ref for f in templates.of("white", names["white"], [setup])]
    missing = [
        templates.missing(kind, names[kind])
        for kind, got in (("dark", darks), ("white", whites))
        if names[kind] and not got
    ]
    if missing:
        raise CaptureRefused(*missing)
    frames, pattern, bands = _frames_and_bands(index, camera, sensor, found, setup)
    darks, whites = (_fitted(index, camera, t, frames, bands) for t in (darks, whites))
    _check_exposures(camera, found, frames)
    for kind, some in (("dark", darks), ("white", whites)):
        check_every_band(camera, kind, some, bands)
    chart = _chart_frames(templates, camera, sensor, bands)
    left_out = (
        bands_beyond(index.campaign, camera, bands) if camera.traits.bands_in == "files" else ()
    )
    if left_out:
        frames, darks, chart = (
            [f for f in role if f.band not in left_out] for role in (frames, darks, chart)
        )
        bands = tuple(band for band in bands if band.label not in left_out)
        if not bands:
            raise CaptureRefused(nothing_known(index.campaign, camera, left_out))
    align = sensor.align if sensor else "measure"
    return SensorFrames(
        *(label, pattern, bands, align, tuple(frames), tuple(darks), tuple(whites), tuple(chart)),
        without_reference=left_out,
        remarks=tuple(templates.remarks),
    )


def _chart_frames(
    templates: Templates, camera: Camera, sensor: SensorKeys | None, bands: tuple[Band, ...]
) -> list[FrameRef]:
    """Return the frames of the chart that takes the place of a white, maybe in the object's own frames."""
    white, index, setup = camera.white_chart, templates.index, templates.setup
    if white is None:
        return []
    found = templates.shown
    if white.chart in index.campaign.targets.charts:
        found = templates.of("chart", [white.chart], [setup])
    if not found:
        raise CaptureRefused(no_chart_frames(index, camera, setup))
    frames, _, of_chart = _frames_and_bands(index, camera, sensor, found, setup)
    if [b.label for b in of_chart] != [b.label for b in bands]:
        raise CaptureRefused(other_chart_bands(index, camera, bands, of_chart))
    _check_exposures(camera, found, frames)
    return frames


def _frames_and_bands(
    index: FileIndex, camera: Camera, sensor: SensorKeys | None, found: list[FoundFile], setup: str
) -> tuple[list[FrameRef], Rows | None, tuple[Band, ...]]:
    """Return the frames of the object with their bands, the mosaic's pattern, and the bands."""
    frames, first = [f.ref for f in found], found[0].path
    pattern = sensor.pattern if sensor else camera.pattern
    bands_in = camera.traits.bands_in
    names = (sensor.bands if sensor else ()) or (camera.bands if bands_in == "pattern" else ())
    if bands_in == "pattern" or (sensor and pattern):
        facts = index.facts(first) if pattern is None else None
        return frames, *bands_of_mosaic(camera, pattern, names, facts)
    if bands_in != "files" and all(band_key(f) is None for f in frames):
        bands = bands_in_file(camera, sensor, index.facts(first))
        if camera.traits.reads_pages:
            _check_counts(index, camera, frames[1:], len(bands))
            frames = [in_order(camera, frame, index.facts, first) for frame in frames]
        return frames, None, bands
    if all(band_key(f) is None for f in frames):
        bands = bands_in_file(camera, None, index.facts(first), pages=True)
        _check_counts(index, camera, frames[1:], len(bands))
        frames = [in_order(camera, frame, index.facts, first) for frame in frames]
        return [page_of(f, i, b) for i, b in enumerate(bands) for f in frames], pattern, bands
    others = index.bands(camera, sensor.name if sensor else "", setup)
    frames, bands = bands_by_name(camera, frames, others, str(first.parent))
    return frames, pattern, bands


def _fitted(
    index: FileIndex,
    camera: Camera,
    templates: list[FrameRef],
    frames: list[FrameRef],
    bands: tuple[Band, ...],
) -> list[FrameRef]:
    """Give templates the bands they belong to, by name or by page; without either they serve all."""
    if camera.traits.is_cube:
        _check_counts(index, camera, templates, len(bands))
        return [in_order(camera, template, index.facts, frames[0].path) for template in templates]
    if camera.traits.bands_in != "files":
        return templates
    paged: list[FrameRef] = []
    for template in templates:
        pages = 1
        if band_key(template) is None and frames[0].page is not None:
            pages = index.facts(template.path).pages
        if pages == 1:
            paged.append(template)
            continue
        _check_counts(index, camera, [template], len(bands))
        ordered = in_order(camera, template, index.facts, frames[0].path)
        paged += [page_of(ordered, i, band) for i, band in enumerate(bands)]
    return label_templates(paged, frames, bands)


def _check_counts(index: FileIndex, camera: Camera, frames: list[FrameRef], bands: int) -> None:
    """Refuse cubes, or TIFFs of pages, that have not as many bands as the object's first file."""
    for frame in frames:
        facts = index.facts(frame.path)
        samples = facts.shape[2] if len(facts.shape) == 3 else 1
        found = samples if facts.is_cube or samples > 1 else facts.pages
        if found != bands:
            where = f"in {frame.path.name}"
            problem = count_problem(camera, "bands", bands, found, where, str(frame.path))
            raise CaptureRefused(problem)


# --- several files of one band ----------------------------------------------------------------


def _check_exposures(camera: Camera, found: list[FoundFile], frames: list[FrameRef]) -> None:
    """Refuse several files of one band, unless campaign.toml declares them shots, strips or exposures."""
    shots_are_declared = {f.path: "shot" in f.pattern.fields for f in found}
    groups: dict[str | None, list[FrameRef]] = {}
    for frame in frames:
        groups.setdefault(frame.band, []).append(frame)
    for band, group in groups.items():
        what = f"band {band}" if band else f"{group[0].target!r}"
        times = sorted({f.exposure_s for f in group if f.exposure_s is not None})
        if len(times) > 1 and camera.exposures == "one":
            raise CaptureRefused(_several_exposures(camera, what, group, times))
        if not camera.traits.declares_shots:
            continue
        for time in {f.exposure_s for f in group}:
            same = [f for f in group if f.exposure_s == time]
            if len(same) > 1 and not all(shots_are_declared[f.path] for f in same):
                raise CaptureRefused(_two_files(camera, what, same))


def _several_exposures(
    camera: Camera, what: str, frames: list[FrameRef], times: list[float]
) -> Problem:
    return Problem(
        "E_EXPOSURES",
        f"{camera.name}: several exposures of {what}",
        str(frames[0].path.parent),
        f"cameras.{camera.name}.exposures",
        ", ".join(f"{t:g} s" for t in times),
        "one exposure",
        'Write exposures = "best" (the longest unsaturated) or "merge".'
        if not camera.traits.is_scanned
        else "Name one exposure in `files`. If the files are strips of one scan, write exposures "
        '= "best": each strip is divided by its own time.',
    )


def _two_files(camera: Camera, what: str, frames: list[FrameRef]) -> Problem:
    return Problem(
        "E_BAND_TWICE",
        f"{camera.name}: two files for {what}",
        str(frames[1].path),
        f"cameras.{camera.name}.files",
        ", ".join(f.path.name for f in frames[:3]) + (" …" if len(frames) > 3 else ""),
        "one file",
        "Remove one. If they are shots to average, write {shot} where the names differ.",
    )


def _same_names(index: FileIndex, camera: Camera, twice: list[str]) -> Problem:
    return Problem(
        "E_BAND_TWICE",
        f"{camera.name}: two channels have the same name",
        str(index.campaign.path),
        f"cameras.{camera.name}.bands",
        ", ".join(twice),
        "names that differ",
        "Give each sensor's channels names of their own, such as R1 and R2.",
    )


# --- missing frames ----------------------------------------------------------------------------


def _no_sensor(index: FileIndex, name: str, camera: Camera, sensor: str) -> Problem:
    patterns = " or ".join(p.text for p in patterns_of(index, camera.name, sensor=sensor))
    return Problem(
        "E_BAND_MISSING",
        f"{camera.name}: sensor {sensor} has no frame of {name!r}",
        str(index.campaign.path),
        f"cameras.{camera.name}.sensors.{sensor}.files",
        "no file",
        patterns,
        "Add the frames, or correct the pattern.",
    )
