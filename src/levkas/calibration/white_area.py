"""Area of the white board in its frame: where the frame shows the object instead, and edges that no board has.

A white is smooth. Where it has the detail of the object, at the scale of several sensels and with a good part of
its contrast, the board was not there: the quotient would be 1. What sensor and lens give to every frame (response of
single sensels, dust, vignetting) is finer, fainter or rarer than that, and an object without detail shows nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from levkas.calibration.patterns import channel_table
from levkas.calibration.templates import CalibrationRefused, Template
from levkas.core.problems import Problem
from levkas.core.threads import each

MOST_PIXELS = 1_000_000  # of a frame that are looked at: larger ones are reduced
SIDE, BLOCKS = 16, 10  # px of a block; blocks a side that a small frame has at least
SHOWN = 0.015  # rms of the white's own detail, relative: boards have less, paintings 5 to 20 %
FIXED = 0.02  # the most of it that a sensor gives to every frame: dust all over, fringes
ABOVE = 2.5  # times what the whole white has, its lower tenth
DETAILED = 0.01  # rms of the object's detail, relative, that lets a white be judged
ALIKE, UNLIKE = 0.6, 0.3  # correlation of the two where the white shows the object, and the board
CONTRAST = 0.25  # share of the object's contrast that the white shows at least
LEAST, FEWEST = 0.02, 6  # share of the frame, and blocks together: dust has less
MOST = 0.5  # share of the frame beyond which the white is none
STEP, NOISE = 0.03, 5.0  # of an edge, relative; and over the detail that the whole white has
EDGE, OTHER = (
    2,
    0.05,
)  # px at each side whose lines may respond otherwise, and by how much at least, relative
LINES, BRIGHT = 16, 0.2  # lines that show what moves; share of the brightest band that a band has
MOVING, USUAL = 0.05, 4.0  # rms along the scan, relative; and over that of the steadier samples
LONG = 0.25  # of the frame's shorter side: a scratch or a hair is shorter
FINE, FIELDS = (
    (1.0, 4.0),
    (4.0, 16.0),
)  # px: of texture and dust; of painted fields and blurred ones
SMALL = 150  # px of the shorter side of a frame below which its fields are smaller too
STRUCTURE, MUCH = 0.05, 0.5  # rms of a block, and share of blocks that have it, of a picture


class WhiteArea(NamedTuple):
    """Where a white frame does not show the board.

    Parameters
    ----------
    uncovered : ndarray, (h, w), bool, or None
        Where it shows the object; None where it does so nowhere.
    """

    uncovered: np.ndarray | None = None
    notes: tuple[str, ...] = ()

    def at(self, rows: np.ndarray, columns: np.ndarray) -> WhiteArea:
        """Return the area of a larger frame; `rows` and `columns` are where each of its own is in this one."""
        if self.uncovered is None:
            return self
        uncovered = self.uncovered[np.ix_(rows, columns)]
        return WhiteArea(uncovered, (_note(uncovered), *self.notes[1:]))


def find_white_area(
    shot: Template,
    white: Template,
    levels: tuple[np.ndarray, np.ndarray],
    pattern: str | Sequence[Sequence[str]] | None = None,
    *,
    spacing: int = 1,
) -> WhiteArea:
    """Find where a white frame shows the object in place of the board.

    Raises CalibrationRefused, ``E_WHITE_DETAIL`` where the object is in more than half of the white, or the white is a picture
    of something else.

    Parameters
    ----------
    shot, white : Template, (h, w) or (h, w, b)
        The bands of a cube are averaged.
    levels : (ndarray, ndarray) that broadcast to them
        Counts without light of each.
    pattern : str or rows of names, optional
        Of a mosaic: its periods are averaged.
    spacing : int
        Of a frame of which only every so-many-th pixel a side is given.

    Returns
    -------
    area : WhiteArea
        Blocks in which the object has no detail are given to the nearest that is decided.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> paint = np.kron(rng.uniform(0.2, 0.9, (40, 50)), np.ones((4, 4)))
    >>> board = np.where(np.arange(200) < 60, paint, 1.0)
    >>> none = np.zeros((160, 200), bool)
    >>> object, white = (Template((1000 * p).astype("f4"), None, 1, none, none) for p in (paint, board))
    >>> found = find_white_area(object, white, (np.zeros((1, 1)), np.zeros((1, 1))))
    >>> bool(found.uncovered[:, :60].all()), bool(found.uncovered[:, 100:].any())
    (True, False)
    """
    period = (1, 1) if pattern is None else channel_table(pattern).shape
    size = (shot.mean.shape[0], shot.mean.shape[1])
    reduced = _reduced_size(size, period)
    if white.mean.shape != shot.mean.shape or min(reduced) < BLOCKS * 3:
        return WhiteArea()
    scene, lit = (
        _reduced(_plane(template.mean - level), reduced)
        for template, level in ((shot, levels[0]), (white, levels[1]))
    )
    full = _reduced(_plane((shot.saturated | white.saturated).astype(np.float32)), reduced) > 0
    sound = (scene > 0) & (lit > 0) & ~full
    inside = _inside(lit)
    sound &= inside
    scene, lit = (_grown_over(plane, inside) for plane in (scene, lit))
    of_object, of_white = each(partial(_detail, scale=FINE), (scene, lit))
    side = max(3, min(SIDE, min(reduced) // BLOCKS))
    state = _state(_blocks(of_object, of_white, sound, side))
    uncovered = _grown(state) if np.any(state > 0) else np.zeros_like(state, bool)
    share = float(uncovered.mean())
    if share > MOST:
        raise CalibrationRefused(_shows_object(share))
    mask, notes = None, list[str]()
    whole = (size[0] * spacing, size[1] * spacing)
    if share < LEAST:
        notes += _note_edges(_edges(of_white, sound), whole)
    else:
        mask = _at_size(uncovered, side, reduced, size)
        notes.append(_note(mask))
        sound &= ~_at_size(uncovered, side, reduced, reduced)
    if sound.mean() > MOST and (picture := _picture_in(scene, lit, sound)):
        brighter = float(np.median(scene[sound] / lit[sound])) > 1
        raise CalibrationRefused(_shows_a_picture(picture.rms, picture.smooth and brighter))
    return WhiteArea(mask, tuple(notes))


def board_alone(white: Template, uncovered: np.ndarray | None) -> Template:
    """Return a white with one level where it does not show the board, so that nothing there looks like a defect."""
    if uncovered is None:
        return white
    level = np.float32(np.median(white.mean[~uncovered]))
    lost = uncovered if white.mean.ndim == 2 else uncovered[..., None]
    return replace(white, mean=np.where(lost, level, white.mean))


def joined_area(areas: Sequence[WhiteArea]) -> WhiteArea:
    """Return what some bands of one white show together: paint that one of them does not see is another's detail."""
    masks = [area.uncovered for area in areas if area.uncovered is not None]
    if masks:
        mask = np.logical_or.reduce(masks)
        return WhiteArea(mask, (_note(mask),))
    return max(areas, key=lambda area: len(area.notes), default=WhiteArea())


