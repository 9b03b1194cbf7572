"""What a build measures of sensors, light and layers on the way, as plain records for the reports."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field, replace
from math import isfinite
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.clipped_darks import MANY_ZEROS
from levkas.calibration.drift import LAMP
from levkas.core.cube import Cube, CubeRows, Flag, is_flagged

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from levkas.calibration.drift import LampChange
    from levkas.calibration.noise_fit import NoiseModel
    from levkas.calibration.templates import Template
    from levkas.core.cube import Band
    from levkas.database.tiff_pages import TiffPages
    from levkas.quality.image_quality.light import LightField

FEW_BANDS = 5
"""Bands of a line scan or photograph whose light is looked at."""
LEVELS = 65535
SENSELS = "sensels"
"""Among what is measured of a sensor: of the object's picture, not of the camera."""
NOISE, ROUNDING = "noise_shares", "rounding"
"""The same: what shots, white and darks add to the noise of each band, and the step of its codes, reflectance."""
PHOTONS, WHITE_FRAMES, DARK_FRAMES = "photons and read noise", "white frames", "dark frames"
VIEW = "mean_of_view"
"""The same: mean of all that each band shows, reflectance; stray light is a share of it."""
BLACK_WANDER = "black_wander"
"""The same: how far the black level of values in counts is known, counts."""
STRAYED = "stray_light"
"""The same: the share of the view's light that its light traps show."""


# --- the sensor ---------------------------------------------------------------------------------


def note_noise(
    measured: dict[str, Any],
    noise: NoiseModel | None,
    dark: Template | None,
    black: float,
    saturation: float | None,
) -> None:
    """Note gain, noise in the dark and range of a sensor in `measured`."""
    from levkas.quality.image_quality.dynamic_range import sensor_stops

    if noise is None or saturation is None:
        return
    floor = float(np.mean(dark.mean)) if dark is not None else black
    read, source = _noise_in_the_dark(dark, noise.step), noise.source
    if read is None and noise.read_variance > noise.step**2 / 12 * 1.01:
        read = float(np.sqrt(noise.read_variance))
    if read is None:  # the fit had one level only, and took rounding for all there is
        return
    measured["sensor"] = {
        "full": saturation - floor,
        "read_noise": read,
        "gain": float(noise.gain),
        "stops": sensor_stops(saturation - floor, read),
        "source": source,
    }


def _noise_in_the_dark(dark: Template | None, step: float) -> float | None:
    """Standard deviation of one dark shot, rounding included, counts; None where there is none, or it was clipped.

    Of a single dark the neighbours' differences, which leave out what is fixed and smooth.
    """
    from levkas.calibration.noise_fit import whole_variance

    if dark is None or dark.mean.size < 1000:
        return None
    if dark.fit is not None:
        return float(np.sqrt(dark.fit.noise**2 + step**2 / 12))
    if float(dark.mean.min()) <= 0 and float(np.mean(dark.black | (dark.mean <= 0))) > MANY_ZEROS:
        return None
    if dark.count > 1 and dark.variance is not None:
        found = float(np.median(dark.variance) if dark.count > 20 else np.mean(dark.variance))
    else:
        apart = np.abs(np.diff(dark.mean.astype(float), axis=1)).ravel()
        near = apart[apart <= np.quantile(apart, 0.995)]  # hot sensels are not noise
        found = float(np.mean(near)) ** 2 * np.pi / 4
    return float(np.sqrt(whole_variance(found, step)))


def note_sensels(
    measured: dict[str, Any],
    values: np.ndarray,
    flags: np.ndarray,
    variance: np.ndarray | None,
    pattern: Any,
    labels: Sequence[str],
) -> None:
    """Note noise and signal-to-noise of a mosaic's sensels in `measured`, channel by channel."""
    from levkas.calibration.patterns import channel_table
    from levkas.quality.image_quality.dynamic_range import sensel_noise

    if variance is None:
        return
    found = sensel_noise(values, flags, variance, channel_table(pattern, labels))
    measured[SENSELS] = {
        label: {"noise": as_number(noise), "snr": as_number(snr)}
        for label, (noise, snr) in zip(labels, found, strict=True)
    }


# --- the light ----------------------------------------------------------------------------------


