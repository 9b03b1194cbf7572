"""Reflectance from arrays: dark, flat field, defects, demosaicing and sigma in one call; a build takes the same steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from math import nan

import numpy as np

from levkas.calibration.clipped_darks import black_clip_of, unclip
from levkas.calibration.codes import SceneShots, find_full_scale, find_step
from levkas.calibration.darks import level_under
from levkas.calibration.defects import find_defects, replace_defects
from levkas.calibration.flatfield import Calibrated, flat_field, require_same_size
from levkas.calibration.lamp import average_steady, require_agreement
from levkas.calibration.mosaic import demosaic
from levkas.calibration.motion import find_moved
from levkas.calibration.noise_fit import NoiseModel, fit_noise_of_frames
from levkas.calibration.patterns import as_pattern, channel_names, channel_table, thin_periods
from levkas.calibration.templates import CalibrationRefused, Template, close_gaps, gaps_of
from levkas.calibration.white_area import WhiteArea, board_alone, find_white_area
from levkas.calibration.whites import WhiteBoard
from levkas.core.cube import Band, Cube, Flag, band_labels
from levkas.core.problems import Problem

ROWS, MOST_VALUES = 20, 1 << 18
"""Rows that are taken together, whole mosaics' of up to 5, and values of a frame by which the full scale is looked for."""

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
        Frames without light; one line applies to all lines (push-broom). A number is the black level, counts, the same in every
        pixel. None: nothing is subtracted.
    white : ndarray or sequence of ndarray like `raw`, optional
        Frames of the white board; one line applies to all lines. None: the result stays in counts.
    reflectance : float or sequence of float, > 0
        Of the white board, relative to the perfect diffuser: one number, or one for each band (each channel of `pattern`).
    exposure_s : (raw, dark, white), optional
        Exposures, s, > 0. None: all are equal.
    pattern : str or rows of channel names, optional
        Of a mosaic, from the top left sensel: ``"RGGB"`` or ``[["B1", "B2"], ["B3", "B4"]]``. The frames are then (h, w), and the
        bands are interpolated after the flat field.
    saturation : float, optional
        Counts at which a sensel is full. Default: the full scale of integers, none for floats. Where integers pile up below it,
        they are full there.
    wavelengths : sequence of float, optional
        Centre of each band, nm; it labels the bands. Default: the names of `pattern`, else 1, 2, …

    Returns
    -------
    cube : Cube
        `values` (h, w, bands), float32: reflectance (1.0 is the perfect diffuser, not clipped to 0–1), or counts above dark without
        a white; NaN where no neighbour of a defect is sound. `flags`: SATURATED, BLACK, DEFECT (replaced from neighbours), OUTSIDE
        (the white shows the object there, not the board), MOVED (several shots disagree), NEAR. `sigma`: one standard deviation of
        the random part, in the unit of the values; None where the noise cannot be estimated.

    Raises
    ------
    CalibrationRefused
        ``E_NO_FRAMES``, ``E_SIZE``, ``E_VALUE``, ``E_EXPOSURES`` or ``E_BAND_COUNT`` where frames or arguments do not fit;
        ``E_WHITE_DARK``, ``E_WHITE_SATURATED``, ``E_WHITE_DETAIL`` where more than half of a white is not above dark, is full, or
        shows the object; ``E_UNLIKE_SHOTS`` where its shots, or those of the object, contradict each other.

    Notes
    -----
    r = (raw − dark)/(white − dark) · t_white/t_raw · reflectance. Noise is estimated from the shots where there are several, else from
    smooth parts of the frames ([immerkaer1996]_, doi:10.1006/cviu.1996.0060); of single shots below some 200 px a side sigma can be
    too small by a factor of 1.6. Bayer patterns are demosaiced as [malvar2004]_ does, doi:10.1109/ICASSP.2004.1326587. The steps are
    those of a build without its marks of glare.

    Examples
    --------
    Half of the light of a board of 98 %:

    >>> import numpy as np
    >>> cube = calibrate(np.full((4, 6), 564), np.full((4, 6), 64), np.full((4, 6), 1064), reflectance=0.98)
    >>> cube.quantity, cube.values.shape, round(float(cube.values[0, 0, 0]), 3)
    ('reflectance', (4, 6, 1), 0.49)
    """
    if pattern is not None and not isinstance(pattern, Sequence):
        raise _refused("E_VALUE", "pattern", pattern, "four letters, or rows of channel names")
    expected = "three positive numbers, s: of raw, dark and white"
    times: Sequence[float | None] = (
        _numbers(exposure_s, "exposure_s", expected, "E_EXPOSURES", 3) or [None] * 3
    )
    full = _numbers(saturation, "saturation", "counts, a positive number", "E_VALUE", 1)
    board, black = _numbers(reflectance, "reflectance", "numbers above 0"), None
    if isinstance(dark, (int, float, np.number)):
        (black,), dark = _numbers(dark, "dark", "a finite black level, counts"), None
    rows = ((None,),) if pattern is None else as_pattern(pattern)
    period = (len(rows), len(rows[0]))
    given = {"raw": raw, "dark": dark, "white": white}
    shots = {name: _shots(some, name) for name, some in given.items() if some is not None}
    full_scale = _full_scale(shots, period[1], full[0] if full else None)
    known = dict(zip(given, times, strict=True))
    made: dict[str, Template] = {}
    for name in sorted(shots):  # the dark is first
        under = made["dark"].mean if "dark" in made else black or 0.0
        level = None if name == "dark" else under
        made[name] = _template(shots, name, level, period, full_scale, known[name])
    shot, lit, darks = made["raw"], made.get("white"), [made["dark"]] if "dark" in made else []
    bands = _bands(shot, pattern, wavelengths)
    require_same_size(shot, {"dark": made.get("dark"), "white": lit})
    step = find_step([*shots["raw"], *shots.get("white", ())])
    if darks:
        with suppress(CalibrationRefused):  # so few codes are above zero that their mean is black
            darks = [unclip(darks[0], shots["dark"][:4], period=period, step=step or 1.0)]
    noise = fit_noise_of_frames(
        [shot], [lit], darks, black=black or 0.0, pattern=pattern, step=step
    )
    area = WhiteArea()
    if lit is not None:
        levels = [level_under(one, darks, black=black) for one in (shot, lit)]
        area = find_white_area(shot, lit, (levels[0], levels[1]), pattern)
    flat = flat_field(
        *(shot, darks, lit),
        board=WhiteBoard(board, pattern, [band.label for band in bands]),
        black=black,
        noise=noise,
        defects=defects_of(darks, lit, pattern, area.uncovered),
    )
    flat = with_marks(flat, (shot, *darks, lit), movement(shot, darks, black, noise, period))
    values, flags, variance = replace_defects(
        flat.values, flat.flags, flat.variance, pattern=pattern
    )
    if pattern is not None:
        values, flags, variance = demosaic(values, flags, variance, pattern)
    deep = (*shot.mean.shape[:2], len(bands))
    values, flags = values.reshape(deep), flags.reshape(deep)
    if area.uncovered is not None:
        lost = area.uncovered[..., None]
        values = np.where(lost, np.float32(np.nan), values)
        flags = np.where(lost, flags | (Flag.OUTSIDE | Flag.DEFECT), flags).astype(np.uint8)
    sigma = None if variance is None else np.sqrt(np.maximum(variance, 0)).reshape(deep)
    return Cube(values, flags, sigma, bands, flat.quantity)


# --- steps that a build takes, too ----------------------------------------------------------------


def defects_of(
    darks: Sequence[Template],
    white: Template | None,
    pattern: Pattern | None,
    uncovered: np.ndarray | None = None,
) -> np.ndarray | None:
    """Return hot sensels of the longest dark and dead ones of the white, where it shows the board; None without either."""
    if not darks and white is None:
        return None
    board = None if white is None else board_alone(white, uncovered)
    return find_defects(darks[-1] if darks else None, board, pattern)


def movement(
    shot: Template,
    darks: Sequence[Template],
    black: float | np.ndarray | None,
    noise: NoiseModel | None,
    period: tuple[int, int],
) -> np.ndarray | None:
    """Return what moved between the object's shots; None where that cannot be measured."""
    if shot.count < 2 or noise is None or noise.source != "temporal":
        return None
    # One number for the dark: a hot sensel's current counts as light, as it does for its noise.
    level = float(np.median(darks[0].mean)) if darks else 0.0 if black is None else black
    return find_moved(shot, noise, level, period=period)


