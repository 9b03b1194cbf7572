"""Exposure advice from captured frames of a white."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isnan, log10, nan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from levkas.calibration.full_scale import FullScale
from levkas.calibration.noise_fit import NoiseModel, fit_noise_of_frames
from levkas.calibration.noise_model import Sensor
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
from levkas.planning.exposure_levels import (
    Advice,
    Reading,
    advise,
    judge_iso,
    limiting,
    read_channel,
    safe_mean,
    snr_at,
)
from levkas.quality.emva1288.blocks import block_statistics
from levkas.readers.frames import Facts, read_facts

TOLERATED = 1e-3  # share of pixels at saturation: glints and hot sensels
FAINT = 0.002  # of saturation: less does not suffice to advise a time
PRNU = 0.01  # where it is not measured
NO_WHITE = 1.0  # (brightest − darkest)/mean, above which no evenly lit white was shown
FEWEST_ELECTRONS = 500.0  # of the brightest sensel: with fewer it is texture that was read as noise
LIT, FEWEST_BLOCKS = 0.1, 16  # share of saturation from which a white shows PRNU, on so many blocks


class NoAdvice(Refused):
    """Frames from which no exposure can be advised."""


@dataclass(frozen=True)
class BandAdvice:
    """Advice for one band or one camera.

    Parameters
    ----------
    shot : Shot
        The longest that does not clip.
    advices : list of Advice
        One a channel.
    sensor : Sensor
        As fitted, or assumed, for the SNR.
    iso_advice : str
    notes : list of str
    prnu_known : bool
        Whether the sensor's PRNU was measured on them, or 1 % is assumed.
    full, full_from : float, str
        Counts at which a sensel is full, and where that is known from.
    """

    shot: Shot
    advices: list[Advice]
    sensor: Sensor
    iso_advice: str
    notes: list[str]
    prnu_known: bool = False
    full: float = float("nan")
    full_from: str = ""

    @property
    def first(self) -> Advice:
        """The channel that saturates first; its time is everyone's."""
        return limiting(self.advices)[0]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for `--json`."""
        first, poorest = limiting(self.advices)
        return {
            "name": self.shot.name,
            "wavelength": None if isnan(self.shot.wavelength) else self.shot.wavelength,
            "exposure_s": self.shot.exposure_s,
            "recommended_s": first.time_s,
            "recommended_factor": first.factor,
            "target": first.target,
            "saturates_first": first.reading.channel,
            "poorest": poorest.reading.channel,
            "iso": self.iso_advice,
            "channels": [self._channel(advice) for advice in self.advices],
            "prnu": self.sensor.prnu,
            "prnu_known": self.prnu_known,
            "full_scale": self.full,
            "full_scale_from": self.full_from,
            "notes": self.notes,
        }

    def _channel(self, advice: Advice) -> dict[str, Any]:
        reading = advice.reading
        then = snr_at(advice, self.sensor, self.first.factor)
        return {
            "channel": reading.channel,
            "mean": reading.mean,
            "peak": reading.peak,
            "stops_to_saturation": reading.stops_left,
            "clipped": reading.clipped,
            "unevenness": reading.unevenness,
            "histogram": reading.histogram.tolist(),
            "snr_now": advice.snr_now,
            "snr_at_recommended": then,
            "snr_at_recommended_db": 10 * log10(then) if then > 0 else None,
            "own_time_s": advice.time_s,
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
        longest unclipped counts; equal ones are a stack, which shows the noise.
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
    full = scale.counts
    under = {shot.exposure_s: _dark_of(shot, darks) for shot in shots}
    levels = {t: float(np.median(dark.mean)) if dark else black for t, dark in under.items()}
    readings = [(s, _readings(s, levels[s.exposure_s], full, pattern)) for s in shots]
    clear = [(s, r) for s, r in readings if max(c.clipped for c in r) <= TOLERATED]
    if not clear:
        raise NoAdvice(_clipped(min(readings, key=lambda item: item[0].exposure_s or 0.0)))
    shot, channels = max(clear, key=lambda item: item[1][0].mean)
    black = levels[shot.exposure_s]
    if max(c.peak for c in channels) < FAINT * (full - black):
        raise NoAdvice(_too_faint(shot, channels))
    if min(c.unevenness for c in channels) > NO_WHITE:
        raise NoAdvice(_no_white(shot, channels))
    noise, notes = _noise(shots, shot, list(under.values()), black, pattern)
    prnu = _prnu(shot, black, full, pattern)
    sensor = Sensor(
        dark=0.0,
        read=float(np.sqrt(noise.read_variance)) / noise.gain,
        prnu=PRNU if prnu is None else prnu,
        dsnu=0.0,
        gain=noise.gain,
    )
    advices = [
        advise(c, sensor, exposure_s=shot.exposure_s, wavelength=shot.wavelength) for c in channels
    ]
    iso = judge_iso(
        limiting(advices)[0].stops, dark_noise_dn=float(np.sqrt(noise.read_variance)), iso=shot.iso
    )
    if shot.exposure_s is None:
        notes.append("the exposure is not known: multiply the one that was set")
    return BandAdvice(
        shot, advices, sensor, iso, notes, prnu is not None, full, scale.source,
    )  # fmt: skip


def _prnu(
    shot: Shot, black: float, full: float, pattern: str | Sequence[Sequence[str]] | None
) -> float | None:
    """Return the PRNU that a stack of a white shows, its texture included; None where it cannot."""
    if shot.stack.count < 2 or shot.stack.mean.ndim != 2:
        return None
    blocks = block_statistics(shot.stack, pattern).values()
    signal = np.concatenate([b.mean - black for b in blocks])
    fixed = np.concatenate([b.spatial - b.temporal / b.shots for b in blocks])
    used = np.isfinite(signal + fixed) & (signal > LIT * (full - black))
    if np.count_nonzero(used) < FEWEST_BLOCKS:
        return None
    squared = float(np.sum(fixed[used]) / np.sum(signal[used] ** 2))
    return float(np.sqrt(max(squared, 0.0)))


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


def _noise(
    shots: Sequence[Shot],
    shot: Shot,
    darks: Sequence[Template | None],
    black: float,
    pattern: str | Sequence[Sequence[str]] | None,
) -> tuple[NoiseModel, list[str]]:
    """Fit the noise of a sensor to all exposures of a band; from single shots only an upper bound follows."""
    size, stacks = shot.stack.mean.shape, [s.stack for s in shots]
    fitting = {id(dark): dark for dark in darks if dark is not None and dark.mean.shape == size}
    alone = [None] * len(stacks) if len(size) == 2 else []  # single shots are read plane by plane
    noise = fit_noise_of_frames(stacks, alone, list(fitting.values()), black=black, pattern=pattern)
    top = float(np.max(shot.stack.mean))
    least = max(top - black, 1.0) / FEWEST_ELECTRONS if alone else 0.0
    if noise is not None and noise.source == "temporal" and noise.gain > 0:
        return noise, []
    if noise is None or not 0 < noise.gain <= least:
        # 8 bits of a usual sensor, or texture all over: the advice on time does not hang on it, the SNR does.
        assumed = NoiseModel(max(top, 1.0) / 20_000, 1.0, "spatial")
        return assumed, [
            "the noise could not be measured: 20,000 electrons are assumed at the peak"
        ]
    note = "one shot only: the SNR is a lower bound, because texture counts as noise; two shots measure it"
    return noise, [note]


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
    iso: float | None
    stack: Template


def gather_shots(files: Sequence[Path], full: float, exposure_s: float | None) -> list[Shot]:
    """Put frames of one wavelength, exposure and size together."""
    groups: dict[tuple[str, float, float | None, tuple[int, ...]], list[Path]] = {}
    known: dict[Path, Facts] = {}
    for file in files:
        facts = known[file] = read_facts(file)
        wavelength, time = _from_name(file.name)
        name = f"{wavelength:g} nm" if wavelength == wavelength else file.parent.name
        key = (name, wavelength, exposure_s or time or facts.exposure_s, facts.shape)
        found = next((k for k in groups if k[0] == key[0] and k[2:] == key[2:]), key)
        groups.setdefault(found, []).append(file)
    return [
        Shot(
            name,
            wavelength,
            time,
            known[members[0]].iso,
            stack_of(members, saturation=full, exposure_s=time),
        )
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


SHADES = " ▁▂▃▄▅▆▇█"


def advice_text(bands: Sequence[BandAdvice]) -> str:
    """Return advice for people: channels, histogram, time, why, and ISO."""
    lines: list[str] = []
    for found in bands:
        first, poorest = limiting(found.advices)
        shot = found.shot
        time = f"{shot.exposure_s:g} s" if shot.exposure_s else "unknown time"
        lines.append(f"{shot.name}: {time}, {shot.stack.count} shot{'s' * (shot.stack.count > 1)}")
        lines += [_channel_line(found, advice) for advice in found.advices]
        then = f"{first.time_s:.3g} s" if first.time_s else f"{first.factor:.2f} times as long"
        lines.append(
            f"  set {then} ({first.stops:+.2f} stops): brings {first.reading.channel or 'it'} to "
            f"{100 * first.target:.0f} % of saturation"
        )
        if len(found.advices) > 1 and isnan(shot.wavelength):
            behind = np.log2(first.reading.mean / max(poorest.reading.mean, 1e-9))
            lines.append(
                f"  {first.reading.channel} saturates first; {poorest.reading.channel} gets {behind:.1f} stops "
                "less light: a filter or a lamp richer there would even them out"
            )
        lines.append(f"  ISO: {found.iso_advice}")
        lines += [f"  note: {note}" for note in found.notes]
    lines.append(f"full scale: {bands[0].full:.0f} counts ({bands[0].full_from})")
    lines.append(_why(bands[0]))
    if len(bands) > 1 and all(c.first.time_s for c in bands):
        total = sum(c.first.time_s or 0.0 for c in bands)
        slow = max(bands, key=lambda c: c.first.time_s or 0.0)
        lines.append(
            f"all {len(bands)} bands: {total:.3g} s a series; {slow.shot.name} takes longest, "
            f"{slow.first.time_s:.3g} s"
        )
    return "\n".join(lines)


def _why(found: BandAdvice) -> str:
    """Return where the target comes from, with its numbers."""
    first = found.first
    full_well = first.reading.room / found.sensor.gain
    usual = safe_mean(full_well, prnu=found.sensor.prnu)
    reason = (
        f"why {100 * first.target:.0f} %: f = 1/[(1 + z√(1/(f·FW) + PRNU²))(1 + U/2)(1 + drift)], so that one "
        f"pixel in a million clips (z 4.75) with FW {full_well:,.0f} e⁻, PRNU "
        f"{100 * found.sensor.prnu:.2g} % {'measured' if found.prnu_known else 'assumed'}, a lamp that drifts by 1 %"
    )
    return (
        f"{reason}, and light that varies by U = {100 * first.reading.unevenness:.0f} % over the field; "
        f"at 10 % it would be {100 * usual:.0f} %"
    )


def _channel_line(found: BandAdvice, advice: Advice) -> str:
    reading = advice.reading
    bars = np.add.reduceat(reading.histogram, np.arange(0, len(reading.histogram), 2))
    height = np.ceil(8 * np.sqrt(bars / max(bars.max(), 1))).astype(int)
    drawn = "".join(SHADES[h] for h in height)
    then = snr_at(advice, found.sensor, found.first.factor)
    return (
        f"  {reading.channel or 'all':4} |{drawn}| mean {100 * reading.mean / reading.room:5.1f} %, "
        f"{reading.stops_left:5.2f} stops left, clipped {100 * reading.clipped:.2f} %, "
        f"SNR {advice.snr_now:.0f} now, {then:.0f} then ({10 * log10(max(then, 1e-9)):.1f} dB, 10·log10)"
    )
