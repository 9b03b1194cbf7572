"""Flat field: raw counts to reflectance, on the mosaic, before anything mixes sensels.

r = (S − D)/(W − D′) · tW/tS · Rw, with the dark D of the object's exposure and D′ of the white's.
Variance, first order, with shares 1/n of the averages and the correlation ρ of the two darks:
u² = [vS/nS + vD/nD + r²(vW/nW + vD′/nD′) − 2 r ρ √(vD/nD · vD′/nD′)]/(W − D′)²; of one dark, ρ = 1, (1 − r)² vD/nD is left.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from levkas.calibration.clipped_darks import unclip_means
from levkas.calibration.darks import MatchedDark, dark_correlation, dark_under, match_dark
from levkas.calibration.noise_fit import HIDES, PRIOR, WORKED_OUT, NoiseModel
from levkas.calibration.templates import (
    CalibrationRefused,
    Template,
    as_marks,
    as_rows,
    bands_alike,
    pick_bands,
    read_only,
)
from levkas.calibration.whites import PERFECT, WhiteBoard, check_white, reflectance_table
from levkas.core.compiled import njit
from levkas.core.cube import Flag
from levkas.core.problems import Problem
from levkas.core.threads import in_threads


@dataclass(frozen=True)
class Calibrated:
    """Corrected values of one sensor in native pixels.

    Parameters
    ----------
    values : ndarray, (h, w) or (h, w, b), float32
        NaN where no value could be computed; DEFECT is set there.
    flags : ndarray like `values`, uint8
        Bits of `cube.Flag`.
    variance : ndarray like `values`, float32, or None
        Of `values`; None where the camera's noise is not known.
    quantity : str
        ``"reflectance"``, or ``"counts"`` where there is no white.
    notes : tuple of str
        What a report has to say: darks that were scaled, exposures that were not known.
    """

    values: np.ndarray
    flags: np.ndarray
    variance: np.ndarray | None
    quantity: str
    notes: tuple[str, ...] = ()


def flat_field(
    shot: Template,
    dark: Template | Sequence[Template] | None = None,
    white: Template | None = None,
    *,
    board: WhiteBoard = PERFECT,
    black: float | np.ndarray | None = None,
    noise: NoiseModel | None = None,
    defects: np.ndarray | None = None,
) -> Calibrated:
    """Turn an object's raw counts into reflectance, or into counts above dark.

    Parameters
    ----------
    shot : Template, (h, w) or (h, w, b)
        The object.
    dark : Template or sequence of Template, optional
        Of one or several exposures, see `darks.match_dark`. May be one line high (push-broom).
    white : Template, optional
        May be one line high. None: the result is in counts above dark.
    board : WhiteBoard, optional
        Reflectance of the white, and the channels it is checked in; or the unit of files of reflectance.
    black : float or ndarray like `shot.mean`, optional
        Black level in counts; subtracted where there is no dark. None: not known. Neither dark nor
        black are subtracted from a shot or a white that is above dark.
    noise : NoiseModel, optional
        Variance of one shot over its signal. Without it noise is that of the stacks.
    defects : ndarray of bool like `shot.mean`, optional
        Pixels to flag as DEFECT.

    Returns
    -------
    calibrated : Calibrated
        SATURATED where a shot of the object or of the white was, BLACK where one of the object
        was clipped, DEFECT where white is not above dark. Values are not clipped to 0–1.

    Raises
    ------
    CalibrationRefused
        E_SIZE, E_VALUE; E_EXPOSURES as `require_dark`; E_WHITE_DARK where white is darker than dark,
        E_WHITE_SATURATED where it is saturated, over more than half of any channel.

    Notes
    -----
    Where both a stack and `noise` are there, the variance of n shots weighs n − 1 against 60 of
    the model: two shots alone give a sigma that is of no use.

    Examples
    --------
    >>> from levkas.calibration.templates import average
    >>> S, D, W = (average([np.full((1, 2), v)]) for v in (30.0, 10.0, 50.0))
    >>> flat_field(S, D, W, board=WhiteBoard(0.98)).values.tolist()
    [[0.49..., 0.49...]]
    """
    _check_shapes(shot, dark, white, defects)
    darks = [dark] if isinstance(dark, Template) else list(dark or ())
    if groups := bands_alike(shot, *darks, white):
        parts = (
            flat_field(
                pick_bands(shot, bands),
                [pick_bands(dark, bands) for dark in darks],
                None if white is None else pick_bands(white, bands),
                board=board.of_bands(bands, shot.mean.shape[2:]),
                black=black,
                noise=noise,
                defects=None if defects is None else defects[..., bands],
            )
            for bands in groups
        )
        return _join_bands(groups, parts, shot.mean.shape)
    under, white_under, ratio, notes = pair_darks(shot, dark, white, black)
    require_dark(shot, under, noise)
    if white is not None and white_under is not under:
        require_dark(white, white_under, noise, lit=True)
    if noise is not None and not shot.above_dark:
        read = noise.read_under(under) - noise.step**2 / 12
        level = under.level
        shot = unclip_means(
            shot, level, gain=noise.gain, read_variance=read, step=noise.step or 1.0
        )
    scale = reflectance_table(board, shot) * ratio
    bad = under.saturated if defects is None else defects | under.saturated
    if white is None:
        unit = 1.0 if board.unit is None else np.asarray(board.unit)
        of_unit = replace(board, reflectance=1 / np.asarray(unit, float), pattern=None)
        scale = reflectance_table(of_unit, shot)
        lit, lit_saturated = exact_side(1.0), np.zeros((1, 1), np.uint8)
    else:
        if not board.checked:
            check_white(white, white_under.mean, board.pattern, board.labels)
        lit, lit_saturated = Side.of_shots(white), as_marks(white.saturated)
    sides = Side.of_shots(shot), Side.of_dark(under), lit, Side.of_dark(white_under)
    marks = (as_marks(shot.saturated), lit_saturated, as_marks(shot.black), as_marks(bad))
    known = noise is not None or all(side.known for side in sides)
    shape, size = shot.mean.shape, sides[0].mean.shape
    outputs = np.empty(size, np.float32), np.empty(size, np.uint8)
    variance = np.empty(size if known else (0, 0), np.float32)
    width = size[1]
    wide = tuple(side.as_wide_as(width) for side in sides)
    model = tuple(map(float, model_of(noise, under, white_under)))
    inputs = (
        wide,
        _Marks(*(_widened(mark, width) for mark in marks)),
        _widened(np.asarray(scale, np.float64), width),
        model,
        dark_correlation(under, white_under),
        _shares_of_line(wide, model) if known else np.empty((3, 0)),
    )
    in_threads(_flatten, size[0], inputs, *outputs, variance, worth=outputs[0].size)
    values, flags = (part.reshape(shape) for part in outputs)
    quantity = "counts" if white is None and board.unit is None else "reflectance"
    return Calibrated(values, flags, variance.reshape(shape) if known else None, quantity, notes)


def _join_bands(
    groups: list[np.ndarray], parts: Iterable[Calibrated], shape: tuple[int, ...]
) -> Calibrated:
    """Put groups of bands that have one exposure in each template together, (h, w, b)."""
    values, flags = np.empty(shape, np.float32), np.empty(shape, np.uint8)
    variance: np.ndarray | None = np.empty(shape, np.float32)
    notes: dict[str, None] = {}
    for bands, part in zip(groups, parts, strict=True):
        values[..., bands], flags[..., bands] = part.values, part.flags
        if variance is not None and part.variance is not None:
            variance[..., bands] = part.variance
        else:
            variance = None
        notes |= dict.fromkeys(part.notes)
        quantity = part.quantity
    return Calibrated(values, flags, variance, quantity, tuple(notes))


class Side(NamedTuple):
    """A mean, the variance of one shot, its degrees of freedom (0: not measured), and the mean's share of it.

    Arrays are (h, w) views; one of height or width 1 applies to all rows or columns.
    """

    mean: np.ndarray
    variance: np.ndarray
    freedom: float
    share: float

    @classmethod
    def of_shots(cls, shots: Template) -> Side:
        """Return the side of an average of shots, or of exposures that were merged."""
        if shots.variance is None:
            return cls._of(shots.mean, None, 0.0, 1.0 / shots.count)
        # A merged exposure series is one "shot" whose variance was worked out, not sampled.
        freedom = shots.count - 1.0 if shots.count > 1 else WORKED_OUT
        return cls._of(shots.mean, shots.variance, freedom, 1.0 / shots.count)

    @classmethod
    def of_dark(cls, dark: MatchedDark) -> Side:
        """Return the side of what is subtracted."""
        freedom = 0.0 if dark.variance is None else max(dark.count - 1.0, 0.0)
        freedom = WORKED_OUT if dark.worked_out else freedom
        return cls._of(dark.mean, dark.variance, freedom, dark.share)

    @classmethod
    def _of(
        cls, mean: np.ndarray, variance: np.ndarray | None, freedom: float, share: float
    ) -> Side:
        spread = np.zeros((1, 1), np.float32) if variance is None else as_rows(variance)
        return cls(read_only(as_rows(mean)), read_only(spread), float(freedom), float(share))

    @property
    def known(self) -> bool:
        """Whether its variance is known."""
        return self.freedom > 0 or self.share == 0

    def as_wide_as(self, width: int) -> Side:
        """Return the side with one number repeated for all columns."""
        return self._replace(
            mean=_widened(self.mean, width), variance=_widened(self.variance, width)
        )


def exact_side(value: float) -> Side:
    """Return a number that is known exactly."""
    return Side._of(np.full((1, 1), value, np.float32), None, 0.0, 0.0)


def model_of(
    noise: NoiseModel | None, under: MatchedDark, white_under: MatchedDark
) -> tuple[float, float, float, float]:
    """Return gain, variance without light of object and of white, and step, as the kernels take them."""
    if noise is None:
        return -1.0, 0.0, 0.0, 0.0
    read = noise.read_under(under)
    return (
        noise.gain,
        read,
        read if white_under is under else noise.read_under(white_under),
        noise.step,
    )


def pair_darks(
    shot: Template,
    dark: Template | Sequence[Template] | None,
    white: Template | None,
    black: float | np.ndarray | None,
) -> tuple[MatchedDark, MatchedDark, float, tuple[str, ...]]:
    """Return the darks of object and white, the white's time over the object's, and notes."""
    under = dark_under(shot, dark, black=black)
    if white is None:
        return under, match_dark(None, None), 1.0, (under.note,) if under.note else ()
    same_time = shot.exposure_s == white.exposure_s
    alike = same_time and shot.above_dark == white.above_dark
    white_under = under if alike else dark_under(white, dark, black=black)
    notes = [d.note for d in (under, white_under) if d.note]
    ratio = 1.0
    if shot.exposure_s and white.exposure_s:
        ratio = white.exposure_s / shot.exposure_s
    elif not same_time:
        notes.append(
            "the exposure of the object or the white is unknown: they are assumed to be equal"
        )
    return under, white_under, ratio, tuple(dict.fromkeys(notes))


def require_dark(
    frame: Template, under: MatchedDark, noise: NoiseModel | None, *, lit: bool = False
) -> None:
    """Refuse a dark of another time whose black level is unknown where its dark current may exceed the noise.

    Parameters
    ----------
    frame : Template
        From which it is subtracted.
    noise : NoiseModel, optional
        Of one shot. None: the noise is taken for one count.
    lit : bool
        Whether the frame is a white, whose light has noise too; else its darkest pixels are judged.

    Raises
    ------
    CalibrationRefused
        E_EXPOSURES.

    Notes
    -----
    The current of a dark of time tD is at most all of its counts, and at most read²/gain, for it has shot noise:
    of a frame of time t it is wrong by up to that times t/tD − 1.

    Examples
    --------
    A dark of 0.1 s under a frame of 0.4 s, noise of 2 counts: 16 counts of current, or 48.

    >>> none = np.zeros((1, 1), bool)
    >>> dark, frame = (Template(np.full((1, 1), 64, "f4"), None, 1, none, none, t) for t in (0.1, 0.4))
    >>> require_dark(frame, match_dark(dark, 0.4), NoiseModel(0.25, 4.0))
    Traceback (most recent call last):
    levkas.calibration.templates.CalibrationRefused: ...
    """
    if not under.stretch:
        return
    level, variance = under.level, 1.0
    current = max(level, 0.0)
    if noise is not None:
        variance = noise.read_variance
        current = min(current, variance / max(noise.gain, 1e-12))
        if lit:
            variance += noise.gain * max(frame.level - level, 0.0)
    wrong, sigma = abs(under.stretch) * current, float(np.sqrt(variance))
    if wrong <= sigma:
        return
    time = frame.exposure_s or 0.0
    raise CalibrationRefused(
        Problem(
            "E_EXPOSURES",
            f"the dark of {time / (1 + under.stretch):g} s does not serve frames of {time:g} s: the black level is unknown",
            field="black",
            found=f"dark current of up to {wrong:.2g} counts, noise of {sigma:.2g}",
            expected="a dark of the same time, darks of two times, or the black level",
            fix=f"Capture darks of {time:g} s, or write `black` of the camera in campaign.toml: what a dark of a very "
            "short time shows.",
        )
    )


def describe_darks(
    shot: Template,
    darks: Sequence[Template],
    white: Template | None,
    black: float | np.ndarray | None,
) -> tuple[str, ...]:
    """Return the notes of `flat_field`, which follow from exposures alone."""
    every = np.arange(shot.mean.shape[-1])
    notes: dict[str, None] = {}
    for bands in bands_alike(shot, *darks, white) or [every]:
        part, *under = (pick_bands(template, bands) for template in (shot, *darks))
        lit = None if white is None else pick_bands(white, bands)
        notes |= dict.fromkeys(pair_darks(part, under, lit, black)[3])
    return tuple(notes)


def _check_shapes(
    shot: Template,
    dark: Template | Sequence[Template] | None,
    white: Template | None,
    defects: np.ndarray | None,
) -> None:
    darks = [dark] if isinstance(dark, Template) else list(dark or ())
    offered = [("dark", d.mean) for d in darks]
    offered += [("white", white.mean)] if white is not None else []
    offered += [("defects", defects)] if defects is not None else []
    height, *rest = shot.mean.shape
    problems = [
        Problem(
            "E_SIZE",
            f"{name} and object differ in size",
            found=str(array.shape),
            expected=str(shot.mean.shape),
            fix="Capture dark and white in the same mode and with the same crop as the object.",
        )
        for name, array in offered
        if list(array.shape[1:]) != rest or array.shape[0] not in (1, height)
    ]
    if problems:
        raise CalibrationRefused(*problems)


SATURATED, BLACK, DEFECT = (np.uint8(f.value) for f in (Flag.SATURATED, Flag.BLACK, Flag.DEFECT))


class _Marks(NamedTuple):
    """Masks as bytes, (h, w) views, by which `_flatten` sets flags."""

    saturated: np.ndarray
    white_saturated: np.ndarray
    black: np.ndarray
    bad: np.ndarray


@njit(cache=True)
def _flatten(start, stop, inputs, values, flags, variance):  # type: ignore[no-untyped-def]
    """Fill rows `start` to `stop` of values (shot − dark)/(white − white_dark) · table, flags and variance.

    Parameters
    ----------
    inputs : (sides, marks, table, model, shared, shares)
        Four `Side`, as wide as the shot, of shot, dark, white and the white's dark; the `_Marks`; white
        reflectance times the ratio of exposures, (rows, w), repeated over the rows; gain (below 0: no
        model), variances without light of object and white, step; the correlation of the two darks; what
        `_shares_of_line` gives.
    values, flags, variance : ndarray, (h, w)
        No variance is worked out where its size is 0.
    """
    sides, marks, table, model, common, shares = inputs
    alike = shares.size > 0
    own = np.empty((3, 0 if alike or variance.size == 0 else values.shape[1]))
    for y in range(start, stop):
        flatten_line(y, sides, marks, table, values[y], flags[y])
        if variance.size > 0:
            if not alike:
                fill_shares(y, sides, model, own)
            propagate_line(y, sides, table, model, common, shares if alike else own, variance[y])


@njit
def row_of(array, y):  # type: ignore[no-untyped-def]
    """Return a row of an array whose rows are repeated."""
    return array[y % array.shape[0]]


@njit
def flatten_line(y, sides, marks, table, values, flags):  # type: ignore[no-untyped-def]
    """Fill values and flags of row `y`."""
    shot, dark, white, white_dark = sides
    counts, back, lit, under = (
        row_of(shot.mean, y), row_of(dark.mean, y), row_of(white.mean, y), row_of(white_dark.mean, y)
    )  # fmt: skip
    saturated, black = row_of(marks.saturated, y), row_of(marks.black, y)
    white_saturated, bad = row_of(marks.white_saturated, y), row_of(marks.bad, y)
    scale = row_of(table, y)
    for x in range(values.size):
        light = np.float64(lit[x]) - np.float64(under[x])
        value = np.float64(counts[x]) - np.float64(back[x])
        lost = not (light > 0.0 and value == value)
        values[x] = np.nan if lost else value / light * scale[x]
        flag = SATURATED if saturated[x] | white_saturated[x] else np.uint8(0)
        flag |= BLACK if black[x] else np.uint8(0)
        flags[x] = flag | (DEFECT if bad[x] or lost else np.uint8(0))


@njit
def hidden(noise, step):  # type: ignore[no-untyped-def]
    """Return `noise_fit.hidden_rounding` of one value; 0 where the noise shows all of rounding."""
    if not noise < HIDES * step * step:
        return 0.0
    x, total = -4.0 * np.pi**2 * max(noise, 0.0) / (step * step), np.pi**2 / 6
    if x < 0.0:
        total = 0.0
        for k in range(1, 64):
            term = np.exp(x * k * k) / (k * k)
            total += term
            if term < 1e-6:
                break
    return step * step / (2.0 * np.pi**2) * total


@njit
def of_mean(share, signal, measured, freedom, gain, read, step):  # type: ignore[no-untyped-def]
    """Return the variance of a mean, from a stack, the model, or both; `share` of one shot's is left.

    What rounding does to all shots alike is left whole. A variance that was worked out is taken as it is.
    """
    if freedom >= WORKED_OUT:
        return share * measured
    if gain < 0.0:
        return share * measured if freedom > 0.0 else 0.0
    if share == 0.0:
        return 0.0
    model = read + gain * max(signal, 0.0)
    alike = hidden(model - step * step / 12.0, step)
    shown = (freedom * measured + PRIOR * (model - alike)) / (freedom + PRIOR)
    return share * shown + alike


def _shares_of_line(sides: tuple[Side, ...], model: tuple[float, ...]) -> np.ndarray:
    """Return what `fill_shares` gives where dark and white are one line for all rows, else nothing, (3, 0)."""
    _, dark, white, white_dark = sides
    parts = (white.mean, white_dark.mean, white.variance, dark.variance, white_dark.variance)
    shares = np.empty((3, white.mean.shape[1] if all(len(part) == 1 for part in parts) else 0))
    if shares.size:
        fill_shares(0, sides, model, shares)
    return shares


@njit(cache=True)
def fill_shares(y, sides, model, shares):  # type: ignore[no-untyped-def]
    """Fill the variances of the means of white, dark and the white's dark in row `y`, (3, w)."""
    _, dark, white, white_dark = sides
    gain, read, white_read, step = model
    lit, under = row_of(white.mean, y), row_of(white_dark.mean, y)
    of_white, of_dark = row_of(white.variance, y), row_of(dark.variance, y)
    of_under = row_of(white_dark.variance, y)
    for x in range(shares.shape[1]):
        light = np.float64(lit[x]) - np.float64(under[x])
        shares[0, x] = of_mean(
            white.share, light, np.float64(of_white[x]), white.freedom, gain, white_read, step
        )
        shares[1, x] = of_mean(
            dark.share, 0.0, np.float64(of_dark[x]), dark.freedom, gain, read, step
        )
        shares[2, x] = of_mean(
            white_dark.share,
            0.0,
            np.float64(of_under[x]),
            white_dark.freedom,
            gain,
            white_read,
            step,
        )