def with_marks(
    flat: Calibrated,
    templates: Sequence[Template | None],
    moved: np.ndarray | None,
    *,
    mended: bool = True,
) -> Calibrated:
    """Flag what moved, and as defects what templates have lost; where the object, the first of them, is absent nothing is.

    Values that are lost are gone unless they will be `mended` from their neighbours.
    """
    values, flags, variance, nothing = flat.values, flat.flags, flat.variance, np.float32(np.nan)
    lost, absent = gaps_of(*templates), templates[0].absent if templates[0] else None
    gone = absent if mended else lost
    if gone is not None:
        values = np.where(gone, nothing, values)
        variance = None if variance is None else np.where(gone, nothing, variance)
    if moved is not None:
        flags = np.where(moved, flags | np.uint8(Flag.MOVED), flags)
    if lost is not None:
        flags = np.where(lost, flags | np.uint8(Flag.DEFECT), flags)
    if absent is not None:
        flags = np.where(absent, np.uint8(Flag.OUTSIDE), flags)
    return replace(flat, values=values, flags=flags, variance=variance)


# --- what was given -------------------------------------------------------------------------------


def _refused(
    code: str, field: str, found: object, expected: str, fix: str | None = None
) -> CalibrationRefused:
    message = f"`{field}` cannot be used"
    return CalibrationRefused(Problem(code, message, None, field, str(found), expected, fix))


