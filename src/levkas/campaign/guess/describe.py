"""Describe one camera: kind, mosaic, bits and bands, each with the reason."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import isnan
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.campaign.camera_kinds import KINDS, CameraKind
from levkas.campaign.guess.appearance import mosaic_of, tile_side
from levkas.campaign.guess.band_names import Question
from levkas.campaign.guess.groups import CameraGroup, FilePatterns, find_patterns, safe_name
from levkas.campaign.guess.names import FEW_GROUPS, NamedFile
from levkas.campaign.guess.pixels import EVEN, MOST_SAMPLED, SMOOTH, Samples, bits_of, spread
from levkas.campaign.guess.words import are_elements
from levkas.core.text import counted

if TYPE_CHECKING:
    from levkas.calibration.codes import FullScale

LISTED = 6
"""Values that a question names."""
COARSE = 3
"""Times as many px in the other pictures from which a stack of pages is taken for maps of a scan, which have a quarter or less."""
TAKE = "Take the # off one of the answers, in [cameras.{0}] and [targets]"
FIELDS = ("wavelength", "exposure", "band", "sensor")
"""Kinds of parts of names by which files of one series do not differ."""
BRIGHT = 0.5
"""Share of a scale that must be reached to take it for the scale."""


@dataclass(frozen=True)
class Guess:
    """One value of campaign.toml, and the reason for it."""

    value: Any
    why: str = ""


@dataclass(frozen=True)
class SensorGuess:
    """One sensor of a camera: its name at ``{sensor}``, and its mosaic and channels where it has one."""

    name: str
    keys: dict[str, Guess] = field(default_factory=dict)


@dataclass(frozen=True)
class Choice:
    """One of several ways to describe a camera: in words, its keys, and its objects."""

    what: str
    keys: dict[str, Guess]
    objects: tuple[str, ...]


@dataclass(frozen=True)
class CameraGuess:
    """One camera.

    Parameters
    ----------
    name : str
    about : tuple of str
        Comments above its table.
    keys : dict
        In the order of the file: kind, files, …
    sensors : tuple of SensorGuess
    hints : tuple of str
        Keys that may be wanted, as comments.
    unknown : tuple of str
        What the files leave open.
    centres : tuple of float
        Wavelengths of its bands, nm, from names or headers.
    targets : dict
        Target → role.
    setups : dict
        Name → files.
    choices : tuple of Choice
        Of which a person must take one, in place of the keys that they have; empty for none.
    """

    name: str
    keys: dict[str, Guess]
    about: tuple[str, ...] = ()
    sensors: tuple[SensorGuess, ...] = ()
    hints: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    centres: tuple[float, ...] = ()
    targets: dict[str, str] = field(default_factory=dict)
    setups: dict[str, Guess] = field(default_factory=dict)
    choices: tuple[Choice, ...] = ()

    @property
    def kind(self) -> str:
        """As in campaign.toml."""
        return str(self.keys["kind"].value)

    @property
    def traits(self) -> CameraKind:
        """What follows of its kind."""
        return KINDS[self.kind]


@dataclass
class CameraNotes:
    """Comments, hints and open questions gathered while a camera is described."""

    about: list[str] = field(default_factory=list)
    hints: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    sensors: list[SensorGuess] = field(default_factory=list)


def describe_camera(group: CameraGroup, samples: Samples, finest: int = 0) -> CameraGuess:
    """Describe one camera.

    Parameters
    ----------
    group : CameraGroup
    samples : Samples
        Decodes a few of its frames.
    finest : int, px
        Longer side of the largest pictures of all cameras.
    """
    files, notes = find_patterns(group.frames), CameraNotes(about=list(group.notes))
    keys = {"kind": _kind_of_maps(group, files, finest) or _kind(group, files, samples)}
    kind = str(keys["kind"].value)
    texts = files.of_kind(kind)
    keys["files"] = Guess(texts[0] if len(texts) == 1 else texts, "; ".join(files.reasons))
    traits = KINDS[kind]
    if traits.bands_in == "sensors":
        _describe_sensors(group, files, samples, notes)
    elif "pattern" in traits.keys:
        keys |= _mosaic_keys(group, kind, samples, notes)
    if traits.bands_in == "files":
        keys |= _band_keys(group, files)
    if traits.is_scanned and not group.frames[0].facts.is_cube:
        keys["scan"] = Guess(
            "mirror", "darks and whites are frames; remove this line for a push-broom scan"
        )
    elif traits.is_scanned and len({f.facts.shape[0] for f in group.frames}) == 1:
        notes.hints.append(
            'scan = "mirror"  # if darks and whites are whole frames, not lines of the scan'
        )
    if traits.is_calibrated:
        keys |= _scale_keys(group, samples, notes)
        keys |= _exposure_keys(group, files)
        _check_exposures(group, notes)
        _check_templates(group, samples, notes)
    _check_series(group, files, kind, samples, notes)
    return CameraGuess(
        name=group.name,
        keys=keys,
        about=tuple(notes.about),
        sensors=tuple(notes.sensors),
        hints=tuple(notes.hints),
        unknown=tuple(f"{group.name}: {text}" for text in notes.unknown),
        centres=_centres(group, files),
        targets={f.target: f.role for f in group.frames},
        setups={safe_name(name): _setup(frames, kind) for name, frames in group.setups.items()},
    )


def with_choices(
    camera: CameraGuess, bands: CameraGroup, question: Question, beside: Sequence[str]
) -> CameraGuess:
    """Leave open whether the files of a camera are bands or objects; `bands` are its frames, and those of cameras `beside`, if bands."""
    files = find_patterns(bands.frames)
    texts = files.of_kind("bands")
    keys = {
        "kind": Guess("bands"),
        "files": Guess(texts[0] if len(texts) == 1 else texts),
        **_band_keys(bands, files),
    }
    targets = tuple(sorted({f.target for f in bands.of_role("object")}))
    shown_alone = tuple(t for t, role in camera.targets.items() if role == "object")
    one = targets[0] if len(targets) == 1 else "every object"
    shown = ", ".join(question.values[:LISTED]) + " …" * (len(question.values) > LISTED)
    unknown = (
        f"{camera.name}: what {shown} are: their names do not say it. {TAKE.format(camera.name)}"
    )
    unknown += (
        f"; bands take the files of {', '.join(beside)}, too, without a table of their own"
        * bool(beside)
    )
    own = {key: replace(guess, why="") for key, guess in camera.keys.items() if key in keys}
    each = (
        "shots of each object:"
        if "{shot}" in str(camera.keys["files"].value)
        else "an object each:"
    )
    return replace(
        camera,
        choices=(Choice(f"bands of {one}:", keys, targets), Choice(each, own, shown_alone)),
        unknown=(unknown, *camera.unknown),
    )


def _setup(frames: Sequence[NamedFile], kind: str) -> Guess:
    patterns = find_patterns(frames).of_kind(kind)
    why = "the same camera in a separate folder: another lighting"
    return Guess(patterns[0] if len(patterns) == 1 else patterns, why)


# --- kind -------------------------------------------------------------------------------------


def _kind_of_maps(group: CameraGroup, files: FilePatterns, finest: int) -> Guess | None:
    """Return the kind of maps of one scan: by their format, the elements that they name, or as coarse stacks; None of others."""
    first = group.objects[0]
    facts, templates = first.facts, group.of_role("dark", "white")
    if first.file.is_stack:
        return Guess("maps", f"a stack of {counted(facts.shape[2], 'map')}")
    if templates:
        return None
    if are_elements(files.bands):
        return Guess("maps", "one file per map: the names contain elements")
    if are_elements(facts.band_names or facts.page_labels or ()):
        return Guess("maps", "a stack of maps: the names of its bands are elements")
    if facts.pages > 1 and first.file.channels == 1 and COARSE * max(facts.shape[:2]) < finest:
        why = f"{facts.pages} pages per file, far coarser than other pictures, and no darks and whites"
        return Guess("maps", why)
    return None


def _kind(group: CameraGroup, files: FilePatterns, samples: Samples) -> Guess:
    """Return the kind of camera, from names first, then headers, then pixel statistics."""
    first = group.objects[0]
    facts, channels, templates = first.facts, first.file.channels, group.of_role("dark", "white")
    if files.sensors:
        return Guess(
            "sensors", f"{counted(len(files.sensors), 'sensor')}: {', '.join(files.sensors)}"
        )
    if files.wavelengths or files.bands:
        what = "a wavelength" if files.wavelengths else "a band"
        return Guess("bands", f"one file per band: the names contain {what}")
    if facts.is_cube:
        name = {"envi": "ENVI", "mat": "MATLAB"}.get(facts.kind, "HDF5")
        return Guess("cube", f"{name}, {counted(facts.shape[2], 'band')}")
    if facts.kind == "raw" or facts.pattern:
        return Guess("mosaic", f"camera raw, {facts.pattern}" if facts.pattern else "camera raw")
    if facts.pages > 1 and channels == 1:
        return Guess("bands", f"{facts.pages} pages per file, one band each")
    if facts.kind == "raw-colours":
        return Guess("image", "a camera raw of colours, as a linear DNG: nothing to calibrate")
    if channels == 3:
        return Guess("image", "3 channels per pixel: a rendered picture, nothing to calibrate")
    if channels > 3:
        return Guess("cube", f"{channels} channels per pixel")
    if side := tile_side(group.frames, samples):
        return Guess("mosaic", f"levels repeat every {side} sensels")
    if templates:
        return Guess("bands", "one channel, with darks or whites for calibration")
    return Guess("image", "one channel, no darks and whites: nothing to calibrate")


# --- mosaics ----------------------------------------------------------------------------------


def _mosaic_keys(
    group: CameraGroup, kind: str, samples: Samples, notes: CameraNotes
) -> dict[str, Guess]:
    facts, in_pattern = group.frames[0].facts, KINDS[kind].bands_in == "pattern"
    if facts.pattern:
        if facts.kind == "raw":
            return {}
        return {"pattern": Guess(facts.pattern, "from the header")} if in_pattern else {}
    if not in_pattern:
        if side := tile_side(group.frames, samples):
            notes.unknown.append(
                f"the mosaic behind the filters: levels repeat every {side} sensels, and `pattern` says its colours"
            )
        return {}
    mosaic = mosaic_of(group.frames, samples)
    if mosaic is None:
        return {}
    if mosaic.unknown:
        notes.unknown.append(mosaic.unknown)
    return {"pattern": Guess(mosaic.letters or mosaic.rows, mosaic.why)}


def _describe_sensors(
    group: CameraGroup,
    files: FilePatterns,
    samples: Samples,
    notes: CameraNotes,
) -> None:
    """Mosaic and channel names of each sensor."""
    for number, (name, frames) in enumerate(files.sensors.items(), 1):
        facts, keys = frames[0].facts, {}
        declared = facts.pattern or facts.wavelengths
        mosaic = None if declared else mosaic_of(frames, samples)
        if facts.pattern or mosaic:
            why = mosaic.why if mosaic else "from the header"
            keys["pattern"] = Guess(
                facts.pattern or (mosaic and (mosaic.letters or mosaic.rows)), why
            )
            rows = mosaic.rows if mosaic else (tuple(str(facts.pattern)),)
            channels = list(dict.fromkeys(c for row in rows for c in row))
            channels = list("RGB") if set(channels) == set("RGB") else channels
            keys["bands"] = Guess(
                tuple(f"{c}{number}" for c in channels), "names that differ by sensor"
            )
            if mosaic and mosaic.unknown:
                notes.unknown.append(f"{name}: {mosaic.unknown}")
        elif facts.band_names or facts.wavelengths:
            bands = facts.band_names or tuple(f"{w:g} nm" for w in facts.wavelengths or ())
            centres = ", ".join(f"{w:g} nm" for w in facts.wavelengths or ())
            keys["bands"] = Guess(tuple(bands), f"from the header{': ' * bool(centres)}{centres}")
        else:
            keys["bands"] = Guess(
                (name,), "no mosaic was found: one channel of unknown sensitivity"
            )
            notes.unknown.append(f"the sensitivity of {name}; `bands` holds the sensor's name")
        notes.sensors.append(SensorGuess(name, keys))


def _centres(group: CameraGroup, files: FilePatterns) -> tuple[float, ...]:
    """Wavelengths of a camera's bands, in their order."""
    if files.wavelengths:
        return files.wavelengths
    centres = [f.facts.wavelengths or () for f in group.objects]
    if files.sensors:
        centres = [frames[0].facts.wavelengths or () for frames in files.sensors.values()]
        return tuple(w for waves in centres for w in waves)
    return tuple(centres[0])


