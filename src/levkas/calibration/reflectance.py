"""Reflectance from arrays: dark, flat field, defects, demosaicing and sigma in one call."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import nan
from typing import TYPE_CHECKING

import numpy as np

from levkas.calibration.clipped_darks import black_clip_of
from levkas.calibration.lamp import average_steady, require_agreement
from levkas.calibration.patterns import as_pattern
from levkas.calibration.templates import CalibrationRefused, Template, close_gaps, gaps_of
from levkas.core.cube import Band, Cube, Flag, band_labels
from levkas.core.problems import Problem

ROWS, MOST_VALUES = 20, 1 << 18
"""Rows that are taken together, whole mosaics' of up to 5, and values of a frame by which the full scale is looked for."""

if TYPE_CHECKING:
    from levkas.calibration.flatfield import Calibrated
    from levkas.calibration.noise_fit import NoiseModel

    Frames = np.ndarray | Sequence[np.ndarray]
    """Of one or more shots."""
    Pattern = str | Sequence[Sequence[str]]


def calibrate(
    raw: Frames,
    dark: Frames | float | None = None,
    white: Frames | None = None,
    *,
    reflectance: float | Sequence[float] = 1.0,
    exposure_s: tuple[float, float, float] | None = None,
    pattern: Pattern | None = None,
    saturation: float | None = None,
    wavelengths: Sequence[float] | None = None,
) -> Cube:
    """Turn raw frames of one sensor into reflectance with flags and sigma.

    Parameters
    ----------
    raw : ndarray, (h, w) or (h, w, bands), or sequence of them
        Counts of the object as the sensor recorded them; a sequence holds several shots of one exposure.
    dark : ndarray or sequence of ndarray like `raw`, or float, optional
        Frames without light; one line applies to all lines (push-broom). A number is the black level,
        counts, the same in every pixel. None: nothing is subtracted.
    white : ndarray or sequence of ndarray like `raw`, optional
        Frames of the white board; one line applies to all lines. None: the result stays in counts.
    reflectance : float or sequence of float, > 0
        Of the white board, relative to the perfect diffuser: one number, or one for each band (each channel of
        `pattern`).
    exposure_s : (raw, dark, white), optional
        Exposures, s, > 0. None: all are equal.
    pattern : str or rows of channel names, optional
        Of a mosaic, from the top left sensel: ``"RGGB"`` or ``[["B1", "B2"], ["B3", "B4"]]``. The
        frames are then (h, w), and the bands are interpolated after the flat field.
    saturation : float, optional
        Counts at which a sensel is full. Default: the full scale of integers, none for floats. Where integers pile up
        below it, they are full there.
    wavelengths : sequence of float, optional
        Centre of each band, nm; it labels the bands. Default: the names of `pattern`, else 1, 2, …

    Returns
    -------
    cube : Cube
        `values` (h, w, bands), float32: reflectance (1.0 is the perfect diffuser, not clipped to 0–1), or
        counts above dark without a white; NaN where no neighbour of a defect is sound. `flags`: SATURATED,
        BLACK, DEFECT (replaced from neighbours), OUTSIDE (the white shows the object there, not the board), MOVED (several shots disagree), NEAR. `sigma`: one standard
        deviation of the random part, in the unit of the values; None where the noise cannot be estimated.

    Raises
    ------
    CalibrationRefused
        ``E_NO_FRAMES``, ``E_SIZE``, ``E_VALUE``, ``E_EXPOSURES`` or ``E_BAND_COUNT`` where frames or
        arguments do not fit; ``E_WHITE_DARK``, ``E_WHITE_SATURATED``, ``E_WHITE_DETAIL`` where more than half of a
        white is not above dark, is full, or shows the object; ``E_UNLIKE_SHOTS`` where its shots, or those of
        the object, contradict each other.

    Notes
    -----
    r = (raw − dark)/(white − dark) · t_white/t_raw · reflectance. Noise is estimated from the shots where there are
    several, else from smooth parts of the frames ([immerkaer1996]_, doi:10.1006/cviu.1996.0060); of single shots below some
    200 px a side sigma can be too small by a factor of 1.6. Bayer patterns are demosaiced as [malvar2004]_ does,
    doi:10.1109/ICASSP.2004.1326587. The steps are those of a build without its marks of glare.

    Examples
    --------
    Half of the light of a board of 98 %:

    >>> import numpy as np
    >>> cube = calibrate(np.full((4, 6), 564), np.full((4, 6), 64), np.full((4, 6), 1064), reflectance=0.98)
    >>> cube.quantity, cube.values.shape, round(float(cube.values[0, 0, 0]), 3)
    ('reflectance', (4, 6, 1), 0.49)
    """
    from levkas.calibration.codes import find_step
    from levkas.calibration.defects import find_defects, replace_defects
    from levkas.calibration.flatfield import flat_field
    from levkas.calibration.mosaic import demosaic
    from levkas.calibration.white_area import WhiteArea, board_alone, find_white_area
    from levkas.calibration.whites import WhiteBoard

    times = _times(exposure_s)
    if saturation is not None:
        saturation = float(_numbers(saturation, "saturation", "counts, a number")[0])
    saturation = _full_scale(raw, dark, white, pattern, saturation)
    board = WhiteBoard(_numbers(reflectance, "reflectance", "numbers above 0"), pattern)
    under, black = None, None
    if isinstance(dark, (int, float, np.number)):
        black = float(_numbers(dark, "dark", "a finite black level, counts")[0])
    elif dark is not None:
        under, shots = _template(dark, "dark", saturation, times[1], None, pattern)
    level = (black or 0.0) if under is None else under.mean
    shot, codes = _template(raw, "raw", saturation, times[0], level, pattern)
    lit = None
    if white is not None:
        lit, white_codes = _template(white, "white", saturation, times[2], level, pattern)
        lit, codes = _as_high(lit, shot), [*codes, *white_codes]
    step = find_step(codes)
    if under is not None:
        under = _as_high(_unclipped(under, shots, pattern, step), shot)
    bands = _bands(shot, pattern, wavelengths)
    _check_shapes(shot, {"dark": under, "white": lit})
    noise = _noise(shot, lit, under, black or 0.0, pattern, step)
    defects = gaps_of(shot, under, lit)
    area = WhiteArea()
    if lit is not None:
        plane = np.full((1, 1), black or 0.0, np.float32) if under is None else under.mean
        area = find_white_area(shot, lit, (plane, plane), pattern)
    uncovered = area.uncovered
    if under is not None or lit is not None:
        covered = None if lit is None else board_alone(lit, uncovered)
        found = find_defects(under, covered, pattern)
        defects = found if defects is None else found | defects
    board = replace(board, labels=[band.label for band in bands])
    flat = flat_field(shot, under, lit, board=board, black=black, noise=noise, defects=defects)
    flags = _with_moved(flat, shot, under, black or 0.0, noise, pattern)
    values, flags, variance = replace_defects(flat.values, flags, flat.variance, pattern=pattern)
    if pattern is not None:
        values, flags, variance = demosaic(values, flags, variance, pattern)
    deep = (*shot.mean.shape[:2], len(bands))
    values, flags = values.reshape(deep), flags.reshape(deep)
    if uncovered is not None:
        lost = uncovered[..., None]
        values = np.where(lost, np.float32(np.nan), values)
        flags = np.where(lost, flags | (Flag.OUTSIDE | Flag.DEFECT), flags).astype(np.uint8)
    sigma = None if variance is None else np.sqrt(np.maximum(variance, 0)).reshape(deep)
    return Cube(values, flags, sigma, bands, flat.quantity)