@njit
def propagate_line(y, sides, table, model, common, shares, variance):  # type: ignore[no-untyped-def]
    """Fill the variance of the values of row `y`; `common` is the correlation of the two darks."""
    shot, dark, white, white_dark = sides
    gain, read, _, step = model
    counts, back, spread = row_of(shot.mean, y), row_of(dark.mean, y), row_of(shot.variance, y)
    lit, under, scale = row_of(white.mean, y), row_of(white_dark.mean, y), row_of(table, y)
    single = gain >= 0.0 and shot.share == 1.0 and shot.freedom == 0.0
    for x in range(variance.size):
        light = np.float64(lit[x]) - np.float64(under[x])
        signal = np.float64(counts[x]) - np.float64(back[x])
        if single:  # all of the model's, whatever rounding hides of it
            own = read + gain * max(signal, 0.0)
        else:
            own = of_mean(shot.share, signal, np.float64(spread[x]), shot.freedom, gain, read, step)
        r = signal / light
        total = own + r * r * (shares[0, x] + shares[2, x]) + shares[1, x]
        total -= 2.0 * r * common * np.sqrt(shares[1, x] * shares[2, x])
        variance[x] = total * (scale[x] / light) ** 2 if light > 0.0 else np.nan


def _widened(array: np.ndarray, width: int) -> np.ndarray:
    """Return a (rows, period) array with its columns repeated to a width, that cannot be written to."""
    period = array.shape[1]
    if period != width:
        array = np.tile(array, (1, -(-width // period)))[:, :width]
    return read_only(np.ascontiguousarray(array))