# --- bands, bits, exposures -------------------------------------------------------------------


def _band_keys(group: CameraGroup, files: FilePatterns) -> dict[str, Guess]:
    if files.wavelengths:
        return {
            "wavelengths": Guess(_steps(files.wavelengths), counted(len(files.wavelengths), "band"))
        }
    if files.bands:
        return {"bands": Guess(files.bands, "from the file names; the wavelengths are unknown")}
    facts = group.frames[0].facts
    if facts.pages == 1:
        return {"bands": Guess((group.name,), "one channel, named after the camera")}
    return {}


def _steps(wavelengths: Sequence[float]) -> object:
    steps = {round(b - a, 6) for a, b in pairwise(wavelengths)}
    if len(steps) == 1 and len(wavelengths) > 2:
        return {"start": wavelengths[0], "stop": wavelengths[-1], "step": steps.pop()}
    return tuple(wavelengths)


def _scale_keys(group: CameraGroup, samples: Samples, notes: CameraNotes) -> dict[str, Guess]:
    """Bits of a code, where fewer are used than stored."""
    facts = group.frames[0].facts
    if facts.dtype != "uint16" or facts.kind == "raw":
        return {}
    full = samples.full_scale(group.of_role)
    if facts.saturation:
        return _full_keys(full, facts.saturation)
    found = [
        statistics
        for role in ("white", "object", "chart")
        for statistics in samples.of_some(group.of_role(role), MOST_SAMPLED)
    ]
    if not found:
        return {}
    top, step = max(s.top for s in found), int(np.gcd.reduce([s.step for s in found]))
    bits = bits_of(top, step)
    if step > 1:
        if top < BRIGHT * 65536 and not full:
            notes.hints.append(
                f"saturation = {65536 - step}  # codes are multiples of {step}; highest found {top}"
            )
            return {}
        why = f"{bits} bits stored in the upper bits of 16: every code is a multiple of {step}"
        return _full_keys(full, 65536 - step) or {"saturation": Guess(65536 - step, why)}
    if bits == 16:
        return _full_keys(full, 65535)
    if full:
        why = f"the codes of some frames pile up at {full.counts:g}"
        return {"bits": Guess(bits, why), **_full_keys(full, 2**bits - 1)}
    if bits >= 12 and top > BRIGHT * (1 << bits):
        return {"bits": Guess(bits, f"highest code in the frames read: {top}")}
    notes.hints.append(f"bits = {max(bits, 12)}  # highest code in the frames read: {top}")
    notes.unknown.append(f"the bit depth: 16 bits are stored, the highest code is {top}")
    return {}