def _template(
    frames: Frames,
    name: str,
    saturation: float | None,
    exposure_s: float | None,
    level: np.ndarray | float | None,
    pattern: Pattern | None,
) -> tuple[Template, list[np.ndarray]]:
    """Average the shots of `name` over `level`, counts, None of darks; return them too.

    Raises CalibrationRefused with the argument's name.
    """
    given = frames if isinstance(frames, (list, tuple)) else [frames]
    shots = [np.asarray(one) for one in given if hasattr(one, "__array__")]
    masked = any(isinstance(one, np.ma.MaskedArray) for one in given)
    if len(shots) < len(given) or masked:
        kinds = ", ".join(dict.fromkeys(type(one).__name__ for one in given))
        fix = "Fill masked values with NaN, as floats." if masked else None
        raise _refused(
            "E_VALUE", name, f"{name} holds no arrays", kinds, "an array, or a list of arrays", fix
        )
    if saturation is None and shots and shots[0].dtype.kind in "ui":
        saturation = float(np.iinfo(shots[0].dtype).max)
    rows = as_pattern(pattern) if isinstance(pattern, Sequence) else ((None,),)
    try:
        template = average_steady(
            lambda: shots,
            level,
            period=(len(rows), len(rows[0])),
            saturation=saturation,
            black_clip=black_clip_of(shots),
            exposure_s=exposure_s,
            white=name == "white",
        )
        require_agreement(template.shots)
        template = close_gaps(template)
    except CalibrationRefused as refused:
        problems = (
            replace(p, message=f"{name}: {p.message}", field=name) for p in refused.problems
        )
        raise CalibrationRefused(*problems) from None
    return template, shots