def note_light(
    measured: dict[str, Any],
    white: Template | None,
    darks: Sequence[Template],
    pattern: Any,
    labels: Sequence[str],
    *,
    period: tuple[int, int] = (1, 1),
) -> None:
    """Note how even the light is on the white, channel by channel, in `measured`.

    A white that cannot say, because it saturates, is noted with its reason. One that is merged is in
    counts a second: the bits left in the corners are unknown. Of a cube that is only
    every so-many-th pixel a side, these are the `period`.
    """
    from levkas.quality.image_quality.light import LightRefused, light_field

    if white is None:
        return
    light = measured.setdefault("light", {})
    for label, plane, saturated, apart in _planes(white, darks, pattern, labels):
        try:
            field = light_field(plane, saturated=saturated)
        except LightRefused as refused:
            light[label] = {"refused": str(refused.problems[0])}
            continue
        light[label] = record_light(field, (apart[0] * period[0], apart[1] * period[1]))
        if not white.above_dark:
            light[label]["bits"] = [round(b, 2) for b in field.bits]


def _planes(
    white: Template, darks: Sequence[Template], pattern: Any, labels: Sequence[str]
) -> list[tuple[str, np.ndarray, np.ndarray, tuple[int, int]]]:
    """(label, counts above dark, saturated, period) of every channel; of a mosaic its first phase."""
    from levkas.calibration.darks import level_under
    from levkas.calibration.patterns import channel_names, channel_table
    from levkas.calibration.sensor_context import spread

    under = level_under(white, list(darks))
    if white.mean.ndim == 3:
        above, full = white.mean - under, white.saturated
        chosen = spread(range(len(labels)), FEW_BANDS)
        return [(labels[i], above[..., i], full[..., i], (1, 1)) for i in chosen]
    if pattern is None:
        return [(labels[0], white.mean - under, white.saturated, (1, 1))]
    table = channel_table(pattern)
    rows, columns = table.shape
    found = []
    for i, _ in enumerate(channel_names(pattern)):
        y, x = (int(n) for n in np.argwhere(table == i)[0])
        phase = np.s_[y::rows, x::columns]
        dark = under if under.size == 1 else np.broadcast_to(under, white.mean.shape)[phase]
        plane = white.mean[phase] - dark
        found.append((labels[i], plane, white.saturated[phase], (columns, rows)))
    return found


def record_light(field: LightField, period: tuple[int, int] = (1, 1)) -> dict[str, Any]:
    """Return a light field as a record; `period` is of the mosaic that the plane was taken from."""
    levels = np.round(field.levels * LEVELS).astype("<u2")
    x, y, width, height = field.rectangle
    across, down = period
    return {
        "levels": base64.b64encode(levels.tobytes()).decode("ascii"),
        "shape": list(levels.shape),
        "step": [field.step * across, field.step * down],
        "size": [field.size[0] * across, field.size[1] * down],
        "rectangle": [x * across, y * down, width * across, height * down],
        "drop": field.drop,
        "uniformity": field.uniformity,
        "share": field.share,
    }


def levels_of(record: Mapping[str, Any]) -> np.ndarray:
    """Return the levels of a recorded light field, (rows, columns), 0 … 1."""
    stored = np.frombuffer(base64.b64decode(record["levels"]), "<u2")
    return stored.reshape(record["shape"]) / LEVELS


LAMP_DOUBT, BLACK_DOUBT = 0.005, 0.0002
"""Standard deviation, relative and in reflectance, from which a build warns: half a per cent of the light, and a tenth
of the darkest paint, 0.002."""


def note_lamp(
    measured: dict[str, Any],
    labels: Sequence[str],
    lamp: LampChange,
    dark: LampChange | None = None,
    per_count: Sequence[float] = (),
) -> None:
    """Note how lamp and black level changed between darks, white and object in `measured`, band by band.

    `dark` is the wander of the black level, counts; `per_count` is the reflectance of a count in each band.
    """
    notes = measured.setdefault(LAMP, {})
    for i, label in enumerate(labels):
        numbers = {
            "white": lamp.white[i],
            "object": lamp.shot[i],
            "flicker": lamp.flicker[i],
            "sigma": lamp.sigma[i],
            "black": np.nan if dark is None else dark.white[i],
            "black_sigma": 0.0 if dark is None else dark.sigma[i] * per_count[i],
        }
        notes[label] = {name: as_number(float(value)) for name, value in numbers.items()}
        if dark is not None:
            within = np.hypot(*np.nan_to_num([dark.white[i], dark.flicker[i]]))
            notes[label]["black_within"] = as_number(float(within * per_count[i]))
        if lamp.reach:
            notes[label]["reach"] = as_number(lamp.reach)


