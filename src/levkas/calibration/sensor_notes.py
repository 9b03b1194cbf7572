"""What a person should know of a sensor: what its files state, and what was measured: where it is full, clipped darks, its curve."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.calibration.code_checks import doubt_codes
from levkas.calibration.sensor_context import (
    BEND,
    BLACK,
    CLIPPED_DARKS,
    FULL_SCALE,
    NAMED,
    OFFSET,
    QUIET_WHITE,
    SENSOR,
    UNLIKE_NOISE,
    WHITE_SHOTS,
    glimpse,
    spread,
)
from levkas.readers.compared_facts import SCALE
from levkas.readers.frames import read_facts
from levkas.readers.raw import SUFFIXES as RAW_SUFFIXES

if TYPE_CHECKING:
    from levkas.calibration.sensor_context import SensorContext


AS_LIGHT = "they are taken as proportional to light: export linear frames"


def doubts_of(context: SensorContext) -> list[str]:
    """What a person should know before using the values."""
    camera = context.camera
    doubts = [*_notes_of_files(context), *_doubt_bits(context), *context.doubts]
    targets = context.campaign.targets
    if not camera.traits.is_calibrated:
        return doubts
    doubts += [*context.sensor.remarks, *_note_scale(context), *_note_bad_bands(context)]
    if context.light is not None:
        doubts += context.light.notes
    elif not context.sensor.white and not context.holds_reflectance:
        doubts.append("no white is declared: the cube remains in counts")
    elif context.sensor.white and targets.white and targets.white.reflectance is None:
        doubts.append(
            "the reflectance of the white is assumed to be 1 at every wavelength; give it, or a CSV of its spectrum, in "
            "targets.white.reflectance"
        )
    return doubts


def _note_scale(context: SensorContext) -> list[str]:
    """Report whether the scale of reflectance that a file of the object states is used."""
    scale = next(
        (s for f in context.sensor.object if (s := read_facts(f.path).reflectance_scale)), None
    )
    if scale is None:
        return []
    stated = f"{context.camera.name}: by the file reflectance 1.0 is {_span(scale)}"
    if context.holds_reflectance:
        return [
            f"{stated}: its values are taken as reflectance, for neither dark nor white is there; if they are raw, "
            f'write `overrule = ["{SCALE}"]`'
        ]
    return [f"{stated}: this is not used, the values are taken as counts"]


def _note_bad_bands(context: SensorContext) -> list[str]:
    bad = [band.label for band in context.sensor.bands if band.bad]
    if not bad:
        return []
    names = ", ".join(bad[:NAMED]) + (" …" if len(bad) > NAMED else "")
    return [
        f"{context.camera.name}: {len(bad)} of {len(context.sensor.bands)} bands are bad by the file (bbl: {names}): "
        "they are flagged as defects, and have no part in registration and colours"
    ]


def _span(values: Sequence[float]) -> str:
    return f"{min(values):g}" + (f" to {max(values):g}" if len(set(values)) > 1 else "")


def _notes_of_files(context: SensorContext) -> list[str]:
    """Return what readers take otherwise than files state it, each once with the first file and how many there are."""
    sensor = context.sensor
    found: dict[str, dict[Path, None]] = {}
    for frame in (*sensor.object, *sensor.white, *sensor.chart, *sensor.dark):
        if frame.path.suffix.lower() in RAW_SUFFIXES:
            continue
        facts = read_facts(frame.path)
        unread = facts.pages > 1 and frame.page is None and not context.camera.traits.reads_pages
        more = [f"the first of {facts.pages} pages is used, the others are not"] if unread else []
        if facts.encoded and context.camera.traits.is_calibrated:
            more.append(f"by the file its codes have a tone curve ({facts.encoded}); {AS_LIGHT}")
        for note in (*facts.notes, *more):
            found.setdefault(note, {})[frame.path] = None
    name = context.camera.name
    return [f"{name}: {note} ({files_named(tuple(paths))})" for note, paths in found.items()]


def files_named(paths: Sequence[Path]) -> str:
    """Return a few files in words.

    >>> files_named([Path("raw/a.tif"), Path("raw/b.tif")])
    'a.tif and 1 more'
    """
    return paths[0].name + (f" and {len(paths) - 1} more" if len(paths) > 1 else "")


def _doubt_bits(context: SensorContext) -> list[str]:
    """Whether a few frames, whites above all, look like 8 bits where more are declared."""
    bits, full = context.camera.bits, context.saturation
    if bits is None or bits <= 8 or full is None or context.facts.kind == "raw":
        return []
    frames = [*spread(context.sensor.object, 3), *spread(context.sensor.white, 3)]
    return [f"{context.camera.name}: {d}" for d in doubt_codes(map(glimpse, frames), bits, full)]


def describe_sensor(context: SensorContext) -> list[str]:
    """Report what was measured of a sensor that a person should know: where it is full, its black, its curve, darks that were clipped."""
    found = context.measured
    notes = (
        *_notes_of_white(found),
        *_notes_of_darks(found.get(CLIPPED_DARKS, {})),
        *_notes_of_series(found),
        *_notes_of_noise(context),
    )
    return [f"{context.camera.name}: {note}" for note in notes]


def _notes_of_white(measured: Mapping[str, Any]) -> Iterator[str]:
    if apart := measured.get(WHITE_SHOTS):
        yield (
            f"shots of the white differ by up to {100 * max(apart.values()):.2g} % from place to place: something moved, or the "
            "light flickers in bands. Values there may be wrong by as much"
        )
    if (quiet := measured.get(QUIET_WHITE)) is not None:
        yield (
            "the white has no more noise than the dark, and light has shot noise: it is averaged, or full (saturated) at "
            f"{quiet:g} counts. If it is full declare `saturation`, and capture it with less exposure"
        )
    elif full := measured.get(FULL_SCALE):
        counts, stated = f"{full['counts']:g}", full["stated"]
        than = f" ({stated} would be more)" if stated else ""
        yield (
            f"the sensor is full at {counts} counts: {full['source']}{than}; values from there on are flagged as saturated. "
            f"`saturation = {counts}` in campaign.toml states it"
        )


def _notes_of_darks(darks: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    zeros = max((one["zeros"] for one in darks.values()), default=0.0)
    blacks = [black for one in darks.values() for black in one.get("black", ())]
    lost = [time for time, one in darks.items() if "black" not in one]
    if blacks:
        noise = max(one.get("noise", 0.0) for one in darks.values())
        yield (
            f"darks were clipped at zero (up to {zeros:.0%} of the pixels) and are fitted as censored: black "
            f"{_range(blacks, '.2f')} counts, noise {noise:.2g}"
        )
    if lost:
        some = f" of {', '.join(filter(None, lost[:NAMED]))}" if any(lost) else ""
        yield (
            f"darks{some} are clipped too strongly, hardly a value is above zero: what the black level hides is "
            "unknown, and dark values may be wrong by it. Raise the camera's black level (offset)"
        )


def _notes_of_series(measured: Mapping[str, Any]) -> Iterator[str]:
    if (bend := measured.get(BEND)) is not None:
        yield (
            f"the sensor is not linear: by its exposure series its brightest values are {100 * abs(bend):.2g} % too "
            f"{'low' if bend > 0 else 'high'} beside dim ones. Nothing is corrected: values may be off by as much, unless the "
            "files are linearised before"
        )
    if found := measured.get(OFFSET):
        than = "dark" if found["counts"] < 0 else "bright"
        yield (
            f"without light its exposure series have {found['counts']:+.1f} ± {found['error']:.2g} counts above the dark, where a "
            "linear sensor has none: the darks are of another temperature or setting, or the response bends at its dark end. Dark "
            f"paint is too {than} by about as much; capture darks beside the object"
        )
    if found := measured.get(BLACK):
        yield (
            f"the black level is {found['counts']:.1f} ± {found['error']:.1f} counts, by exposures of one scene: darks of one time "
            "alone do not show it. `black` in campaign.toml states it"
        )


def _notes_of_noise(context: SensorContext) -> Iterator[str]:
    """Report that noise is that of single shots, and in which bands it is that of another gain."""
    if context.measured.get(SENSOR, {}).get("source") == "spatial":
        yield (
            "noise is estimated from the smooth parts of single shots, and sigma is no surer than these: capture two shots or more "
            "of each target"
        )
    found: dict[str, float] = context.measured.get(UNLIKE_NOISE, {})
    if not found:
        return
    factors = {label: max(ratio, 1 / ratio) for label, ratio in found.items()}
    worst = max(factors, key=lambda label: factors[label])
    if context.camera.traits.bands_in == "files":
        why = (
            "the camera sets gain or black level by itself, or shots of these bands differ. Their sigma is by their own shots. "
            "Capture all bands with one setting"
        )
    else:
        off = [100 * (ratio**-0.5 - 1) for ratio in found.values()]
        why = (
            f"the channels were multiplied, as a white balance does. Sigma there is off by {_range(off, '+.0f')} %. "
            "Export raw frames without white balance"
        )
    yield (
        f"at like signal the variance of the noise differs from band to band, by a factor of {factors[worst]:.2g} at {worst} "
        f"({len(found)} of {len(context.sensor.bands)} bands): {why}"
    )


def _range(numbers: Sequence[float], form: str) -> str:
    low, high = (format(n, form) for n in (min(numbers), max(numbers)))
    return low if low == high else f"{low} to {high}"