def _full_scale(
    raw: Frames,
    dark: Frames | float | None,
    white: Frames | None,
    pattern: Pattern | None,
    stated: float | None,
) -> float | None:
    """Return the counts at which the frames pile up, where these are below what is stated, else that."""
    from levkas.calibration.codes import SceneShots, find_full_scale
    from levkas.calibration.patterns import channel_table, thin_periods

    def planes(frames: Frames | float | None) -> list[np.ndarray]:
        given = frames if isinstance(frames, (list, tuple)) else [frames]
        shots = [one for one in given[:2] if isinstance(one, np.ndarray) and one.ndim > 1]
        return [thin_periods(one, ROWS, MOST_VALUES) for one in shots if one.dtype.kind in "ui"]

    lit = [
        SceneShots(some, even)
        for some, even in ((planes(raw), False), (planes(white), True))
        if some
    ]
    period = int(channel_table(pattern).shape[1]) if isinstance(pattern, Sequence) else 1
    found = find_full_scale(lit, planes(dark), period=period) if lit else None
    return found.counts if found and (stated is None or found.counts < stated) else stated


def _unclipped(
    dark: Template, shots: list[np.ndarray], pattern: Pattern | None, step: float
) -> Template:
    """Return a dark of some shots; where they were clipped at zero, as if they had not been."""
    from levkas.calibration.clipped_darks import unclip
    from levkas.calibration.patterns import channel_table

    period = (1, 1) if pattern is None else channel_table(pattern).shape[:2]
    try:
        return unclip(dark, shots[:4], period=(period[0], period[1]), step=step or 1.0)
    except CalibrationRefused:
        return dark  # so few codes are above zero that their mean is next to black


def _as_high(template: Template, shot: Template) -> Template:
    """Return a template of one line repeated for all lines of the shot; others as they are."""
    if len(template.mean) > 1 or len(shot.mean) == 1:
        return template
    shape = (len(shot.mean), *template.mean.shape[1:])
    names = ("mean", "variance", "saturated", "black", "lost")
    arrays = {name: getattr(template, name) for name in names}
    high = {k: np.broadcast_to(a, shape).copy() for k, a in arrays.items() if a is not None}
    fit = template.fit
    if fit is not None:
        fit = fit._replace(variance=np.broadcast_to(fit.variance, shape))
    return replace(template, fit=fit, **high)  # type: ignore[arg-type]


def _times(exposure_s: tuple[float, float, float] | None) -> tuple[float | None, ...]:
    if exposure_s is None:
        return (None, None, None)
    expected = "three positive numbers, s: of raw, dark and white"
    times = _numbers(exposure_s, "exposure_s", expected, "E_EXPOSURES")
    if times.shape != (3,) or not np.all(times > 0):
        raise _refused(
            "E_EXPOSURES", "exposure_s", "the exposures cannot be used", exposure_s, expected
        )
    return tuple(times.tolist())


def _numbers(given: object, name: str, expected: str, code: str = "E_VALUE") -> np.ndarray:
    """Return what was given as finite floats, (n,); raises CalibrationRefused where it is something else."""
    try:
        numbers = np.atleast_1d(np.asarray(given, float)).ravel()
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    if isinstance(given, bool) or not np.isfinite(numbers).all():
        raise _refused(code, name, f"`{name}` cannot be used", given, expected)
    return numbers