def find_white_line(white: Template, level: np.ndarray) -> WhiteArea:
    """Find where the white line of a push-broom camera shows something that moves along the scan.

    Raises CalibrationRefused, ``E_WHITE_DETAIL`` where more than half of the samples show it.

    Parameters
    ----------
    white : Template, (1, samples, bands)
        Average of lines, with its variance.
    level : ndarray that broadcasts to it
        Counts without light.

    Returns
    -------
    area : WhiteArea
        `uncovered` is (1, samples).

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> lines = rng.normal(1000, 20, (80, 60, 5))
    >>> lines[:, :15] *= rng.uniform(0.3, 1, (80, 15, 1))
    >>> from levkas.calibration.templates import average
    >>> found = find_white_line(average(lines[:, None]), np.zeros((1, 1, 1)))
    >>> np.flatnonzero(found.uncovered[0]).tolist() == list(range(15))
    True
    """
    light = (white.mean - level)[0].astype(np.float64)
    if white.variance is None or white.count < LINES or len(light) < 3:
        return WhiteArea()
    middle = np.median(light, axis=0)
    if middle.max() <= 0:  # no light, which is refused where it is divided by
        return WhiteArea()
    bright = middle > BRIGHT * middle.max()
    relative = np.sqrt(white.variance[0][:, bright]) / np.maximum(light[:, bright], 1e-9)
    spread = np.median(relative, axis=1)
    moving = spread > max(MOVING, USUAL * float(np.quantile(spread, 0.25)))
    run = max(3, len(light) // 100)
    parts = _large(moving[None], run)
    share = float(parts.mean())
    if share > MOST:
        raise CalibrationRefused(_shows_object(share))
    return WhiteArea(parts, (_note(parts),)) if parts.any() else WhiteArea()


class _Picture(NamedTuple):
    """Relative rms of a white that is a picture, and whether the object has far less detail."""

    rms: float
    smooth: bool


def _picture_in(scene: np.ndarray, lit: np.ndarray, sound: np.ndarray) -> _Picture | None:
    """Return what most blocks of a white show at the scale of painted fields and the object does not; None of a board.

    White and object are products of light, sensor and what they show. With their relative details w and s, detail of
    the sensor is in both, and ⟨w²⟩ − ⟨w s⟩ is the square of what the white shows by itself.
    """
    small = min(1.0, min(lit.shape) / SMALL)
    scale = (FIELDS[0] * small, FIELDS[1] * small)
    s, w = each(partial(_detail, scale=scale), (scene, lit))
    own, shown, common, counted = _blocks(s, w, sound, int(4 * scale[1]))
    some = counted > 0.25
    if not some.any() or np.mean(shown[some] > STRUCTURE**2) <= MUCH:
        return None
    alone = float((shown - common)[some].mean())
    if alone <= float(shown[some].mean()) / 4:
        return None
    return _Picture(float(np.sqrt(alone)), bool(own[some].mean() < shown[some].mean() / 9))


def _detail(plane: np.ndarray, scale: tuple[float, float]) -> np.ndarray:
    """Return the relative detail of a plane between two scales, px, (h, w); light goes on beyond the border as it falls off."""
    import cv2

    rim = min(int(4 * scale[1]), min(plane.shape) - 1)
    wide = np.pad(plane, rim, mode="reflect", reflect_type="odd")
    fine, coarse = (cv2.GaussianBlur(wide, (0, 0), s)[rim:-rim, rim:-rim] for s in scale)
    base = np.maximum(np.abs(coarse), max(1e-3 * float(np.median(np.abs(coarse))), 1e-9))
    return (fine - coarse) / base


def _plane(array: np.ndarray) -> np.ndarray:
    return array if array.ndim == 2 else array.mean(2, dtype=np.float32)


def _reduced_size(size: tuple[int, int], period: tuple[int, int]) -> tuple[int, int]:
    height, width = (n // p for n, p in zip(size, period, strict=True))
    step = max(1.0, np.sqrt(height * width / MOST_PIXELS))
    return int(height / step), int(width / step)


def _reduced(plane: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    import cv2

    plane = np.ascontiguousarray(plane, np.float32)
    if plane.shape == size:
        return plane
    return np.asarray(cv2.resize(plane, size[::-1], interpolation=cv2.INTER_AREA))


def _inside(lit: np.ndarray) -> np.ndarray:
    """Return which pixels of a white, (h, w), are not of first or last lines that respond otherwise, as sensors have in any frame."""
    inside = np.ones(lit.shape, bool)
    for plane, part in ((lit, inside), (lit.T, inside.T)):
        lines = np.median(plane, 1)
        for side, within in ((slice(None, EDGE), EDGE), (slice(-EDGE, None), -EDGE - 1)):
            if np.abs(lines[side] - lines[within]).max() > OTHER * abs(lines[within]):
                part[side] = False
    return inside


def _grown_over(plane: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return a plane with what lies nearest inside in place of lines at its edges."""
    rows, columns = (np.flatnonzero(inside.any(axis)) for axis in (1, 0))
    whole = plane[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    after = [n - 1 - at[-1] for n, at in zip(plane.shape, (rows, columns), strict=True)]
    return np.pad(whole, ((rows[0], after[0]), (columns[0], after[1])), mode="edge")


def _blocks(
    of_object: np.ndarray, of_white: np.ndarray, sound: np.ndarray, side: int
) -> tuple[np.ndarray, ...]:
    """Return mean squares of the details of object and white, of their product, and the share that is sound."""
    planes = (of_object**2, of_white**2, of_object * of_white)
    counted = _means(sound.astype(np.float32), side)
    sums = (_means(np.where(sound, plane, 0), side) for plane in planes)
    return (*(one / np.maximum(counted, 1e-6) for one in sums), counted)


def _means(plane: np.ndarray, side: int) -> np.ndarray:
    rows, columns = (n // side for n in plane.shape)
    whole = plane[: rows * side, : columns * side].astype(np.float64)
    return np.asarray(whole.reshape(rows, side, columns, side).mean((1, 3)))


def _state(blocks: tuple[np.ndarray, ...]) -> np.ndarray:
    """Return 1 where a block of the white shows the object, −1 where it shows the board, 0 where nothing decides."""
    own, lit, common, sound = blocks
    alike = common / np.maximum(np.sqrt(own * lit), 1e-12)
    part = common / np.maximum(own, 1e-12)
    judged = (sound > 0.5) & (own > DETAILED**2)
    everywhere = np.quantile(lit[sound > 0.5], 0.1) ** 0.5 if np.any(sound > 0.5) else 0.0
    least = max(SHOWN, ABOVE * min(float(everywhere), FIXED))
    board = judged & ((alike < UNLIKE) | (part < CONTRAST / 4))
    if not board.any():  # an object without detail lets dust look like its own
        least = ABOVE * FIXED
    shown = judged & (lit > least**2) & (alike > ALIKE) & (part > CONTRAST)
    state = shown.astype(int) - board.astype(int)
    return np.where(_large(state > 0, FEWEST), 1, np.minimum(state, 0))


def _large(mask: np.ndarray, fewest: int) -> np.ndarray:
    """Return the parts of a mask that hang together and are large."""
    from scipy.ndimage import label

    parts, _ = label(mask, np.ones((3, 3)))
    counts = np.bincount(parts.ravel())
    counts[0] = 0
    return np.asarray(counts[parts] >= fewest)


def _grown(state: np.ndarray) -> np.ndarray:
    """Return the blocks without a board, undecided ones as the nearest decided, and those beside them."""
    from scipy.ndimage import binary_dilation, distance_transform_edt

    where = distance_transform_edt(state == 0, return_distances=False, return_indices=True)
    return np.asarray(binary_dilation(state[tuple(where)] > 0, np.ones((3, 3))))


def _at_size(
    mask: np.ndarray, side: int, reduced: tuple[int, int], size: tuple[int, int]
) -> np.ndarray:
    """Return a mask of blocks of a reduced frame in pixels of the frame, (h, w)."""
    places = [
        np.minimum((np.arange(n) * r / n).astype(int) // side, blocks - 1)
        for n, r, blocks in zip(size, reduced, mask.shape, strict=True)
    ]
    return mask[np.ix_(*places)]


def _edges(of_white: np.ndarray, sound: np.ndarray) -> np.ndarray:
    """Return where the white has long edges, (h, w) of the reduced frame."""
    from scipy.ndimage import find_objects, label

    usual = 1.4826 * float(np.median(np.abs(of_white[sound]))) if sound.any() else 0.0
    parts, _ = label((np.abs(of_white) > max(STEP, NOISE * usual)) & sound, np.ones((3, 3)))
    kept = np.zeros(parts.shape, bool)
    for number, box in enumerate(find_objects(parts), 1):
        if max(part.stop - part.start for part in box) >= LONG * min(parts.shape):
            kept[box] |= parts[box] == number
    return kept


def _note_edges(edges: np.ndarray, size: tuple[int, int]) -> tuple[str, ...]:
    if not edges.any():
        return ()
    x, y = _extent(edges, size)
    return (
        f"the white is not smooth: it has edges between columns {x[0]} and {x[1]}, rows {y[0]} and {y[1]} (the border of the "
        "board, a shadow or something before it); values there are wrong unless the object was captured with the same",
    )


def _note(mask: np.ndarray) -> str:
    x, y = _extent(mask, mask.shape)
    return (
        f"the white shows the object and not the board over {100 * mask.mean():.0f} % of the frame (columns {x[0]} to {x[1]}, "
        f"rows {y[0]} to {y[1]}): there is no reflectance there, and the pixels are flagged as outside. Capture a white "
        "that fills the view"
    )


def _extent(mask: np.ndarray, size: tuple[int, ...]) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return first and last column and row of a mask in pixels of a frame of (height, width)."""
    found = []
    for axis, n in ((0, size[1]), (1, size[0])):
        there = np.flatnonzero(mask.any(axis))
        scale = n / mask.shape[1 - axis]
        found.append((int(there[0] * scale), int((there[-1] + 1) * scale) - 1))
    return found[0], found[1]


def _shows_object(share: float) -> Problem:
    return Problem(
        "E_WHITE_DETAIL",
        "the white shows the object, not a white board",
        found=f"the detail of the object over {100 * share:.0f} % of the frame",
        expected="a smooth board that fills the view",
        fix="Check that the frames of white and object are not the same, and capture a white board in place of the object.",
    )


def _shows_a_picture(rms: float, exchanged: bool) -> Problem:
    fix = "Capture a white board in place of what the white shows, or correct its name."
    if exchanged:
        fix = "White and object appear to be exchanged, for the object is smooth and brighter: exchange their names."
    return Problem(
        "E_WHITE_DETAIL",
        "the white is a picture, not a white board",
        found=f"detail of {100 * rms:.0f} % rms over more than half of the frame that the object does not have",
        expected="a smooth board that fills the view",
        fix=fix,
    )
