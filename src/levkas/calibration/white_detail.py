"""Fine detail of a white: the sensor's, which a division takes away, or the board's, which it puts into the object.

White and object are products, W = L · P · B and S = L · P · O, of light, of sensor and lens (response of single sensels,
dust before the sensor) and of what they show. Detail of P is in both, at the same places; that of the board is in the
white alone. With the relative details w and s of the two, and O independent of both, ⟨w²⟩ − ⟨w s⟩ is the square of the
board's detail. It is weighted by what the object leaves visible, pixel by pixel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from levkas.core.threads import each

SCALES = ((1.0, 4.0), (4.0, 16.0))  # px: of texture and dust; of painted fields and blurred ones
SMALL = 150  # px of the shorter side of a frame below which its fields are smaller too
AROUND = 3.0  # px over which the object's detail is averaged before it weighs
FLOOR = 0.002  # rms of an object's detail below which noise, not detail, weighs
SIGMAS = 4.0  # of the estimate, for texture; a white is judged once a band
TEXTURE = 0.015  # rms of a pixel: good boards have less than half of it
SINGLE = 0.1  # relative, of a pixel from those around it: dust of 20 % and 1.5 px is at half of it
MOST_NOISE = 0.3  # relative, of a pixel: a dead one has more
STRUCTURE, MUCH = 0.05, 0.5  # rms of a block, and share of blocks that have it, of a picture


class BoardDetail(NamedTuple):
    """What a white shows of its board that is not in the object.

    Parameters
    ----------
    texture : float
        Relative standard deviation of a pixel by texture, specks and edges; 0 where none stands out.
    picture : float
        Relative rms over most of the frame at the scale of painted fields, of a white that is a picture; 0 of others.
    smooth : bool
        Whether the object has far less detail than the white.
    """

    texture: float = 0.0
    picture: float = 0.0
    smooth: bool = False


def find_board_detail(scene: np.ndarray, lit: np.ndarray, sound: np.ndarray) -> BoardDetail:
    """Separate the board's detail from the sensor's.

    Parameters
    ----------
    scene, lit : ndarray, (h, w), float32
        Counts above dark of object and white.
    sound : ndarray, (h, w), bool
        What may be looked at.

    Notes
    -----
    Noise of the white is what is left of planes of 3x3 px ([immerkaer1996]_, doi:10.1006/cviu.1996.0060).

    Examples
    --------
    >>> import cv2
    >>> rng = np.random.default_rng(1)
    >>> board, paint = (cv2.GaussianBlur(rng.standard_normal((200, 200)), (0, 0), 1.5) * 4 for _ in range(2))
    >>> board, paint = (np.float32(1 + 0.04 * plane) for plane in (board, paint))
    >>> every = np.ones((200, 200), bool)
    >>> found = find_board_detail(paint, board, every)
    >>> bool(0.02 < found.texture < 0.04), found.picture
    (True, 0.0)
    >>> find_board_detail(paint * board, board, every).texture
    0.0
    """
    scene, lit = _without_single_pixels(scene, lit)
    noise = _noise_of(lit)
    of_object, of_white = each(lambda plane: detail(plane, SCALES[0]), (scene, lit))
    fine = _shares(of_object, of_white, sound, SCALES[0], noise)
    small = min(1.0, min(lit.shape) / SMALL)
    fields = (SCALES[1][0] * small, SCALES[1][1] * small)
    wide, of_fields = each(lambda plane: detail(plane, fields), (scene, lit))
    coarse = _shares(wide, of_fields, sound, fields, noise)
    picture = 0.0
    if coarse.much > MUCH and (coarse.sure or (fine.sure and fine.board > STRUCTURE**2)):
        picture = float(np.sqrt(max(coarse.board, fine.board)))
    texture = 0.0
    if fine.sure:
        share = fine.board / max(fine.lit, 1e-12)
        texture = float(np.sqrt(share * max(fine.whole, fine.lit)))
    smooth = bool(coarse.own < coarse.lit / 9)
    return BoardDetail(texture if texture > TEXTURE else 0.0, picture, smooth)


class RelativeDetail(NamedTuple):
    """Relative detail of a plane between two scales, and all that is finer than the coarser one, (h, w)."""

    between: np.ndarray
    whole: np.ndarray


class _Shares(NamedTuple):
    """Mean squares: of the board's detail, of all that the white has beside noise, of a pixel, of the object's.

    `sure` is whether the board's stands out, `much` the share of blocks in which the white has much.
    """

    board: float
    lit: float
    whole: float
    own: float
    sure: bool
    much: float


def _shares(
    of_object: RelativeDetail,
    of_white: RelativeDetail,
    sound: np.ndarray,
    scale: tuple[float, float],
    noise: np.ndarray,
) -> _Shares:
    """Return what detail of one scale is whose."""
    w = of_white.between
    # The object's own detail is the less of the two, whether the white's is the board's or the sensor's.
    own = np.minimum(of_object.between**2, (of_object.between - w) ** 2)
    weight = _weights(own, sound)
    side = int(4 * scale[1])
    planes = (weight, weight * w**2, weight * of_object.between * w, 1.0, w**2)
    sums = [_sums(np.where(sound, plane, 0), side) for plane in planes]
    total = max(float(sums[0].sum()), 1e-12)
    by_noise = float((weight * noise).sum()) / total
    hidden = by_noise * passed(scale)
    lit = float(sums[1].sum()) / total - hidden
    board = min(float((sums[1] - sums[2]).sum()) / total - hidden, lit)
    slope = float(sums[2].sum()) / max(float(sums[1].sum()), 1e-12)
    error = float(np.sqrt(np.square(sums[2] - slope * sums[1]).sum())) / total
    some = sums[3] > side**2 / 4
    much = float(np.mean(sums[4][some] > STRUCTURE**2 * sums[3][some])) if some.any() else 0.0
    whole = float((weight * np.where(sound, of_white.whole**2, 0)).sum()) / total - by_noise
    of_scene = float(np.mean(np.where(sound, of_object.between**2, 0)))
    return _Shares(board, lit, whole, of_scene, board > max(SIGMAS * error, lit / 4), much)


def _without_single_pixels(scene: np.ndarray, lit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return object and white with the median of 3x3 px where a single pixel of the white is far from it: defects are no specks."""
    import cv2

    planes = [np.ascontiguousarray(plane, np.float32) for plane in (scene, lit)]
    of_object, of_white = (cv2.medianBlur(plane, 3) for plane in planes)
    single = np.abs(planes[1] - of_white) > SINGLE * np.abs(of_white)
    return np.where(single, of_object, planes[0]), np.where(single, of_white, planes[1])


