"""Exposure advice from captured frames of a white."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isnan, log10, nan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from levkas.calibration.codes import FullScale
from levkas.calibration.patterns import channel_names, channel_table, split
from levkas.calibration.templates import Template
from levkas.core.problems import Problem, Refused
from levkas.planning.campaign_frames import (
    Pattern,
    files_of,
    not_known,
    scale_of,
    split_sensors,
    stack_of,
)
from levkas.planning.exposure_levels import FULL_WELL, PRNU, Reading, limiting, read_channel
from levkas.readers.frames import read_facts

TOLERATED = 1e-3  # share of pixels at saturation: glints and hot sensels
FAINT = 0.002  # of saturation: less does not suffice to advise a time
NO_WHITE = 1.0  # (brightest − darkest)/mean, above which no evenly lit white was shown


class NoAdvice(Refused):
    """Frames from which no exposure can be advised."""


@dataclass(frozen=True)
class BandAdvice:
    """Advice for one band or one camera.

    Parameters
    ----------
    shot : Shot
        The longest that does not clip.
    readings : list of Reading
        One a channel.
    full : FullScale
        Counts at which a sensel is full, and where that is known from.
    """

    shot: Shot
    readings: list[Reading]
    full: FullScale

    @property
    def first(self) -> Reading:
        """The channel that saturates first; its time is everyone's."""
        return limiting(self.readings)[0]

    @property
    def time_s(self) -> float | None:
        """The time to set; None where that of the frames is not known."""
        return None if self.shot.exposure_s is None else self.shot.exposure_s * self.first.factor

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for `--json`."""
        first, poorest = limiting(self.readings)
        return {
            "name": self.shot.name,
            "wavelength": None if isnan(self.shot.wavelength) else self.shot.wavelength,
            "exposure_s": self.shot.exposure_s,
            "recommended_s": self.time_s,
            "recommended_factor": first.factor,
            "target": first.target,
            "saturates_first": first.channel,
            "poorest": poorest.channel,
            "channels": [
                {
                    "channel": reading.channel,
                    "mean": reading.mean,
                    "peak": reading.peak,
                    "stops_to_saturation": reading.stops_left,
                    "clipped": reading.clipped,
                    "unevenness": reading.unevenness,
                }
                for reading in self.readings
            ],
            "full_scale": self.full.counts,
            "full_scale_from": self.full.source,
        }


def advise_frames(
    frames: Sequence[str | Path],
    darks: Sequence[str | Path] = (),
    *,
    pattern: str | Sequence[Sequence[str]] | None = None,
    black: float | None = None,
    bits: int | None = None,
    saturation: float | None = None,
    exposure_s: float | None = None,
) -> list[BandAdvice]:
    """Advise how long to expose, from frames of a white.

    Parameters
    ----------
    frames : sequence of path
        Files or folders. Those that name one wavelength are one band; of several exposures the
        longest unclipped counts; equal ones are averaged.
    darks : sequence of path
        Of any exposures: to each band those of its size that come nearest to its time.
    pattern : str or rows of names, optional
        Of a mosaic; default that of the campaign that the frames belong to, else the file's own.
    black : float, optional
        Counts; default that of the campaign that the frames belong to, else the file's own, else 0.
    bits, saturation : int, float, optional
        Bits of the converter, or counts at which a sensel is full; default as `campaign_frames.scale_of` finds it.
    exposure_s : float, optional
        Of every frame, where neither names (25ms, 0.5s) nor headers hold it.

    Returns
    -------
    bands : list of BandAdvice
        By wavelength, then name.

    Raises
    ------
    NoAdvice
        E_WHITE_SATURATED where every exposure of a band clips, E_WHITE_DARK where none stands above
        black, with the time to try; E_WHITE_UNEVEN where the frames show no white; E_BITS where the full
        scale is not known, or codes lie beyond the bits.
    Refused
        UnreadableCapture.
    """
    files = files_of(frames)
    if not files:
        raise NoAdvice(Problem("E_NO_FRAMES", "there is no frame", expected="frames of a white"))
    given = _Given(pattern, black, bits, saturation, exposure_s)
    dim = files_of(darks)
    groups = split_sensors(files)
    dark_of = split_sensors(dim) if dim else {}
    found = []
    for sensor, (members, declared) in groups.items():
        own = (
            dark_of[sensor][0]
            if sensor in dark_of
            else ([] if sensor and dark_of.keys() - {""} else dim)
        )
        for band in _advise_sensor(members, own, declared, given):
            named = f"{band.shot.name} {sensor}".strip()
            found.append(replace(band, shot=replace(band.shot, name=named)))
    return found


class _Given(NamedTuple):
    """What is known of frames beside themselves."""

    pattern: str | Sequence[Sequence[str]] | None
    black: float | None
    bits: int | None
    saturation: float | None
    exposure_s: float | None


def _advise_sensor(
    files: list[Path], darks: list[Path], declared: Pattern | None, given: _Given
) -> list[BandAdvice]:
    """Advise from the frames of one sensor; `declared` is the mosaic that its campaign declares."""
    facts = read_facts(files[0])
    dim = gather_shots(darks, np.inf, None)
    scale = scale_of(files, facts, bits=given.bits, saturation=given.saturation, white=True)
    if scale is None:
        raise NoAdvice(not_known(files[0], facts))
    level = next((b for b in (given.black, scale.black, facts.black) if b is not None), 0.0)
    pattern = given.pattern or declared or facts.pattern
    bands: dict[tuple[float, str], list[Shot]] = {}
    for shot in gather_shots(files, scale.full.counts, given.exposure_s):
        _check_bits(shot, scale.full, str(files[0]))
        bands.setdefault((shot.wavelength, shot.name), []).append(shot)
    order = sorted(
        bands, key=lambda key: (isnan(key[0]), key[0] if key[0] == key[0] else 0, key[1])
    )
    return [_coach_band(bands[key], dim, level, scale.full, pattern) for key in order]


def _check_bits(shot: Shot, scale: FullScale, file: str) -> None:
    """Refuse frames with codes beyond the bits: 12 bits may stand at the upper end of 16."""
    if scale.bits is not None and (top := float(shot.stack.mean.max())) > scale.counts:
        raise NoAdvice(
            Problem(
                "E_BITS",
                f"{shot.name}: codes are larger than {scale.bits} bits can hold",
                file,
                "bits",
                f"{top:.0f}",
                f"at most {scale.counts:.0f} ({scale.source})",
                "Give the code at which the camera saturates: --saturation 65520 if 12 bits are stored in the "
                "upper bits of 16.",
            )
        )


def _dark_of(shot: Shot, darks: list[Shot]) -> Template | None:
    """Return the dark that is nearest in time to a shot, of its size where there is one."""
    alike = [d for d in darks if d.stack.mean.shape == shot.stack.mean.shape] or darks
    if not alike:
        return None

    def apart(dark: Shot) -> float:
        if not dark.exposure_s or not shot.exposure_s:
            return float("inf")
        return abs(log10(dark.exposure_s / shot.exposure_s))

    return min(alike, key=apart).stack


def _coach_band(
    shots: list[Shot],
    darks: list[Shot],
    black: float,
    scale: FullScale,
    pattern: str | Sequence[Sequence[str]] | None,
) -> BandAdvice:
    full, readings = scale.counts, []
    for shot in shots:
        dark = _dark_of(shot, darks)
        level = float(np.median(dark.mean)) if dark else black
        readings.append((shot, _readings(shot, level, full, pattern)))
    clear = [(s, r) for s, r in readings if max(c.clipped for c in r) <= TOLERATED]
    if not clear:
        raise NoAdvice(_clipped(min(readings, key=lambda item: item[0].exposure_s or 0.0)))
    shot, channels = max(clear, key=lambda item: item[1][0].mean)
    if max(c.peak for c in channels) < FAINT * channels[0].room:
        raise NoAdvice(_too_faint(shot, channels))
    if min(c.unevenness for c in channels) > NO_WHITE:
        raise NoAdvice(_no_white(shot, channels))
    return BandAdvice(shot, channels, scale)


def _readings(
    shot: Shot, black: float, full: float, pattern: str | Sequence[Sequence[str]] | None
) -> list[Reading]:
    """Read each channel; of several phases of one, the brighter counts."""
    values = np.where(shot.stack.saturated, np.maximum(shot.stack.mean, full), shot.stack.mean)
    planes = planes_of(values, pattern)
    found: dict[str, Reading] = {}
    for name, plane in planes:
        reading = read_channel(plane, black=black, saturation=full, channel=name)
        if name not in found or reading.peak > found[name].peak:
            found[name] = reading
    return list(found.values())


def planes_of(
    values: np.ndarray, pattern: str | Sequence[Sequence[str]] | None
) -> list[tuple[str, np.ndarray]]:
    """Return the channels of a frame, (h, w) or (h, w, bands), as named planes: of a mosaic its phases."""
    if values.ndim == 3:
        names = "RGB" if values.shape[2] == 3 else [str(i) for i in range(values.shape[2])]
        return [(name, values[..., i]) for i, name in enumerate(names)]
    if pattern is None:
        return [("", values)]
    table, known = channel_table(pattern), channel_names(pattern)
    phases = zip(table.ravel(), split(values, *table.shape), strict=True)
    return [(known[channel], phase) for channel, phase in phases]


def _clipped(reading: tuple[Shot, list[Reading]]) -> Problem:
    shot, channels = reading
    worst = max(channels, key=lambda c: c.clipped)
    time = f"{shot.exposure_s / 4:g} s" if shot.exposure_s else "a quarter of the time"
    return Problem(
        "E_WHITE_SATURATED",
        f"{shot.name}: every exposure clips",
        field=worst.channel or None,
        found=f"{worst.clipped:.1%} of the pixels at saturation in the shortest",
        expected=f"at most {TOLERATED:.1%}",
        fix=f"Capture it at {time} and repeat this: where it clips, how far is not measured.",
    )


def _too_faint(shot: Shot, channels: list[Reading]) -> Problem:
    return Problem(
        "E_WHITE_DARK",
        f"{shot.name}: no signal exceeds the black level",
        found=f"peak {max(c.peak for c in channels):.1f} counts above it",
        expected=f"{FAINT * channels[0].room:.0f} or more",
        fix="Look whether the lamp was on, then capture it ten times longer.",
    )


def _no_white(shot: Shot, channels: list[Reading]) -> Problem:
    least = min(c.unevenness for c in channels)
    return Problem(
        "E_WHITE_UNEVEN",
        f"{shot.name}: this is not an evenly lit white",
        found=f"it varies by {least:.0%} over the field",
        expected=f"at most {NO_WHITE:.0%}",
        fix="Give --pattern where the sensor is a mosaic; else fill the field with the white board and move the lamps back.",
    )


@dataclass(frozen=True)
class Shot:
    """Frames of one band at one exposure."""

    name: str
    wavelength: float
    exposure_s: float | None
    stack: Template


def gather_shots(files: Sequence[Path], full: float, exposure_s: float | None) -> list[Shot]:
    """Put frames of one wavelength, exposure and size together."""
    groups: dict[tuple[str, float, float | None, tuple[int, ...]], list[Path]] = {}
    for file in files:
        facts = read_facts(file)
        wavelength, time = _from_name(file.name)
        name = f"{wavelength:g} nm" if wavelength == wavelength else file.parent.name
        key = (name, wavelength, exposure_s or time or facts.exposure_s, facts.shape)
        found = next((k for k in groups if k[0] == key[0] and k[2:] == key[2:]), key)
        groups.setdefault(found, []).append(file)
    return [
        Shot(name, wavelength, time, stack_of(members, saturation=full, exposure_s=time))
        for (name, wavelength, time, _), members in groups.items()
    ]


def _from_name(name: str) -> tuple[float, float | None]:
    """Return wavelength in nm and exposure in s, as a file's name has them.

    >>> _from_name("d1_disks_550nm_25ms_0004.tif"), _from_name("white.tif")
    ((550.0, 0.025), (nan, None))
    """
    wavelength = re.search(r"(?<![\d.])(\d{3,4}(?:\.\d+)?) ?nm(?![a-z])", name, re.IGNORECASE)
    time = re.search(r"(?<![\d.])(\d+(?:\.\d+)?) ?(us|µs|ms|s)(?![a-z])", name, re.IGNORECASE)
    unit = {"us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0}
    seconds = float(time[1]) * unit[time[2].lower()] if time else None
    return (float(wavelength[1]) if wavelength else nan), seconds


def advice_text(bands: Sequence[BandAdvice]) -> str:
    """Return advice for people: channels, time, and where the aim comes from."""
    lines: list[str] = []
    for found in bands:
        first, poorest = limiting(found.readings)
        shot = found.shot
        time = f"{shot.exposure_s:g} s" if shot.exposure_s else "unknown time"
        lines.append(f"{shot.name}: {time}, {shot.stack.count} shot{'s' * (shot.stack.count > 1)}")
        lines += [_channel_line(reading) for reading in found.readings]
        then = f"{found.time_s:.3g} s" if found.time_s else f"{first.factor:.2f} times as long"
        lines.append(
            f"  set {then} ({np.log2(first.factor):+.2f} stops): brings {first.channel or 'it'} to "
            f"{100 * first.target:.0f} % of saturation"
        )
        if len(found.readings) > 1 and isnan(shot.wavelength):
            behind = np.log2(first.mean / max(poorest.mean, 1e-9))
            lines.append(
                f"  {first.channel} saturates first; {poorest.channel} gets {behind:.1f} stops less light"
            )
    lines.append(f"full scale: {bands[0].full.counts:.0f} counts ({bands[0].full.source})")
    lines.append(
        f"the aim: one pixel in a million clips of a sensor of {FULL_WELL:,.0f} e⁻ with a PRNU of {100 * PRNU:.2g} %, under a lamp that "
        f"drifts by 1 % and light that varies by {100 * bands[0].first.unevenness:.0f} % over the field"
    )
    return "\n".join(lines)


def _channel_line(reading: Reading) -> str:
    return (
        f"  {reading.channel or 'all':4} mean {100 * reading.mean / reading.room:5.1f} %, "
        f"{reading.stops_left:5.2f} stops left, clipped {100 * reading.clipped:.2f} %"
    )