def describe_lamp(measured: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Report how well the light is known between white and object, from what was measured of each sensor."""
    bands = {
        label: one
        for of_sensor in measured.values()
        for label, one in of_sensor.get(LAMP, {}).items()
    }
    notes = []
    # Of a weak band noise alone leaves the drift in doubt: that is no change of the lamp.
    changed = [
        label
        for label, one in bands.items()
        if one["white"] or one["object"] or (one["flicker"] or 0.0) >= LAMP_DOUBT
    ]
    worst = max(changed, key=lambda label: bands[label]["sigma"], default="")
    if changed and bands[worst]["sigma"] >= LAMP_DOUBT:
        one = bands[worst]
        changes = [
            f"{100 * one[name]:+.2g} % within the {name}"
            for name in ("white", "object")
            if one[name]
        ]
        if not changes:
            changes = [f"{100 * (one['flicker'] or 0):.2g} % rms from shot to shot"]
        advice = "capture whites before and after the object with the time in their files"
        if one.get("reach") and one["white"]:
            changes[-1] += (
                f", from which the object's last line lies {one['reach']:.2g} times as far"
            )
        if one.get("reach"):
            advice = "scan more lines of the white, evenly lit"
        notes.append(
            f"the lamp is known between white and object to {100 * one['sigma']:.2g} % (one standard deviation, common to all "
            f"pixels; {worst}), because it changed by {' and '.join(changes)}; sigma of pixels does not include this. Let "
            f"lamps warm up, and {advice}"
        )
    wandered = [b for b, one in bands.items() if one.get("black_within", 0.0) >= BLACK_DOUBT]
    dark = max(wandered, key=lambda label: bands[label]["black_sigma"], default="")
    if dark and bands[dark]["black_sigma"] >= BLACK_DOUBT:
        notes.append(
            f"the black level wanders from dark to dark: values are known to {bands[dark]['black_sigma']:.2g} by it (one "
            f"standard deviation, common to all pixels; {dark}), which sigma of pixels does not include"
        )
    return notes


def note_traps(
    measured: dict[str, Any], cube: Cube, boxes: Sequence[tuple[int, int, int, int]], target: str
) -> list[str]:
    """Note in `measured` the stray light that light traps in a sensor's frames show; return what a person should know of it.

    Raises CalibrationRefused where a trap lies beyond the frame.
    """
    from levkas.calibration.templates import CalibrationRefused
    from levkas.core.problems import Problem
    from levkas.quality.targets.stray_light import describe_trap, stray_light_of_trap

    height, width = cube.values.shape[:2]
    beyond = [[*box] for box in boxes if box[0] + box[2] > width or box[1] + box[3] > height]
    if beyond:
        raise CalibrationRefused(
            Problem(
                "E_VALUE",
                "a light trap lies beyond the frame",
                field=f"targets.traps.{target}",
                found=str(beyond[0]),
                expected=f"[x, y, width, height] within {width} x {height} native px",
            )
        )
    if not boxes or cube.quantity != "reflectance":
        return []
    found = stray_light_of_trap(cube, boxes)
    if found is None:
        return [f"the light traps of {target} show nothing: stray light is not known by them"]
    measured[STRAYED] = found.to_dict(cube.bands)
    return [describe_trap(measured[STRAYED])]


# --- a layer on the grid ------------------------------------------------------------------------


def flag_and_count(
    cube: Cube,
    other: tuple[np.ndarray, np.ndarray] | None = None,
    gains: np.ndarray | None = None,
) -> dict[str, int]:
    """Set GLARE and VEILED in the flags of reflectance; return pixels by sign.

    `other` are values and flags of the same pixels of the same camera under its default setup. Pixels are
    judged one by one: rows give what the whole layer gives, for the same `gains` of the setups.
    """
    from levkas.quality.image_quality.glare import find_glare, flag_glare

    if cube.quantity != "reflectance":
        return {}
    glare = find_glare(cube.values, cube.flags, cube.sigma, other=other, gains=gains)
    flag_glare(cube.flags, glare)
    return glare.counts()


def add_counts(total: dict[str, int], more: Mapping[str, int]) -> None:
    """Add the counts of some rows to those of the rows before."""
    for name, count in more.items():
        total[name] = total.get(name, 0) + count


def count_flags(flags: np.ndarray) -> np.ndarray:
    """Return how often each of the 256 codes occurs."""
    counts = np.zeros(256, np.int64)
    for row in flags:  # bincount turns what it counts into 64-bit numbers
        counts += np.bincount(row.reshape(-1), minlength=256)
    return counts


def describe_flags(counts: np.ndarray) -> dict[str, float]:
    """Return the share of pixels and bands under each flag, by its name, from `count_flags`."""
    codes = np.arange(256)
    total = max(int(counts.sum()), 1)
    return {
        flag.name.lower(): float(counts[(codes & flag.value) != 0].sum() / total)
        for flag in Flag
        if flag.name
    }


@dataclass(frozen=True)
class DefaultLayer:
    """A published layer on the same grid, read some rows at a time."""

    values: TiffPages
    flags: TiffPages

    @classmethod
    def open(cls, values: Path, flags: Path, shape: tuple[int, int, int]) -> DefaultLayer | None:
        """Open a layer's files; None where there is none of that (height, width, bands)."""
        from levkas.database.tiff_pages import open_pages

        if not (values.is_file() and flags.is_file()):
            return None
        layer = cls(open_pages(values), open_pages(flags))
        return layer if layer.values.shape == layer.flags.shape == shape else None

    def rows(self, start: int = 0, stop: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return values and flags of some rows, (rows, width, bands)."""
        return self.values.read(start, stop), self.flags.read(start, stop)


@dataclass
class LayerStatistics:
    """What is noted of a layer's rows on their way to its files: grey, where all was observed, flags, glare, ranges.

    Parameters
    ----------
    default : DefaultLayer, optional
        The same camera under its default setup.
    gains : ndarray, optional
        Of both, by band; None where they are found in the rows, which are then all in one block.
    step : int
        Every so-many-th pixel a side is kept in mind for range and noise.
    """

    default: DefaultLayer | None = None
    gains: np.ndarray | None = None
    step: int = 1
    mean: list[np.ndarray] = field(default_factory=list)
    valid: list[np.ndarray] = field(default_factory=list)
    flags: np.ndarray = field(default_factory=lambda: np.zeros(256, np.int64))
    glare: dict[str, int] = field(default_factory=dict)
    thin: list[Cube] = field(default_factory=list)
    sigma: list[np.ndarray] = field(default_factory=list)
    _rows: int = 0

    def flagged(self, rows: Cube | CubeRows) -> CubeRows:
        """Return the rows as they are taken, with glare flagged and noted."""
        blocks = self._flagged(rows.blocks, rows.shape[:2])
        return CubeRows(blocks, rows.shape, rows.bands, rows.quantity, rows.has_sigma)

    def _flagged(self, blocks: Iterable[Cube], shape: tuple[int, int]) -> Iterator[Cube]:
        from levkas.database.grey import grey_of, grey_step

        step = grey_step(*shape)
        apart = -(-max(shape) // LONGEST_SIGMA)

        for cube in blocks:
            first, self._rows = self._rows, self._rows + len(cube.values)
            other = self.default.rows(first, self._rows) if self.default else None
            mean, valid = grey_of(cube.values, cube.flags, first, step)
            counts = flag_and_count(cube, other, self.gains)
            add_counts(self.glare, {"inside": int(np.count_nonzero(valid)), **counts})
            self.thin.append(self._thinned(cube, first))
            self.mean.append(mean)
            self.valid.append(valid)
            self.flags += count_flags(cube.flags)
            if cube.sigma is not None:
                self.sigma.append(_mean_sigma(cube.sigma[-first % apart :: apart, ::apart]))
            yield cube

    def _thinned(self, cube: Cube, first: int) -> Cube:
        """Return every so-many-th pixel a side of some rows, of which the layer's row `first` is the first."""
        if self.step == 1:
            return cube
        part = np.s_[-first % self.step :: self.step, :: self.step]
        sigma = None if cube.sigma is None else cube.sigma[part].copy()
        return replace(
            cube, values=cube.values[part].copy(), flags=cube.flags[part].copy(), sigma=sigma
        )

    @property
    def grey(self) -> tuple[np.ndarray, np.ndarray]:
        """As `database.grey.read_grey` gives it of the layer's files."""
        return np.concatenate(self.mean), np.concatenate(self.valid)

    def ranges(self) -> list[dict[str, Any]]:
        """Return range, noise and signal-to-noise of every band of the layer."""
        from levkas.quality.image_quality.dynamic_range import scene_ranges

        one = self.thin[0] if len(self.thin) == 1 else _stacked(self.thin)
        counts = one.quantity == "counts"
        found = scene_ranges(one.values, one.flags, one.sigma, one.labels, counts=counts)
        return [{name: as_number(value) for name, value in r._asdict().items()} for r in found]

    def sigma_map(self) -> dict[str, Any]:
        """Return sigma, mean over bands, of every so-many-th pixel a side, for the report: PNG text and the ends of its scale; nothing where noise is not known.

        Levels 1 to 255 are `least` to `most`, the ends beyond which one pixel of a hundred lies; 0 is not known.
        """
        from levkas.database.preview import encode_png

        mean = np.concatenate(self.sigma or [np.empty((0, 0))])
        known = np.isfinite(mean)
        if not known.any():
            return {}
        least, most = np.percentile(mean[known], ENDS_OF_SIGMA)
        place = np.clip((mean - least) / max(most - least, 1e-12), 0, 1)
        levels = np.where(known, 1 + np.round(254 * place), 0).astype(np.uint8)
        picture = base64.b64encode(encode_png(levels)).decode("ascii")
        return {"sigma_map": {"png": picture, "least": float(least), "most": float(most)}}


LONGEST_SIGMA, BANDS_OF_SIGMA = 360, 24
"""Longest side of the map of sigma that a layer's record holds, px, and the most bands of which it is the mean: it is smooth in wavelength."""
ENDS_OF_SIGMA = (1.0, 99.0)
"""Of the scale of that map, per cent of its pixels."""


def _mean_sigma(sigma: np.ndarray) -> np.ndarray:
    """Return the mean over every n-th of many bands, (h, w, bands) → (h, w); NaN where sigma is known in none."""
    every = -(-sigma.shape[2] // BANDS_OF_SIGMA)
    some = sigma[:, :, every // 2 :: every]
    known = np.isfinite(some)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sum(some, -1, dtype=float, where=known) / known.sum(-1))


def _stacked(parts: Sequence[Cube]) -> Cube:
    values, flags = (np.concatenate([getattr(c, n) for c in parts]) for n in ("values", "flags"))
    known = [cube.sigma for cube in parts if cube.sigma is not None]
    return replace(
        parts[0], values=values, flags=flags, sigma=np.concatenate(known) if known else None
    )


def as_number(value: Any) -> Any:
    """Return what JSON has a word for; of floats five digits."""
    if isinstance(value, float):
        return float(f"{value:.5g}") if isfinite(value) else None
    return value


MOST_BANDS = 24
"""Bands of a camera whose focus is measured, evenly over all; neighbours are alike."""
LOST = Flag.GLARE | Flag.SATURATED | Flag.OUTSIDE


def focus_of(cubes: Iterable[Cube]) -> list[dict[str, Any]]:
    """Return the blur of the sharpest edges, band by band, before anything is resampled."""
    return [
        one
        for cube in cubes
        for one in _focus_of(cube.values, cube.flags, cube.labels, step_of(len(cube.bands)))
    ]


def step_of(bands: int) -> int:
    """Return of how many bands one is measured."""
    return max(1, -(-bands // MOST_BANDS))


class Middle:
    """The middle of a scan, of the bands whose focus is measured, taken from its lines as they pass.

    Parameters
    ----------
    shape : (lines, samples, bands)
    """

    def __init__(self, shape: tuple[int, int, int], bands: Sequence[Band]) -> None:
        from levkas.quality.image_quality.sharpness import middle_of

        self._rows, self._columns = middle_of(shape[:2])
        self._step = step_of(len(bands))
        self._labels = [band.label for band in bands][:: self._step]
        size = (self._rows.stop - self._rows.start, self._columns.stop - self._columns.start)
        self._values = np.empty((*size, len(self._labels)), np.float32)
        self._flags = np.empty(self._values.shape, np.uint8)
        self._line = 0

    def add(self, cube: Cube) -> None:
        """Take the next lines."""
        first, self._line = self._line, self._line + len(cube.values)
        low, high = max(first, self._rows.start), min(self._line, self._rows.stop)
        if low >= high:
            return
        part = np.s_[low - first : high - first, self._columns, :: self._step]
        here = slice(low - self._rows.start, high - self._rows.start)
        self._values[here], self._flags[here] = cube.values[part], cube.flags[part]

    def focus(self) -> list[dict[str, Any]]:
        """Return what `focus_of` gives of the whole scan."""
        return _focus_of(self._values, self._flags, self._labels, 1)


def _focus_of(
    values: np.ndarray, flags: np.ndarray, labels: Sequence[str], step: int
) -> list[dict[str, Any]]:
    from levkas.quality.image_quality.sharpness import band_sharpness, middle_of

    middle = middle_of((values.shape[0], values.shape[1]))
    values, flags = values[middle][..., ::step], flags[middle][..., ::step]
    found = band_sharpness(values, labels[::step], left_out=is_flagged(flags, LOST))
    return [
        {"band": one.band, "blur_px": as_number(one.blur_px), "edges": one.edges} for one in found
    ]
