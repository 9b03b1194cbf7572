"""Which files hold which frame of which capture, checked against what the campaign declares."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path

from levkas.campaign import Camera, Campaign, Sensor
from levkas.cube import Band, band_labels
from levkas.patterns import Found, find, natural
from levkas.problems import Problem, Refused


class CaptureRefused(Refused):
    """One capture cannot be built; the others are."""


@dataclass(frozen=True)
class FrameRef:
    """Where one exposure of one sensor stands, and what its name says of it."""

    path: Path
    target: str
    sensor: str = ""
    band: str | None = None
    wavelength: float | None = None
    exposure_s: float | None = None
    shot: str = ""
    setup: str = ""
    page: int | None = None


@dataclass(frozen=True)
class SensorFrames:
    """Everything that one sensor saw for one object, templates included.

    Parameters
    ----------
    name : str
        Empty for a camera of one sensor.
    pattern : rows of channel names, or None
    bands : tuple of Band
        That this sensor yields, in order.
    align : "measure" or ((a, b, c), (d, e, f))
        Native px of the camera's first sensor → this one.
    object, dark, white : tuple of FrameRef
    """

    name: str
    pattern: tuple[tuple[str, ...], ...] | None
    bands: tuple[Band, ...]
    align: str | tuple[tuple[float, ...], ...]
    object: tuple[FrameRef, ...]
    dark: tuple[FrameRef, ...] = ()
    white: tuple[FrameRef, ...] = ()


@dataclass(frozen=True)
class Capture:
    """One object by one camera under one setup; the setup is empty for the default one."""

    object: str
    camera: str
    setup: str
    sensors: tuple[SensorFrames, ...]

    @property
    def bands(self) -> tuple[Band, ...]:
        """All bands, sensor by sensor."""
        return tuple(band for sensor in self.sensors for band in sensor.bands)

    @property
    def layer(self) -> str:
        """Camera and setup as frames are named: ``d80@45-degree``."""
        return f"{self.camera}@{self.setup}" if self.setup else self.camera


Refusals = dict[tuple[str, str, str], Refused]


def find_captures(campaign: Campaign) -> tuple[list[Capture], Refusals]:
    """Find every capture of a campaign.

    Returns
    -------
    captures : list of Capture
        Object by object, the reference camera first.
    refusals : dict
        (object, camera, setup) → what is wrong with that capture alone.

    Raises
    ------
    CaptureRefused
        Where there is no object at all.
    """
    found = {
        (c, ""): _find_frames(campaign, camera, None) for c, camera in campaign.cameras.items()
    }
    for setup, keys in campaign.setups.items():
        for c, own in keys.cameras.items():
            found[c, setup] = _find_frames(campaign, campaign.cameras[c], own.files)
    objects = _objects(campaign, found)
    captures, refusals = [], {}
    reference = campaign.reference.camera
    order = sorted(found, key=lambda key: (key[0] != reference or key[1] != "", bool(key[1])))
    for name in objects:
        for camera, setup in order:
            frames = found[camera, setup]
            if (
                not any(f.target == name for f in frames)
                and (setup or camera != reference)
                and any(f.target in objects for f in frames)
            ):
                continue  # this camera, or setup, did not take this object: nothing was promised
            try:
                captures.append(_capture(campaign, name, camera, setup, frames, found[camera, ""]))
            except Refused as refused:
                refusals[name, camera, setup] = refused
    return captures, refusals


def _find_frames(campaign: Campaign, camera: Camera, files: Sequence[str] | None) -> list[FrameRef]:
    """Every frame of one camera under one lighting, of whatever target."""
    targets = _all_targets(campaign)
    frames: list[FrameRef] = []
    sensors: Iterable[Sensor] = camera.sensors or (Sensor(name=""),)
    for sensor in sensors:
        patterns = files or sensor.files or camera.files
        if sensor.name:
            patterns = tuple(p.replace("{sensor}", sensor.name) for p in patterns)
        for f in find(campaign.root, patterns, targets):
            frames.append(_frame(f, sensor.name))
    return frames


def _frame(found: Found, sensor: str) -> FrameRef:
    return FrameRef(
        path=found.path,
        target=found.target,
        sensor=sensor or found.sensor,
        band=found.band or None,
        wavelength=found.wavelength,
        exposure_s=found.exposure_s,
        shot=found.shot,
        setup=found.setup,
    )


def _all_targets(campaign: Campaign) -> tuple[str, ...]:
    targets = campaign.targets
    white = targets.white.names if targets.white else ()
    own = [n for c in campaign.cameras.values() for n in (*(c.dark or ()), *(c.white or ()))]
    return (*targets.dark, *white, *targets.charts, *(targets.objects or ()), *own)


def _objects(campaign: Campaign, found: dict[tuple[str, str], list[FrameRef]]) -> list[str]:
    if campaign.targets.objects:
        return list(campaign.targets.objects)
    known = set(_all_targets(campaign))
    camera = campaign.reference.camera
    names = {f.target for f in found[camera, ""]} - known
    if not names:
        raise CaptureRefused(
            _nothing(campaign, camera, "an object", campaign.cameras[camera].files)
        )
    return sorted(names, key=natural)


def _nothing(campaign: Campaign, camera: str, what: str, patterns: Sequence[str]) -> Problem:
    """No file fits; show the pattern and what stands where it looks."""
    folder = campaign.root
    for segment in patterns[0].replace("\\", "/").split("/")[:-1] if patterns else ():
        if any(c in segment for c in "{*?"):
            break
        folder = folder.parent if segment == ".." else folder / segment
    try:
        there = sorted(p.name for p in folder.iterdir() if not p.name.startswith("."))
    except OSError:
        there = []
    shown = ", ".join(there[:3]) + (" …" if len(there) > 3 else "")
    return Problem(
        "E_NO_FRAMES",
        f"{camera}: no file fits for {what}",
        file=str(folder),
        field=f"cameras.{camera}.files",
        found=shown or "nothing there",
        expected=" or ".join(patterns),
        fix="Mend the pattern, or put the frames where it looks.",
    )


def _capture(
    campaign: Campaign,
    name: str,
    camera: str,
    setup: str,
    frames: list[FrameRef],
    default: list[FrameRef],
) -> Capture:
    keys = campaign.cameras[camera]
    names = [s.name for s in keys.sensors] or [""]
    problems: list[Problem] = []
    sensors = []
    for sensor in names:
        try:
            sensors.append(_sensor(campaign, keys, name, setup, sensor, frames, default))
        except Refused as refused:
            problems.extend(refused.problems)
    if problems:
        raise CaptureRefused(*problems)
    labels = [band.label for s in sensors for band in s.bands]
    if twice := [label for label, n in Counter(labels).items() if n > 1]:
        raise CaptureRefused(
            Problem(
                "E_BAND_TWICE",
                f"{camera}: two channels have one name",
                str(campaign.path),
                f"cameras.{camera}.bands",
                ", ".join(twice),
                "names that differ",
                "Give each sensor's channels names of their own, such as R1 and R2.",
            )
        )
    return Capture(name, camera, setup, tuple(sensors))


def _sensor(
    campaign: Campaign,
    camera: Camera,
    name: str,
    setup: str,
    sensor: str,
    frames: list[FrameRef],
    default: list[FrameRef],
) -> SensorFrames:
    """Frames and bands of one sensor, everything declared found."""
    declared = next((s for s in camera.sensors if s.name == sensor), None)
    mine = [f for f in frames if f.sensor == sensor or not sensor]
    of = [f for f in mine if f.target == name]
    where = f"{camera.name} {sensor}".strip()
    if not of:
        patterns = (declared.files if declared else ()) or camera.files
        raise CaptureRefused(
            _nothing(
                campaign, camera.name, f"{name!r}{' by ' + sensor if sensor else ''}", patterns
            )
        )
    own_dark = [f for f in mine if f.target in _darks(campaign, camera)]
    dark = own_dark or [
        f
        for f in default
        if f.target in _darks(campaign, camera) and (f.sensor == sensor or not sensor)
    ]
    white = [f for f in mine if f.target in _whites(campaign, camera)]
    if camera.kind != "image":
        _require_templates(campaign, camera, where, dark, white)
    pattern = (declared.pattern if declared else None) or camera.pattern
    if camera.kind == "bands":
        of, bands = _bands_by_file(campaign, camera, of)
        dark, white = (_with_pages(frames_, of) for frames_ in (dark, white))
    else:
        pattern, bands = _bands_in_file(campaign, camera, declared, of[0].path, pattern)
    return SensorFrames(
        sensor,
        pattern,
        bands,
        declared.align if declared else "measure",
        tuple(of),
        tuple(dark),
        tuple(white),
    )


def _darks(campaign: Campaign, camera: Camera) -> tuple[str, ...]:
    return camera.dark if camera.dark is not None else campaign.targets.dark


def _whites(campaign: Campaign, camera: Camera) -> tuple[str, ...]:
    if camera.white is not None:
        return camera.white
    return campaign.targets.white.names if campaign.targets.white else ()


def _require_templates(
    campaign: Campaign, camera: Camera, where: str, dark: list[FrameRef], white: list[FrameRef]
) -> None:
    problems = []
    for kind, names, got in (
        ("dark", _darks(campaign, camera), dark),
        ("white", _whites(campaign, camera), white),
    ):
        if names and not got:
            patterns = camera.files or tuple(f for s in camera.sensors for f in s.files)
            problems.append(
                Problem(
                    "E_TEMPLATE_MISSING",
                    f"{where}: the declared {kind} was not found",
                    file=str(campaign.path),
                    field=f"targets.{kind}",
                    found="no file",
                    expected=f"{{target}} = {' or '.join(names)} in {' or '.join(patterns)}",
                    fix=f"Add the frames, or write `{kind} = []` under [cameras.{camera.name}] if there are none.",
                )
            )
    if problems:
        raise CaptureRefused(*problems)


# --- bands ------------------------------------------------------------------------------------


def _bands_by_file(
    campaign: Campaign, camera: Camera, of: list[FrameRef]
) -> tuple[list[FrameRef], tuple[Band, ...]]:
    """One file a band, or one file whose pages are the bands."""
    if all(f.wavelength is None and f.band is None for f in of):
        return _bands_by_page(campaign, camera, of)
    groups: dict[object, list[FrameRef]] = defaultdict(list)
    for f in of:
        groups[f.wavelength if f.wavelength is not None else f.band].append(f)
    keys = sorted(
        groups, key=lambda k: (isinstance(k, str), k if isinstance(k, float) else natural(str(k)))
    )
    folder = str(of[0].path.parent)
    _check_bands(campaign, camera, keys, folder)
    for key in keys:
        _check_one_file(camera, key, groups[key])
    if all(isinstance(k, float) for k in keys):
        labels = band_labels([float(str(k)) for k in keys])
        bands = [Band(label, float(str(k))) for label, k in zip(labels, keys, strict=True)]
    else:
        order = list(camera.bands) if camera.bands else [str(k) for k in keys]
        keys = sorted(keys, key=lambda k: order.index(str(k)))
        centres = camera.centres or (nan,) * len(keys)
        bands = [Band(str(k), w) for k, w in zip(keys, centres, strict=True)]
    labelled = {k: band.label for k, band in zip(keys, bands, strict=True)}
    frames = [replace(f, band=labelled[k]) for k in keys for f in groups[k]]
    return frames, tuple(bands)


def _check_bands(campaign: Campaign, camera: Camera, keys: list[object], folder: str) -> None:
    expected: list[object] = (
        list(camera.centres or ())
        if all(isinstance(k, float) for k in keys)
        else list(camera.bands or ())
    )
    if not expected:
        return
    missing = [k for k in expected if k not in keys]
    surplus = [k for k in keys if k not in expected]
    if not missing and not surplus:
        return
    told = f"{_list(missing)} missing" if missing else f"{_list(surplus)} too many"
    code = "E_BAND_MISSING" if missing else "E_BAND_COUNT"
    field = f"cameras.{camera.name}." + (
        "wavelengths" if isinstance(expected[0], float) else "bands"
    )
    raise CaptureRefused(
        Problem(
            code,
            f"{camera.name}: {len(expected)} bands are declared, the folder has {len(keys)}: {told}",
            folder,
            field,
            len(keys),
            len(expected),
            f"Add the missing files, or mend `{field}` in {campaign.path.name}.",
        )
    )


def _check_one_file(camera: Camera, key: object, frames: list[FrameRef]) -> None:
    """Several files of one band are shots where the pattern says {shot}, exposures where it says so."""
    times = {f.exposure_s for f in frames}
    if len(times) > 1 and camera.exposures == "one":
        raise CaptureRefused(_several_exposures(camera, str(key), frames, times))
    files = [f for text in camera.files for f in [text]]
    if any("{shot}" in text for text in files):
        return
    for time in times:
        same = [f for f in frames if f.exposure_s == time]
        if len(same) > 1:
            raise CaptureRefused(
                Problem(
                    "E_BAND_TWICE",
                    f"{camera.name}: two files for band {_name(key)}",
                    str(same[1].path),
                    f"cameras.{camera.name}.files",
                    ", ".join(f.path.name for f in same[:3]),
                    "one file",
                    "Take one away, or write {shot} where the names differ if they are shots to average.",
                )
            )


def _several_exposures(
    camera: Camera, key: str, frames: list[FrameRef], times: set[float | None]
) -> Problem:
    told = ", ".join(f"{t:g} s" for t in sorted(t for t in times if t is not None))
    return Problem(
        "E_EXPOSURES",
        f"{camera.name}: several exposures of {_name(key)}",
        str(frames[0].path.parent),
        f"cameras.{camera.name}.exposures",
        told,
        "one exposure",
        'Write exposures = "best" (the longest unsaturated) or "merge".',
    )


def _bands_by_page(
    campaign: Campaign, camera: Camera, of: list[FrameRef]
) -> tuple[list[FrameRef], tuple[Band, ...]]:
    from levkas.readers.frames import read_facts

    facts = read_facts(of[0].path)
    bands = _named_bands(
        campaign, camera, camera.bands, facts.pages, str(of[0].path), "pages", facts.wavelengths
    )
    return [replace(f, band=b.label, page=i) for i, b in enumerate(bands) for f in of], bands


def _with_pages(frames: list[FrameRef], of: list[FrameRef]) -> list[FrameRef]:
    """Give templates the bands of the object's frames: by wavelength, by name, by page, or shared."""
    by_wavelength = {f.wavelength: f.band for f in of if f.wavelength is not None}
    pages = {f.band: f.page for f in of if f.page is not None}
    result = []
    for f in frames:
        if f.wavelength is not None:
            result.append(replace(f, band=by_wavelength.get(f.wavelength, f"{f.wavelength:g} nm")))
        elif f.band is None and pages:
            result.extend(replace(f, band=band, page=page) for band, page in pages.items())
        else:
            result.append(f)
    return result