def _full_keys(full: FullScale | None, stated: float) -> dict[str, Guess]:
    """Return the full scale that frames show, where it is below the one that is stated."""
    if full is None or full.counts >= stated:
        return {}
    return {"saturation": Guess(int(full.counts), f"the sensor is full there: {full.source}")}


def _exposure_keys(group: CameraGroup, files: FilePatterns) -> dict[str, Guess]:
    times: dict[tuple[str, str | None, str], set[object]] = {}
    sensors = files.sensor_of()
    for frame in group.objects:
        exposure = frame.number("exposure") or frame.facts.exposure_s
        key = (frame.target, frame.number("wavelength"), sensors.get(frame.path, ""))
        times.setdefault(key, set()).add(exposure)
    most = max((len(t - {None}) for t in times.values()), default=0)
    if most < 2:
        return {}
    return {"exposures": Guess("best", f'up to {most} of one band; or "merge" them by their noise')}


# --- checks -----------------------------------------------------------------------------------


def _check_exposures(group: CameraGroup, notes: CameraNotes) -> None:
    """Report what names and headers state of exposures, and doubt them where only some frames do."""
    stated: dict[str, set[float]] = {}
    silent: dict[str, set[str | None]] = {}
    for role in ("dark", "white", "object"):
        for frame in group.of_role(role):
            if times := frame.exposures_s:
                stated.setdefault(role, set()).update(times)
            elif not frame.file.borrowed:
                silent.setdefault(role, set()).add(frame.facts.exposure_unclear)
    if stated:
        spans = {role: sorted({min(times), max(times)}) for role, times in stated.items()}
        levels = [f"{role} {' to '.join(f'{t:g}' for t in span)} s" for role, span in spans.items()]
        notes.about.append(f"Exposures: {', '.join(levels)}.")
    unclear = {text for texts in silent.values() for text in texts}
    if (stated and silent) or len(unclear) > 1:
        notes.unknown.append(
            f"the exposure of {' and '.join(silent)} frames, or its unit: a build needs all or none; list them in a `manifest`"
        )