def detail(plane: np.ndarray, scale: tuple[float, float]) -> RelativeDetail:
    """Return the relative detail of a plane, (h, w); light goes on beyond the border as it falls off."""
    import cv2

    rim = min(int(4 * scale[1]), min(plane.shape) - 1)
    wide = np.pad(plane, rim, mode="reflect", reflect_type="odd")
    fine, coarse = (cv2.GaussianBlur(wide, (0, 0), s)[rim:-rim, rim:-rim] for s in scale)
    base = np.maximum(np.abs(coarse), max(1e-3 * float(np.median(np.abs(coarse))), 1e-9))
    return RelativeDetail((fine - coarse) / base, (plane - coarse) / base)


def _weights(square: np.ndarray, sound: np.ndarray) -> np.ndarray:
    """Return how well detail of the white can be measured in the object, of whose detail this is the square: 1/variance, (h, w)."""
    import cv2

    square = np.where(sound, square, 0).astype(np.float32)
    weight = 1 / (cv2.GaussianBlur(square, (0, 0), AROUND) + FLOOR**2)
    return np.where(sound, weight, 0)


def _sums(plane: np.ndarray, side: int) -> np.ndarray:
    """Return sums over blocks of `side` px, those at the border smaller."""
    down = np.add.reduceat(plane.astype(np.float64), np.arange(0, plane.shape[0], side), axis=0)
    return np.asarray(np.add.reduceat(down, np.arange(0, plane.shape[1], side), axis=1))


def passed(scale: tuple[float, float]) -> float:
    """Return the share of white noise's variance that lies between two scales.

    >>> round(passed((1.0, 4.0)), 4)
    0.0658
    """
    a, b = (s * s for s in scale)
    return float((1 / (4 * a) + 1 / (4 * b) - 1 / (a + b)) / np.pi)


def _noise_of(lit: np.ndarray) -> np.ndarray:
    """Return the relative variance of noise that each pixel of a white shows, (h, w)."""
    import cv2

    left = cv2.filter2D(lit, -1, np.outer([1, -2, 1], [1, -2, 1]) / 6.0)
    level = np.maximum(np.abs(cv2.GaussianBlur(lit, (0, 0), SCALES[0][1])), 1e-9)
    return np.asarray(np.minimum(np.abs(left) / level, MOST_NOISE) ** 2)
