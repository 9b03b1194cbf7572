"""Bands of files: a mosaic's channels, a cube's or a photograph's bands, or one file a band."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from math import isqrt, nan
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.campaign.discovery.captures import Capture, CaptureRefused, FrameRef, Rows
from levkas.campaign.discovery.patterns import natural
from levkas.core.cube import Band, band_labels
from levkas.core.problems import Problem
from levkas.readers.compared_facts import NEAREST_NM
from levkas.readers.wavelengths import RANGE_NM, centres_in_names, is_plausible

if TYPE_CHECKING:
    from levkas.campaign.campaign import Camera
    from levkas.campaign.schema.tables import SensorKeys
    from levkas.readers.facts import Facts

Key = float | str
SAME_DECIMALS = 6
"""Decimals of nm to which two wavelengths are one, as files and campaign.toml write them."""
"""Declared wavelengths may differ from a header's by `NEAREST_NM`, or by half a step where that is more."""


def bands_of_mosaic(
    camera: Camera, pattern: Rows | None, names: Sequence[str] | None, facts: Facts | None
) -> tuple[Rows, tuple[Band, ...]]:
    """Return the channels of a mosaic, and its pattern with their names in place of letters.

    Names are those of red, green, blue in this order where the pattern has these letters, else of
    the channels in the order in which the pattern first shows them.
    """
    if facts and facts.kind == "raw-colours":
        raise CaptureRefused(
            Problem(
                "E_RENDERED",
                f"{camera.name}: this raw holds colours and no mosaic, as a linear DNG does",
                str(facts.path),
                f"cameras.{camera.name}.kind",
                camera.kind,
                "the mosaic of the sensor",
                'Write kind = "image" for a photograph, kind = "cube" to calibrate the colours by darks and whites, '
                "or name the camera's own raw file.",
            )
        )
    letters = facts.pattern if facts and pattern is None else None
    if letters:
        side = isqrt(len(letters))
        pattern = tuple(tuple(letters[i : i + side]) for i in range(0, len(letters), side))
    if pattern is None:
        raise CaptureRefused(
            Problem(
                "E_VALUE",
                f"{camera.name}: neither campaign.toml nor the file gives the mosaic pattern",
                str(facts.path) if facts else None,
                f"cameras.{camera.name}.pattern",
                expected='such as pattern = "RGGB"',
                fix='Declare `pattern`; a camera without a mosaic has kind = "bands" or "sensors".',
            )
        )
    channels = list(dict.fromkeys(name for row in pattern for name in row))
    if set(channels) == set("RGB"):
        channels = list("RGB")
    if names and set(names) == set(channels):
        channels = list(names)
    elif names:
        if len(names) != len(channels):
            where = str(facts.path) if facts else ""
            raise CaptureRefused(
                count_problem(camera, "bands", len(names), len(channels), "channels", where)
            )
        named = dict(zip(channels, names, strict=True))
        pattern = tuple(tuple(named[name] for name in row) for row in pattern)
        channels = list(names)
    return pattern, tuple(Band(name) for name in channels)