def _check_templates(group: CameraGroup, samples: Samples, notes: CameraNotes) -> None:
    """Report what darks and whites look like, and doubt those that do not look it."""
    means: dict[str, float] = {}
    for role in ("dark", "white", "object"):
        found = samples.of_some(group.of_role(role), 3)
        means[role] = float(np.mean([s.mean for s in found])) if found else float("nan")
    levels = [f"{role} {_level(means[role])}" for role in means if not isnan(means[role])]
    if len(levels) > 1:
        notes.about.append(f"Mean levels: {', '.join(levels)} counts.")
    dark, white, shown = means["dark"], means["white"], means["object"]
    if dark > max(white, shown):
        notes.unknown.append(
            "whether darks and whites are swapped: the darks are the brightest frames"
        )
        return
    if dark > 0.5 * min(v for v in (white, shown, np.inf) if not isnan(v)):
        notes.unknown.append(f"whether the darks are dark: their mean is {dark:.4g} counts")
    whites = samples.of_some(group.of_role("white"), MOST_SAMPLED)
    if white < shown or any(s.texture > 2 * SMOOTH or s.unevenness > EVEN for s in whites):
        notes.unknown.append(
            "whether the white is one: it is not even, as a board that fills the view is, or darker than the object"
        )


def _level(counts: float) -> str:
    return f"{counts:.0f}" if counts >= 10 else f"{counts:.2g}"