def _refused(
    code: str, field: str, message: str, found: object, expected: str, fix: str | None = None
) -> CalibrationRefused:
    return CalibrationRefused(Problem(code, message, None, field, str(found), expected, fix))


def _bands(
    shot: Template, pattern: Pattern | None, wavelengths: Sequence[float] | None
) -> tuple[Band, ...]:
    """Return the bands of a sensor, labelled by channel, by wavelength, or by their number from 1."""
    from levkas.calibration.patterns import channel_names, channel_table

    if pattern is not None:
        if not isinstance(pattern, Sequence):
            expected = "four letters, or rows of channel names"
            raise _refused("E_VALUE", "pattern", "`pattern` cannot be used", pattern, expected)
        labels, size = list(channel_names(pattern)), channel_table(pattern).shape
        if shot.mean.ndim != 2 or any(np.less(shot.mean.shape, size)):
            expected = f"(height, width), at least {size}"
            raise _refused(
                "E_SIZE", "raw", "the frame does not fit its pattern", shot.mean.shape, expected
            )
    else:
        labels = [str(i + 1) for i in range(1 if shot.mean.ndim == 2 else shot.mean.shape[2])]
    if wavelengths is None:
        return tuple(Band(label) for label in labels)
    centres = _numbers(wavelengths, "wavelengths", "numbers, nm").tolist()
    if len(centres) != len(labels):
        message, expected = "the wavelengths do not fit the bands", str(len(labels))
        raise _refused("E_BAND_COUNT", "wavelengths", message, len(centres), expected)
    labels = labels if pattern is not None else band_labels(centres)
    return tuple(Band(label, nm, nan) for label, nm in zip(labels, centres, strict=True))


def _check_shapes(shot: Template, others: dict[str, Template | None]) -> None:
    """Refuse templates of another size than the object's frames, all at once."""
    problems = [
        Problem(
            "E_SIZE",
            f"{name} and raw are of different sizes",
            field=name,
            found=str(template.mean.shape),
            expected=str(shot.mean.shape),
            fix="Give frames of one sensor in one mode.",
        )
        for name, template in others.items()
        if template is not None and template.mean.shape != shot.mean.shape
    ]
    if problems:
        raise CalibrationRefused(*problems)


def _noise(
    shot: Template,
    white: Template | None,
    dark: Template | None,
    black: float,
    pattern: Pattern | None,
    step: float,
) -> NoiseModel | None:
    """Estimate the noise of the sensor; the bands of a cube count as phases of a mosaic of one row."""
    from levkas.calibration.noise_fit import fit_noise_of_frames

    if shot.mean.ndim == 3:
        pattern = [[str(i) for i in range(shot.mean.shape[2])]]
    darks = [] if dark is None else [_interleaved(dark)]
    whites = [None if white is None else _interleaved(white)]
    return fit_noise_of_frames(
        *([_interleaved(shot)], whites, darks), black=black, pattern=pattern, step=step
    )


def _interleaved(template: Template) -> Template:
    """Return a template (h, w, bands) as (h, w·bands)."""
    if template.mean.ndim == 2:
        return template
    names = ("mean", "variance", "saturated", "black")
    arrays = {name: getattr(template, name) for name in names}
    flat = {k: a.reshape(len(a), -1) for k, a in arrays.items() if a is not None}
    fit = template.fit
    if fit is not None:
        fit = fit._replace(variance=fit.variance.reshape(len(fit.variance), -1))
    return replace(template, lost=None, fit=fit, **flat)


def _with_moved(
    flat: Calibrated,
    shot: Template,
    dark: Template | None,
    black: float,
    noise: NoiseModel | None,
    pattern: Pattern | None,
) -> np.ndarray:
    """Return the flags with MOVED where the shots of the object disagree by more than their noise."""
    from levkas.calibration.motion import find_moved

    if shot.count < 2 or noise is None or noise.source != "temporal":
        return flat.flags
    rows = ((None,),) if pattern is None else as_pattern(pattern)
    level = black if dark is None else float(np.median(dark.mean))
    moved = find_moved(shot, noise, level, period=(len(rows), len(rows[0])))
    return np.where(moved, flat.flags | np.uint8(Flag.MOVED), flat.flags).astype(np.uint8)