def bands_in_file(
    camera: Camera, sensor: SensorKeys | None, facts: Facts, *, pages: bool = False
) -> tuple[Band, ...]:
    """Return the bands of a file that holds them all: a cube, a photograph, a sensor without a mosaic.

    Declared names and wavelengths go before the header's; counts must agree.

    Parameters
    ----------
    pages : bool
        Whether bands are pages of a TIFF, not samples of a pixel.
    """
    samples = facts.shape[2] if len(facts.shape) == 3 else 1
    paged = camera.traits.reads_pages
    mixed = samples > 1 and facts.pages > 1 and (pages or paged)
    pages = pages or (paged and samples == 1 and len(facts.shape) == 2)
    count = facts.pages if pages else samples
    where, unit = str(facts.path), "pages" if pages else "bands"
    if not (camera.traits.is_calibrated or paged) and count not in (1, 3):
        raise CaptureRefused(
            Problem(
                "E_BAND_COUNT",
                f"{camera.name}: an image has 1 or 3 channels",
                where,
                f"cameras.{camera.name}.kind",
                count,
                "1 or 3",
                'Write kind = "cube".',
            )
        )
    names = (sensor.bands if sensor else ()) or camera.bands
    centres = camera.centres if sensor is None else None
    for field, declared in (("wavelengths", centres), ("bands", names)):
        if declared and len(declared) != count:
            raise CaptureRefused(count_problem(camera, field, len(declared), count, unit, where))
    if mixed:
        raise CaptureRefused(_pages_of_colours(camera, facts))
    header = facts.wavelengths if facts.wavelengths and len(facts.wavelengths) == count else None
    for stated in (centres, centres_in_names(names or ())):
        if stated and header and "wavelengths" not in camera.overrule:
            _check_near(camera, stated, header, where)
    if "bands" not in camera.overrule:
        _check_order(camera, names, facts)
    if centres is None and facts.wavelengths_unclear:
        raise CaptureRefused(_unclear(camera, facts))
    centres = centres or header
    widths = facts.fwhm if facts.fwhm and len(facts.fwhm) == count else (nan,) * count
    named = names or _default_names(camera, sensor, facts, count, centres)
    bad = facts.bad_bands or ()
    rows = zip(named, centres or (nan,) * count, widths, strict=True)
    return tuple(Band(n, w, f, i in bad) for i, (n, w, f) in enumerate(rows))


def _default_names(
    camera: Camera,
    sensor: SensorKeys | None,
    facts: Facts,
    count: int,
    centres: Sequence[float] | None,
) -> Sequence[str]:
    if not (camera.traits.is_calibrated or camera.traits.reads_pages):
        return ("R", "G", "B") if count == 3 else ("grey",)
    names = facts.band_names if facts.band_names and len(facts.band_names) == count else None
    if sensor is not None and count == 1:
        return names or (sensor.name,)
    if centres:
        return band_labels(centres)
    if names and len(set(names)) == count:
        return names
    return [f"band {i + 1}" for i in range(count)]