def _bands_in_file(
    campaign: Campaign,
    camera: Camera,
    sensor: Sensor | None,
    path: Path,
    pattern: tuple[tuple[str, ...], ...] | None,
) -> tuple[tuple[tuple[str, ...], ...] | None, tuple[Band, ...]]:
    """Bands of one file that holds them all: a mosaic, a cube, a photograph or a mono sensor."""
    from levkas.readers.frames import read_facts

    declared = (sensor.bands if sensor else ()) or camera.bands
    if camera.kind == "mosaic" or (camera.kind == "sensors" and pattern is not None):
        if pattern is None and (letters := read_facts(path).pattern):
            pattern = ((letters[0], letters[1]), (letters[2], letters[3]))
        if pattern is None:
            raise CaptureRefused(
                Problem(
                    "E_VALUE",
                    f"{camera.name}: the file does not say its mosaic",
                    str(path),
                    f"cameras.{camera.name}.pattern",
                    "none",
                    'such as "RGGB"',
                    "Declare `pattern`.",
                )
            )
        channels = list(dict.fromkeys(n for row in pattern for n in row))
        if declared and len(declared) == len(channels) and set(declared) != set(channels):
            # Names for the letters in the order red, green, blue, or as they come in the pattern.
            letters_ = (
                [c for c in "RGB" if c in channels] if set(channels) == set("RGB") else channels
            )
            named = dict(zip(letters_, declared, strict=True))
            pattern = tuple(tuple(named[n] for n in row) for row in pattern)
            channels = [named[c] for c in letters_]
        elif set(channels) == set("RGB"):
            channels = list("RGB")
        elif declared:
            channels = list(declared)
        return pattern, _named_bands(
            campaign, camera, channels, len(channels), str(path), "channels", None
        )
    facts = read_facts(path)
    if camera.kind == "cube":
        count = (
            facts.shape[2]
            if facts.kind == "envi"
            else (facts.pages if facts.pages > 1 else (*facts.shape, 1)[2])
        )
        return None, _named_bands(
            campaign, camera, declared, count, str(path), "bands", facts.wavelengths, facts.fwhm
        )
    count = facts.shape[2] if len(facts.shape) == 3 else 1
    if camera.kind == "image":
        names = declared or (("R", "G", "B") if count == 3 else ("grey",))
        if count not in (1, 3):
            raise CaptureRefused(
                Problem(
                    "E_BAND_COUNT",
                    f"{camera.name}: an image has 1 or 3 channels",
                    str(path),
                    f"cameras.{camera.name}.kind",
                    count,
                    "1 or 3",
                    'Use kind = "cube" for more.',
                )
            )
        return None, _named_bands(campaign, camera, names, count, str(path), "channels", None)
    names = declared or facts.band_names or (f"{sensor.name}" if sensor else camera.name,)
    return None, _named_bands(
        campaign, camera, tuple(names), count, str(path), "channels", facts.wavelengths, facts.fwhm
    )