def _numbers(
    given: object, name: str, expected: str, code: str = "E_VALUE", count: int | None = None
) -> list[float]:
    """Return what was given as finite floats, of a `count` positive ones; nothing of None. Raises CalibrationRefused where it is something else."""
    if given is None:
        return []
    try:
        numbers = np.atleast_1d(np.asarray(given, float)).ravel()
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    fits = count is None or (len(numbers) == count and bool((numbers > 0).all()))
    if isinstance(given, bool) or not np.isfinite(numbers).all() or not fits:
        raise _refused(code, name, given, expected)
    return [float(number) for number in numbers]


def _shots(frames: Frames, name: str) -> list[np.ndarray]:
    """Return the shots of an argument; raises CalibrationRefused where they are no arrays."""
    given = frames if isinstance(frames, (list, tuple)) else [frames]
    masked = any(isinstance(one, np.ma.MaskedArray) for one in given)
    if masked or not all(hasattr(one, "__array__") for one in given):
        kinds = ", ".join(dict.fromkeys(type(one).__name__ for one in given))
        fix = "Fill masked values with NaN, as floats." if masked else None
        raise _refused("E_VALUE", name, kinds, "an array, or a list of arrays", fix)
    return [np.asarray(one) for one in given]


def _full_scale(
    shots: Mapping[str, list[np.ndarray]], period: int, stated: float | None
) -> float | None:
    """Return the counts at which the frames pile up, where these are below what is stated, else that."""
    whole = {
        name: [
            thin_periods(one, ROWS, MOST_VALUES)
            for one in some[:2]
            if one.ndim > 1 and one.dtype.kind in "ui"
        ]
        for name, some in shots.items()
    }
    lit = [SceneShots(whole[name], name == "white") for name in ("raw", "white") if whole.get(name)]
    found = find_full_scale(lit, whole.get("dark", ()), period=period) if lit else None
    return found.counts if found and (stated is None or found.counts < stated) else stated


def _template(
    shots: Mapping[str, list[np.ndarray]],
    name: str,
    level: np.ndarray | float | None,
    period: tuple[int, int],
    full: float | None,
    exposure_s: float | None,
) -> Template:
    """Average the shots of `name` over `level`, counts, None of darks; one line is repeated for all. Raises CalibrationRefused with the name."""
    some, like = shots[name], shots["raw"][:1]
    if like and like[0].ndim > 1:
        high = len(like[0])
        some = [np.broadcast_to(s, (high, *s.shape[1:])) if len(s) == 1 else s for s in some]
    if full is None and some and some[0].dtype.kind in "ui":
        full = float(np.iinfo(some[0].dtype).max)
    try:
        template = average_steady(
            lambda: some,
            level,
            period=period,
            saturation=full,
            black_clip=black_clip_of(some),
            exposure_s=exposure_s,
            white=name == "white",
        )
        require_agreement(template.shots)
        return close_gaps(template)
    except CalibrationRefused as refused:
        named = (replace(p, message=f"{name}: {p.message}", field=name) for p in refused.problems)
        raise CalibrationRefused(*named) from None


def _bands(
    shot: Template, pattern: Pattern | None, wavelengths: Sequence[float] | None
) -> tuple[Band, ...]:
    """Return the bands of a sensor, labelled by channel, by wavelength, or by their number from 1."""
    shape = shot.mean.shape
    labels = [str(i + 1) for i in range(1 if len(shape) == 2 else shape[2])]
    if pattern is not None:
        labels, size = list(channel_names(pattern)), channel_table(pattern).shape
        if len(shape) != 2 or any(np.less(shape, size)):
            raise _refused("E_SIZE", "raw", shape, f"(height, width), at least {size}")
    if wavelengths is None:
        return tuple(Band(label) for label in labels)
    centres = _numbers(wavelengths, "wavelengths", "numbers, nm")
    if len(centres) != len(labels):
        raise _refused("E_BAND_COUNT", "wavelengths", len(centres), str(len(labels)))
    labels = labels if pattern is not None else band_labels(centres)
    return tuple(Band(label, nm, nan) for label, nm in zip(labels, centres, strict=True))
