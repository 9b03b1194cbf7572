"""Flat field: raw counts to reflectance, on the mosaic, before anything mixes sensels.

r = (S − D)/(W − D′) · tW/tS · Rw, with the dark D of the object's exposure and D′ of the white's. Variance, first order
([jcgm2008]_, Eq. 13, doi:10.59161/JCGM100-2008E), with shares 1/n of the averages and the correlation ρ of the two darks:
u² = [vS/nS + vD/nD + r²(vW/nW + vD′/nD′) − 2 r ρ √(vD/nD · vD′/nD′)]/(W − D′)²; of one dark, ρ = 1, (1 − r)² vD/nD is left.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from levkas.calibration.clipped_darks import unclip_means
from levkas.calibration.darks import MatchedDark, dark_correlation, dark_under, match_dark
from levkas.calibration.findings import Finding, refusal
from levkas.calibration.noise_fit import PRIOR, WORKED_OUT, NoiseModel, hidden_rounding
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
from levkas.core.threads import in_threads

Darks = Template | Sequence[Template] | None


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
    dark: Darks = None,
    white: Template | None = None,
    *,
    board: WhiteBoard = PERFECT,
    black: float | np.ndarray | None = None,
    noise: NoiseModel | None = None,
    defects: np.ndarray | None = None,
) -> Calibrated:
    """Turn an object's raw counts into reflectance, or into counts above dark where there is no white.

    Parameters
    ----------
    shot : Template, (h, w) or (h, w, b)
        The object.
    dark, white : Template, optional
        May be one line high (push-broom). Darks may be of several exposures, see `darks.match_dark`.
    board : WhiteBoard, optional
        Reflectance of the white, and the channels it is checked in; or the unit of files of reflectance.
    black : float or ndarray like `shot.mean`, optional
        Black level in counts; subtracted where there is no dark. None: not known. Nothing is subtracted from a shot or a
        white that is above dark.
    noise : NoiseModel, optional
        Without it noise is that of the stacks. Where both are there, the variance of n shots weighs n − 1 against 60 of the
        model: two shots alone give a sigma that is of no use.
    defects : ndarray of bool like `shot.mean`, optional
        Pixels to flag as DEFECT.

    Returns
    -------
    calibrated : Calibrated
        SATURATED where a shot of the object or of the white was, BLACK where one of the object was clipped, DEFECT where
        white is not above dark. Values are not clipped to 0–1.

    Raises
    ------
    CalibrationRefused
        E_SIZE, E_VALUE; E_EXPOSURES as `require_dark`; E_WHITE_DARK where white is darker than dark, E_WHITE_SATURATED where
        it is saturated, over more than half of any channel.

    Examples
    --------
    >>> from levkas.calibration.templates import average
    >>> S, D, W = (average([np.full((1, 2), v)]) for v in (30.0, 10.0, 50.0))
    >>> flat_field(S, D, W, board=WhiteBoard(0.98)).values.tolist()
    [[0.49..., 0.49...]]
    """
    darks = [dark] if isinstance(dark, Template) else list(dark or ())
    named = {"dark" if i == 0 else f"dark {i + 1}": one for i, one in enumerate(darks)}
    require_same_size(shot, {**named, "white": white, "defects": defects})
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
        more = {"gain": noise.gain, "read_variance": read, "step": noise.step or 1.0}
        shot = unclip_means(shot, under.level, **more)
    width = as_rows(shot.mean).shape[1]
    scale = reflectance_table(board, shot) * ratio
    if white is None:
        unit = 1.0 if board.unit is None else np.asarray(board.unit)
        of_unit = replace(board, reflectance=1 / np.asarray(unit, float), pattern=None)
        scale = reflectance_table(of_unit, shot)
        lit, lit_saturated = _side(np.ones((1, 1)), None, 0.0, 0.0, width), np.zeros((1, 1), bool)
    else:
        if not board.checked:
            check_white(white, white_under.mean, board.pattern, board.labels)
        lit, lit_saturated = _of_shots(white, width), white.saturated
    sides = (_of_shots(shot, width), _of_dark(under, width), lit, _of_dark(white_under, width))
    bad = under.saturated if defects is None else defects | under.saturated
    marks = tuple(
        _wide(as_marks(m), width) for m in (shot.saturated, lit_saturated, shot.black, bad)
    )
    model = (-1.0, 0.0, 0.0, 0.0)
    if noise is not None:
        model = (noise.gain, noise.read_under(under), noise.read_under(white_under), noise.step)
    known = noise is not None or all(side.freedom > 0 or side.share == 0 for side in sides)
    size = (len(shot.mean), width)
    values, flags = np.empty(size, np.float32), np.empty(size, np.uint8)
    variance = np.empty(size if known else (0, 0), np.float32)
    numbers = (*map(float, model), dark_correlation(under, white_under))
    inputs = (sides, marks, _wide(np.asarray(scale, np.float64), width), numbers)
    in_threads(_flatten, size[0], inputs, values, flags, variance, worth=values.size)
    made, marked = values.reshape(shot.mean.shape), flags.reshape(shot.mean.shape)
    quantity = "counts" if white is None and board.unit is None else "reflectance"
    spread = variance.reshape(shot.mean.shape) if known else None
    return Calibrated(made, marked, spread, quantity, notes)


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

    Arrays are (h or 1, w); one line applies to all rows.
    """

    mean: np.ndarray
    variance: np.ndarray
    freedom: float
    share: float