def _named_bands(
    campaign: Campaign,
    camera: Camera,
    names: Sequence[str] | None,
    count: int,
    path: str,
    what: str,
    wavelengths: Sequence[float] | None,
    fwhm: Sequence[float] | None = None,
) -> tuple[Band, ...]:
    """Bands from declared names, declared wavelengths, or what the file says; counts must agree."""
    centres = camera.centres if camera.kind in ("bands", "cube") else None
    for field, declared in (("wavelengths", centres), ("bands", names)):
        if declared and len(declared) != count:
            raise CaptureRefused(
                Problem(
                    "E_BAND_COUNT",
                    f"{camera.name}: {len(declared)} {field} are declared, the file has {count} {what}",
                    path,
                    f"cameras.{camera.name}.{field}",
                    count,
                    len(declared),
                    f"Mend `{field}` in {campaign.path.name}, or give the whole file.",
                )
            )
    centres = centres or (tuple(wavelengths) if wavelengths and len(wavelengths) == count else None)
    widths = fwhm if fwhm and len(fwhm) == count else (nan,) * count
    if names:
        return tuple(
            Band(n, w, f) for n, w, f in zip(names, centres or (nan,) * count, widths, strict=True)
        )
    if centres:
        return tuple(
            Band(n, w, f) for n, w, f in zip(band_labels(centres), centres, widths, strict=True)
        )
    return tuple(Band(f"band {i + 1}") for i in range(count))


def _name(key: object) -> str:
    return f"{key:g} nm" if isinstance(key, float) else str(key)


def _list(keys: list[object]) -> str:
    shown = ", ".join(_name(k) for k in keys[:6])
    return shown + (" …" if len(keys) > 6 else "")
