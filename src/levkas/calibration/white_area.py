"""Area of the white board in its frame: where the frame shows the object instead.

A white is smooth. Where it has the detail of the object, at the scale of several sensels and with a good part of its contrast,
the board was not there: the quotient would be 1. What sensor and lens give to every frame (response of single sensels, dust,
vignetting) is finer, fainter or rarer than that, and an object without detail shows nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from levkas.calibration.findings import refusal
from levkas.calibration.patterns import blocks_of, channel_table
from levkas.calibration.templates import Template
from levkas.core.threads import each

MOST_PIXELS = 1_000_000
"""Of a frame that are looked at: larger ones are reduced."""
SIDE, BLOCKS, RIM = 16, 10, 2
"""px of a block; blocks a side that a small frame has at least; px at the border whose lines may respond otherwise, in any frame."""
SHOWN, FIXED, ABOVE = 0.015, 0.02, 2.5
"""Relative rms of the white's own detail from which it is judged (boards have less, paintings 5 to 20 %), and times what its lower
tenth has, of which a sensor gives 2 % to every frame: dust all over, fringes."""
DETAILED = 0.01
"""Relative rms of the object's detail that lets a white be judged."""
ALIKE, UNLIKE, CONTRAST = 0.6, 0.3, 0.25
"""Correlation of the two where the white shows the object, and the board; share of the object's contrast that it shows at least."""
LEAST, FEWEST, MOST = 0.02, 6, 0.5
"""Share of the frame, and blocks together, that are no dust; share from which the white is none."""
LINES, BRIGHT = 16, 0.2
"""Lines that show what moves, and share of the brightest band that a band has."""
MOVING, USUAL = 0.05, 4.0
"""Relative rms along the scan of what moves, and that over the steadier quarter of the samples."""
FINE, FIELDS = (1.0, 4.0), (4.0, 16.0)
"""px: scales of texture and dust; of painted fields and blurred ones, in a frame of 150 px a side or more."""
STRUCTURE, MUCH = 0.05, 0.5
"""Relative rms of a block, and share of blocks that have it, of a picture."""


class WhiteArea(NamedTuple):
    """Where a white frame shows the object and not the board, (h, w), bool; None where it does so nowhere."""

    uncovered: np.ndarray | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        """What a report has to say."""
        if self.uncovered is None:
            return ()
        rows, columns = (np.flatnonzero(self.uncovered.any(axis)) for axis in (1, 0))
        return (
            f"the white shows the object and not the board over {100 * self.uncovered.mean():.0f} % of the frame (columns "
            f"{columns[0]} to {columns[-1]}, rows {rows[0]} to {rows[-1]}): there is no reflectance there, and the pixels are "
            "flagged as outside. Capture a white that fills the view",
        )

    def at(self, rows: np.ndarray, columns: np.ndarray) -> WhiteArea:
        """Return the area of a larger frame; `rows` and `columns` are where each of its own is in this one."""
        return self if self.uncovered is None else WhiteArea(self.uncovered[np.ix_(rows, columns)])


def joined_area(areas: Sequence[WhiteArea]) -> WhiteArea:
    """Return what some bands of one white show together: paint that one of them does not see is another's detail."""
    masks = [area.uncovered for area in areas if area.uncovered is not None]
    return WhiteArea(np.logical_or.reduce(masks) if masks else None)


def board_alone(white: Template, uncovered: np.ndarray | None) -> Template:
    """Return a white with one level where it does not show the board, so that nothing there looks like a defect."""
    if uncovered is None:
        return white
    level = np.float32(np.median(white.mean[~uncovered]))
    lost = uncovered if white.mean.ndim == 2 else uncovered[..., None]
    return replace(white, mean=np.where(lost, level, white.mean))