def _check_series(
    group: CameraGroup, files: FilePatterns, kind: str, samples: Samples, notes: CameraNotes
) -> None:
    """Doubt files that numbers alone tell apart: parts of a scan; pictures under several lights or exposures."""
    scanned, series = KINDS[kind].is_scanned, dict[object, list[NamedFile]]()
    for frame in group.of_role("object"):
        shown = frame.target if files.shots else re.sub(r"[\W\d_]+", "", frame.target)
        parts = [t for segment in frame.segments for t in segment]
        fields = tuple(t.text for t in parts if t.kind in FIELDS or t.names_channel)
        time = frame.exposures_s if KINDS[kind].is_calibrated else ()
        facts = frame.facts.wavelengths or frame.facts.band_names
        series.setdefault((shown, fields, time, facts, frame.tile), []).append(frame)
    several = [frames for frames in series.values() if len(frames) > 1]
    dark = samples.of_some(group.of_role("dark"), 1)
    for frames in spread(several, FEW_GROUPS):
        those = f"{frames[0].file.name} and {len(frames) - 1} more"
        if scanned:
            if files.shots:
                notes.unknown.append(
                    f"whether {those} are strips beside one another: parts one after the other need {{row}} in `files`"
                )
            return
        what = samples.difference([f.file for f in frames], dark[0].mean if dark else 0.0)
        if files.shots and what:
            notes.unknown.append(
                f"whether {those} are shots of one light, to average: they differ in {what}"
            )
            return
        if what in ("light", "exposure"):
            notes.unknown.append(
                f"whether {those} are an object each, or one of which one is taken: they differ in {what}"
            )
            return