def _side(
    mean: np.ndarray, variance: np.ndarray | None, freedom: float, share: float, width: int
) -> Side:
    spread = np.zeros((1, 1), np.float32) if variance is None else as_rows(variance)
    known = 0.0 if variance is None else float(freedom)
    return Side(_wide(as_rows(mean), width), _wide(spread, width), known, float(share))


def _of_shots(shots: Template, width: int) -> Side:
    """Return the side of an average; a merged exposure series is one "shot" whose variance was worked out, not sampled."""
    freedom = shots.count - 1.0 if shots.count > 1 else WORKED_OUT
    return _side(shots.mean, shots.variance, freedom, 1.0 / shots.count, width)


def _of_dark(dark: MatchedDark, width: int) -> Side:
    freedom = WORKED_OUT if dark.worked_out else max(dark.count - 1.0, 0.0)
    return _side(dark.mean, dark.variance, freedom, dark.share, width)


def _wide(array: np.ndarray, width: int) -> np.ndarray:
    """Return a (rows, period) array with its columns repeated to a width, that cannot be written to."""
    if array.shape[1] != width:
        array = np.tile(array, (1, -(-width // array.shape[1])))[:, :width]
    return read_only(np.ascontiguousarray(array))


def pair_darks(
    shot: Template,
    dark: Darks,
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
    """Refuse a dark of another time whose black level is unknown where its dark current may exceed the noise of one shot.

    The current of a dark of time tD is at most all of its counts, and at most read²/gain, for it has shot noise: of a frame
    of time t it is wrong by up to that times t/tD − 1. Without a model the noise is taken for one count. `lit` says that the
    frame is a white, whose light has noise too; else its darkest pixels are judged.

    Raises CalibrationRefused, E_EXPOSURES.

    Examples
    --------
    A dark of 0.1 s under a frame of 0.4 s, noise of 2 counts: 16 counts of current, or 48.

    >>> none = np.zeros((1, 1), bool)
    >>> dark, frame = (Template(np.full((1, 1), 64, "f4"), None, 1, none, none, t) for t in (0.1, 0.4))
    >>> require_dark(frame, match_dark(dark, 0.4), NoiseModel(0.25, 4.0))
    Traceback (most recent call last):
    levkas.calibration.findings.CalibrationRefused: ...
    """
    level, variance = under.level, 1.0
    current = max(level, 0.0)
    if noise is not None:
        variance = noise.read_variance
        current = min(current, variance / max(noise.gain, 1e-12))
        variance += noise.gain * max(frame.level - level, 0.0) * lit
    wrong, sigma = abs(under.stretch) * current, float(np.sqrt(variance))
    if not under.stretch or wrong <= sigma:
        return
    raise refusal("dark_time", f"{sigma:.2g}", wrong, frame.exposure_s or 0.0)


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


def require_same_size(shot: Template, others: Mapping[str, Template | np.ndarray | None]) -> None:
    """Refuse what is of another size than the object, one line high or not, all at once, by name; raises CalibrationRefused, E_SIZE."""
    height, *rest = shot.mean.shape
    shapes = {
        name: one.shape if isinstance(one, np.ndarray) else one.mean.shape
        for name, one in others.items()
        if one is not None
    }
    problems = [
        Finding("size", name, found=str(shape), expected=str(shot.mean.shape)).problem()
        for name, shape in shapes.items()
        if list(shape[1:]) != rest or shape[0] not in (1, height)
    ]
    if problems:
        raise CalibrationRefused(*problems)


SATURATED, BLACK, DEFECT = (np.uint8(f.value) for f in (Flag.SATURATED, Flag.BLACK, Flag.DEFECT))


@njit(cache=True)
def _flatten(start, stop, inputs, values, flags, variance):  # type: ignore[no-untyped-def]
    """Fill rows `start` to `stop` of values (shot − dark)/(white − white_dark) · scale, flags and variance, (h, w).

    `inputs` are the `Side` of shot, dark, white and the white's dark; marks of a saturated shot and white, of black and bad
    pixels; the scale, (rows, w), repeated over the rows; gain (below 0: no model), variances without light of object and
    white, step, and the correlation of the two darks. No variance is worked out where its size is 0.
    """
    (shot, dark, white, other), (saturated, lit_saturated, black, bad), scale, model = inputs
    gain, read, white_read, step, common = model
    dim, white_dim = _model(0.0, gain, read, step), _model(0.0, gain, white_read, step)
    once = len(white.mean) == len(other.mean) == len(dark.variance) == 1
    once &= len(white.variance) == len(other.variance) == 1
    shares = np.empty((3, variance.shape[1]))  # of templates of one line the same in all rows
    for y in range(start, stop):
        counts, back = _row(shot.mean, y), _row(dark.mean, y)
        lit, under, factor = _row(white.mean, y), _row(other.mean, y), _row(scale, y)
        full, lit_full = _row(saturated, y), _row(lit_saturated, y)
        clipped, unsound = _row(black, y), _row(bad, y)
        of_shot, of_dark = _row(shot.variance, y), _row(dark.variance, y)
        of_white, of_other = _row(white.variance, y), _row(other.variance, y)
        for x in range(values.shape[1]):
            light = np.float64(lit[x]) - np.float64(under[x])
            signal = np.float64(counts[x]) - np.float64(back[x])
            lost = not (light > 0.0 and signal == signal)
            values[y, x] = np.nan if lost else signal / light * factor[x]
            flag = SATURATED if full[x] | lit_full[x] else np.uint8(0)
            flag |= BLACK if clipped[x] else np.uint8(0)
            flags[y, x] = flag | (DEFECT if unsound[x] or lost else np.uint8(0))
        for x in range(variance.shape[1]):
            light = np.float64(lit[x]) - np.float64(under[x])
            signal = np.float64(counts[x]) - np.float64(back[x])
            r = signal / light
            own = _of_mean(shot, of_shot[x], _model(signal, gain, read, step))
            if once and y > start:
                of_lit, below, beside = shares[0, x], shares[1, x], shares[2, x]
            else:
                of_lit = _of_mean(white, of_white[x], _model(light, gain, white_read, step))
                below = _of_mean(dark, of_dark[x], dim)
                beside = _of_mean(other, of_other[x], white_dim)
                shares[0, x], shares[1, x], shares[2, x] = of_lit, below, beside
            total = own + below + r * r * (of_lit + beside)
            total -= 2.0 * r * common * np.sqrt(below * beside)
            variance[y, x] = total * (factor[x] / light) ** 2 if light > 0.0 else np.nan


@njit
def _row(array, y):  # type: ignore[no-untyped-def]
    """Return a row of an array whose rows are repeated."""
    return array[y % array.shape[0]]


@njit
def _model(signal, gain, read, step):  # type: ignore[no-untyped-def]
    """Return the variance of one shot, and what of it rounding does to all shots alike; −1 without a model."""
    if gain < 0.0:
        return -1.0, 0.0
    model = read + gain * max(signal, 0.0)
    return model, hidden_rounding(model - step * step / 12.0, step)


@njit
def _of_mean(side, measured, expected):  # type: ignore[no-untyped-def]
    """Return the variance of a side's mean, from a stack, the model, or both; one that was worked out is taken as it is."""
    (model, alike), share, freedom = expected, side.share, side.freedom
    if freedom >= WORKED_OUT:
        return share * measured
    if model < 0.0:
        return share * measured if freedom > 0.0 else 0.0
    if share == 0.0:
        return 0.0
    return share * (freedom * measured + PRIOR * (model - alike)) / (freedom + PRIOR) + alike