def find_white_area(
    shot: Template,
    white: Template,
    levels: tuple[np.ndarray, np.ndarray],
    pattern: str | Sequence[Sequence[str]] | None = None,
) -> WhiteArea:
    """Find where a white frame shows the object in place of the board.

    Frames are (h, w) or (h, w, b), whose bands are averaged, as are the periods of a mosaic; `levels` are counts without light
    of each. Blocks in which the object has no detail are given to the nearest that is decided.

    Raises CalibrationRefused, ``E_WHITE_DETAIL`` where the object is in more than half of the white, or the white is a picture
    of something else.

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
    size = shot.mean.shape[:2]
    height, width = (n // p for n, p in zip(size, period, strict=True))
    step = max(1.0, np.sqrt(height * width / MOST_PIXELS))
    small = int(height / step), int(width / step)
    if white.mean.shape != shot.mean.shape or min(small) < BLOCKS * 3:
        return WhiteArea()
    scene, lit, full = (
        _reduced(plane, small)
        for plane in (
            shot.mean - levels[0],
            white.mean - levels[1],
            shot.saturated | white.saturated,
        )
    )
    sound = np.pad(np.ones((small[0] - 2 * RIM, small[1] - 2 * RIM), bool), RIM)
    sound &= (scene > 0) & (lit > 0) & (full == 0)
    scene, lit = (np.pad(p[RIM:-RIM, RIM:-RIM], RIM, mode="edge") for p in (scene, lit))
    shown, board = each(_detail, (scene, lit), (FINE, FINE))
    side = max(3, min(SIDE, min(small) // BLOCKS))
    uncovered = _without_board(_blocks(shown, board, sound, side))
    share, mask = float(uncovered.mean()), None
    if share > MOST:
        raise refusal("white_object", number=share)
    if share >= LEAST:
        mask = _at_size(uncovered, side, small, size)
        sound &= ~_at_size(uncovered, side, small, small)
    if sound.mean() > MOST:
        _require_no_picture(scene, lit, sound)
    return WhiteArea(mask)


def find_white_line(white: Template, level: np.ndarray) -> WhiteArea:
    """Find where the white line of a push-broom camera, (1, samples, bands), shows something that moves along the scan, (1, samples).

    `white` is the average of lines, with its variance; `level` are counts without light.

    Raises CalibrationRefused, ``E_WHITE_DETAIL`` where more than half of the samples show it.

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
    parts = _large(moving[None], max(3, len(light) // 100))
    if (share := float(parts.mean())) > MOST:
        raise refusal("white_object", number=share)
    return WhiteArea(parts if parts.any() else None)


def _reduced(plane: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return a frame, its bands averaged, at another size, float32."""
    flat = plane if plane.ndim == 2 else plane.mean(2, dtype=np.float32)
    flat = np.ascontiguousarray(flat, np.float32)
    if flat.shape != size:
        flat = cv2.resize(flat, size[::-1], interpolation=cv2.INTER_AREA)
    return flat


def _detail(plane: np.ndarray, scale: tuple[float, float]) -> np.ndarray:
    """Return the relative detail of a plane between two scales, px, (h, w); light goes on beyond the border as it falls off."""
    rim = min(int(4 * scale[1]), min(plane.shape) - 1)
    wide = np.pad(plane, rim, mode="reflect", reflect_type="odd")
    fine, coarse = (cv2.GaussianBlur(wide, (0, 0), s)[rim:-rim, rim:-rim] for s in scale)
    base = np.maximum(np.abs(coarse), max(1e-3 * float(np.median(np.abs(coarse))), 1e-9))
    return (fine - coarse) / base


def _blocks(
    of_object: np.ndarray, of_white: np.ndarray, sound: np.ndarray, side: int
) -> tuple[np.ndarray, ...]:
    """Return mean squares of the details of object and white, of their product, and the share that is sound."""

    def means(plane: np.ndarray) -> np.ndarray:
        return np.asarray(blocks_of(plane.astype(np.float64), side).mean((2, 3)))

    counted = means(sound)
    planes = (of_object**2, of_white**2, of_object * of_white)
    found = (means(np.where(sound, plane, 0)) / np.maximum(counted, 1e-6) for plane in planes)
    return (*found, counted)


def _without_board(blocks: tuple[np.ndarray, ...]) -> np.ndarray:
    """Return which blocks of the white show the object, undecided ones as the nearest decided, and those beside them."""
    from scipy.ndimage import binary_dilation, distance_transform_edt

    own, lit, common, sound = blocks
    alike = common / np.maximum(np.sqrt(own * lit), 1e-12)
    part = common / np.maximum(own, 1e-12)
    judged = (sound > 0.5) & (own > DETAILED**2)
    everywhere = np.quantile(lit[sound > 0.5], 0.1) ** 0.5 if np.any(sound > 0.5) else 0.0
    board = judged & ((alike < UNLIKE) | (part < CONTRAST / 4))
    dusty = min(float(everywhere), FIXED) if board.any() else FIXED  # without detail dust is alike
    least = max(SHOWN, ABOVE * dusty)
    edge = (sound > 0.5) & (lit > (5 * FIXED) ** 2)  # at the border of a frame the board ends
    edge[1:-1, 1:-1] = False
    object_there = judged & (lit > least**2) & (alike > ALIKE) & (part > CONTRAST)
    shown = _large(object_there, FEWEST) | _large(edge, FEWEST)
    if not shown.any():
        return shown
    where = distance_transform_edt(~(shown | board), return_distances=False, return_indices=True)
    return np.asarray(binary_dilation(shown[tuple(where)], np.ones((3, 3))))


def _large(mask: np.ndarray, fewest: int) -> np.ndarray:
    """Return the parts of a mask that hang together and are large."""
    from scipy.ndimage import label

    parts, _ = label(mask, np.ones((3, 3)))
    return np.asarray(mask & (np.bincount(parts.ravel())[parts] >= fewest))


def _at_size(
    mask: np.ndarray, side: int, reduced: tuple[int, int], size: tuple[int, ...]
) -> np.ndarray:
    """Return a mask of blocks of a reduced frame in pixels of the frame, (h, w)."""
    places = [
        np.minimum((np.arange(n) * r / n).astype(int) // side, blocks - 1)
        for n, r, blocks in zip(size, reduced, mask.shape, strict=True)
    ]
    return mask[np.ix_(*places)]


def _require_no_picture(scene: np.ndarray, lit: np.ndarray, sound: np.ndarray) -> None:
    """Refuse a white most blocks of which show, at the scale of painted fields, what the object does not.

    White and object are products of light, sensor and what they show. With their relative details w and s, detail of the
    sensor is in both, and ⟨w²⟩ − ⟨w s⟩ is the square of what the white shows by itself.
    """
    small = min(1.0, min(lit.shape) / 150)
    scale = (FIELDS[0] * small, FIELDS[1] * small)
    picture, board = each(_detail, (scene, lit), (scale, scale))
    _, shown, common, counted = _blocks(picture, board, sound, int(4 * scale[1]))
    some = counted > 0.25
    if not some.any() or np.mean(shown[some] > STRUCTURE**2) <= MUCH:
        return
    alone = float((shown - common)[some].mean())
    if alone > float(shown[some].mean()) / 4:
        raise refusal("white_picture", number=alone**0.5)