def _check_near(
    camera: Camera, declared: Sequence[float], header: Sequence[float], path: str
) -> None:
    steps = sorted(abs(b - a) for a, b in pairwise(header))
    allowed = max(NEAREST_NM, steps[len(steps) // 2] / 2 if steps else 0.0)
    for ours, theirs in zip(declared, header, strict=True):
        if abs(ours - theirs) > allowed:
            raise CaptureRefused(
                Problem(
                    "E_VALUE",
                    f"{camera.name}: `wavelengths` differ from the header",
                    path,
                    f"cameras.{camera.name}.wavelengths",
                    f"{theirs:g} nm in the header",
                    f"{ours:g} nm",
                    "Correct `wavelengths`, or remove the key to use those of the header; "
                    '`overrule = ["wavelengths"]` takes those of campaign.toml.',
                )
            )


def in_order(
    camera: Camera, frame: FrameRef, facts_of: Callable[[Path], Facts], first: Path
) -> FrameRef:
    """Return a frame with the order of its bands where another than that of the object's first file is stated."""
    if {"wavelengths", "bands"} & set(camera.overrule):
        return frame
    return replace(frame, order=order_of(facts_of(frame.path), facts_of(first)))


def page_of(frame: FrameRef, number: int, band: Band) -> FrameRef:
    """Return a frame of several pages as that of one band, which is the object's `number`-th."""
    page = frame.order[number] if frame.order else number
    return replace(frame, band=band.label, page=page, order=None)


def order_of(own: Facts, other: Facts) -> tuple[int, ...] | None:
    """Return where a file has each of another's bands, by their wavelengths, else by their names or the labels of pages.

    None where they stand in the same order, or are not the same bands.

    >>> from levkas.readers.facts import Facts
    >>> first = Facts(Path("a.hdr"), "envi", (1, 1, 3), "uint16", wavelengths=(450, 550, 650))
    >>> order_of(replace(first, wavelengths=(650, 550.2, 450)), first)
    (2, 1, 0)
    """
    if own.wavelengths and other.wavelengths:
        return _matched(own.wavelengths, other.wavelengths)
    named = _matched_names(own.band_names or (), other.band_names or ())
    return named or _matched_names(own.page_labels or (), other.page_labels or ())


def _matched(own: Sequence[float], other: Sequence[float]) -> tuple[int, ...] | None:
    if (
        len(own) != len(other)
        or max(abs(a - b) for a, b in zip(own, other, strict=True)) <= NEAREST_NM
    ):
        return None
    ours, theirs = (sorted(range(len(w)), key=w.__getitem__) for w in (own, other))
    if any(abs(own[i] - other[j]) > NEAREST_NM for i, j in zip(ours, theirs, strict=True)):
        return None
    places = dict(zip(theirs, ours, strict=True))
    return tuple(places[j] for j in range(len(other)))


def _matched_names(own: Sequence[str], other: Sequence[str]) -> tuple[int, ...] | None:
    same = list(own) == list(other) or sorted(own) != sorted(other) or len(set(own)) < len(own)
    return None if same else tuple(own.index(name) for name in other)


def _check_order(camera: Camera, declared: Sequence[str] | None, facts: Facts) -> None:
    """Refuse declared names that the file has in another order: its bands would be exchanged."""
    mine = [name.strip().lower() for name in declared or ()]
    for names in (facts.band_names, facts.page_labels):
        theirs = [name.strip().lower() for name in names or ()]
        if mine and mine != theirs and sorted(mine) == sorted(theirs):
            raise CaptureRefused(
                Problem(
                    "E_VALUE",
                    f"{camera.name}: the file has its bands in another order than `bands`",
                    str(facts.path),
                    f"cameras.{camera.name}.bands",
                    ", ".join(names or ()),
                    ", ".join(declared or ()),
                    "Write `bands` in the file's order, or remove the key.",
                )
            )


def _unclear(camera: Camera, facts: Facts) -> Problem:
    least, most = RANGE_NM
    return Problem(
        "E_VALUE",
        f"{camera.name}: the wavelengths in the file cannot be those of a camera",
        str(facts.path),
        "wavelength",
        facts.wavelengths_unclear,
        f"{least:g} to {most:g} nm, in a unit that the file states",
        f"Correct the unit in the file, or declare `wavelengths` under [cameras.{camera.name}].",
    )


def bad_reference(band: str, capture: Capture) -> Problem:
    """Return the problem of a declared reference band that its own file calls bad."""
    return Problem(
        "E_BAND_MISSING",
        f"{capture.camera}: the reference band is bad by its own file",
        found=f"{band} in {capture.sensors[0].object[0].path.name}",
        expected="a band that its file does not call bad",
        fix="Name another band, or correct the list of bad bands (bbl) in the header.",
    )


def _pages_of_colours(camera: Camera, facts: Facts) -> Problem:
    return Problem(
        "E_BAND_COUNT",
        f"{camera.name}: pages of several samples are no bands",
        str(facts.path),
        f"cameras.{camera.name}.kind",
        f"{facts.pages} pages of {facts.shape[2]} samples a pixel",
        "pages of one sample, or one page",
        "Save the bands as grey pages of one TIFF.",
    )


def with_declared_centres(camera: Camera, bands: Sequence[Band], path: Path) -> tuple[Band, ...]:
    """Give channels of a mosaic, or of several sensors, the centres that are declared for them."""
    centres = camera.centres
    if centres is None:
        return tuple(bands)
    if len(centres) != len(bands):
        raise CaptureRefused(
            count_problem(camera, "wavelengths", len(centres), len(bands), "channels", str(path))
        )
    return tuple(replace(b, wavelength=w) for b, w in zip(bands, centres, strict=True))


def bands_text(declared: Sequence[float | str]) -> str:
    """Return the declared bands in words.

    >>> bands_text([400.0, 410.0, 420.0])
    '400–420 nm by 10 nm is 3 bands'
    """
    count = len(declared)
    if count > 2 and all(isinstance(k, float) for k in declared):
        centres = [float(k) for k in declared]
        step = centres[1] - centres[0]
        if all(abs(b - a - step) < 1e-6 for a, b in pairwise(centres)):
            return f"{centres[0]:g}–{centres[-1]:g} nm by {step:g} nm is {count} bands"
    return f"{count} bands are declared"


def count_problem(
    camera: Camera, field: str, declared: int, found: int, what: str, path: str
) -> Problem:
    """Return the problem of bands whose number does not fit `field`."""
    declaration = bands_text(camera.centres) if field == "wavelengths" and camera.centres else ""
    return Problem(
        "E_BAND_COUNT",
        f"{camera.name}: {declaration or f'{declared} {field} are declared'}, there are {found} {what}",
        path or None,
        f"cameras.{camera.name}.{field}",
        found,
        declared,
        f"Correct `{field}` in campaign.toml, or replace an incomplete file.",
    )


def band_key(frame: FrameRef) -> Key | None:
    """Return the key of a frame's band: its wavelength, else its name, else None."""
    return frame.wavelength if frame.wavelength is not None else frame.band


def key_text(key: Key | None) -> str:
    """Return a band's key as text.

    >>> key_text(366.55)
    '366.55 nm'
    """
    return f"{key:g} nm" if isinstance(key, float) else str(key)


def bands_by_name(
    camera: Camera, frames: Sequence[FrameRef], others: set[Key], folder: str
) -> tuple[list[FrameRef], tuple[Band, ...]]:
    """Order frames whose names have their band, and check them against what is expected.

    Parameters
    ----------
    camera : Camera
    frames : sequence of FrameRef
        Of one object.
    others : set
        Bands of the camera's other objects and whites: expected too where nothing is declared.
    folder : str
        For messages.

    Returns
    -------
    frames : list of FrameRef
        With labels as their bands, band after band.
    bands : tuple of Band

    Raises
    ------
    CaptureRefused
        For a missing band, one too many, or a name without its wavelength.
    """
    found = {band_key(f) for f in frames}
    if None in found:
        raise CaptureRefused(_nameless(camera, [f for f in frames if band_key(f) is None]))
    keys = sorted((k for k in found if k is not None), key=_order)
    by_wavelength = all(isinstance(k, float) for k in keys)
    declared: Sequence[Key] | None = camera.centres if by_wavelength else camera.bands
    keys = _checked(camera, keys, declared, others, folder)
    if by_wavelength:
        centres = [float(k) for k in keys]
        if not all(map(is_plausible, centres)):
            raise CaptureRefused(_not_a_wavelength(camera, frames))
        names = camera.bands or _names_of(frames, keys) or tuple(band_labels(centres))
    else:
        names, centres = tuple(str(k) for k in keys), list(camera.centres or [nan] * len(keys))
    if len(names) != len(keys):
        raise CaptureRefused(count_problem(camera, "bands", len(names), len(keys), "files", folder))
    bands = tuple(Band(n, w) for n, w in zip(names, centres, strict=True))
    labels = dict(zip(keys, names, strict=True))
    ranks = {key: i for i, key in enumerate(keys)}
    ordered = sorted(frames, key=lambda f: (ranks[_sure(f)], f.exposure_s or 0.0))
    return [replace(f, band=labels[_sure(f)]) for f in ordered], bands


def label_templates(
    templates: Sequence[FrameRef], frames: Sequence[FrameRef], bands: Sequence[Band]
) -> list[FrameRef]:
    """Give templates the labels of the bands they belong to; those of other bands are left out.

    Parameters
    ----------
    templates : sequence of FrameRef
        As found.
    frames : sequence of FrameRef
        Of the object, labelled.
    bands : sequence of Band
    """
    labels: dict[Key, str] = {b.wavelength: b.label for b in bands if b.wavelength == b.wavelength}
    labels |= {f.wavelength: f.band for f in frames if f.wavelength is not None and f.band}
    labels |= {b.label: b.label for b in bands}
    result = []
    for frame in templates:
        key = band_key(frame)
        if key is None or frame.page is not None:
            result.append(frame)
        elif key in labels:
            result.append(replace(frame, band=labels[key]))
    return result


def _order(key: Key) -> tuple[int, float, tuple[tuple[int, int, str], ...]]:
    return (0, key, ()) if isinstance(key, float) else (1, 0.0, natural(key))


def _sure(frame: FrameRef) -> Key:
    key = band_key(frame)
    return "" if key is None else key


def _names_of(frames: Sequence[FrameRef], keys: Sequence[Key]) -> tuple[str, ...] | None:
    """Return the names beside wavelengths in the files' names."""
    names = {f.wavelength: f.band for f in frames if f.wavelength is not None}
    found = tuple(str(names[k]) for k in keys if isinstance(k, float) and names.get(k))
    return found if len(set(found)) == len(keys) else None


def _checked(
    camera: Camera, keys: list[Key], declared: Sequence[Key] | None, others: set[Key], folder: str
) -> list[Key]:
    """Return the keys in their order, or refuse."""
    alike = {k for k in others if isinstance(k, float) == isinstance(keys[0], float)}
    expected = list(declared) if declared else sorted({*keys, *alike}, key=_order)
    known = {_rounded(k): k for k in keys}
    match = {k: known.get(_rounded(k)) for k in expected}
    missing = [k for k in expected if match[k] is None]
    taken = set(match.values())
    surplus = [k for k in keys if k not in taken]
    if not missing and not surplus:
        return [k for k in match.values() if k is not None]
    expectation = bands_text(declared) if declared else f"other targets have {len(expected)} bands"
    lack = "missing " if missing else "not declared: "
    field = "wavelengths" if isinstance(expected[0], float) else "bands"
    raise CaptureRefused(
        Problem(
            "E_BAND_MISSING" if missing else "E_BAND_COUNT",
            f"{camera.name}: {expectation}, the folder has {len(keys)} ({lack}{_listed(missing or surplus)})",
            folder,
            f"cameras.{camera.name}.{field}",
            len(keys),
            len(expected),
            f"Add the missing files, or list only the existing bands in `{field}`."
            if missing
            else f"Remove these files, or add their bands to `{field}`.",
        )
    )


def _rounded(key: Key) -> Key:
    return round(key, SAME_DECIMALS) if isinstance(key, float) else key


def _not_a_wavelength(camera: Camera, frames: Sequence[FrameRef]) -> Problem:
    odd = next(f for f in frames if f.wavelength is not None and not is_plausible(f.wavelength))
    return Problem(
        "E_VALUE",
        f"{camera.name}: a file name holds no wavelength of a camera's band",
        str(odd.path),
        f"cameras.{camera.name}.files",
        f"{odd.wavelength:g} nm by {{wavelength}}",
        f"{RANGE_NM[0]:g} to {RANGE_NM[1]:g} nm",
        "Write {wavelength} with the unit that the numbers are in, {wavelength}nm or {wavelength}um, and * for a unit "
        "in the names that is wrong; write {band} for numbers of filters.",
    )


def _listed(keys: Sequence[Key]) -> str:
    some, more = keys[:6], " …" if len(keys) > 6 else ""
    if all(isinstance(k, float) for k in some):
        return ", ".join(f"{k:g}" for k in some) + f"{more} nm"
    return ", ".join(map(key_text, some)) + more


def _nameless(camera: Camera, frames: list[FrameRef]) -> Problem:
    return Problem(
        "E_BAND_MISSING",
        f"{camera.name}: a file name does not contain the band",
        str(frames[0].path),
        f"cameras.{camera.name}.files",
        frames[0].path.name,
        "a pattern with {wavelength} or {band}",
        "Correct the pattern that matches this file.",
    )
