"""Shots of one scene compared as small pictures: another scene, another place, other light and another exposure are told apart.

None of these is averaged. What moved in a part of the picture is none of them (`motion`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from levkas.calibration.patterns import split

DIM = 0.02  # of the brightest cells: darker ones hold noise alone
SIGMAS = 8.0  # of noise, from which on light changed
PICTURE, PATCH, PLACES = 320, 64, (0.2, 0.5, 0.8)
"""Longer side of the small picture, px; side of the patches kept at full size, px of one phase, and where their middles lie."""
MOST_REDUCED, SAMPLE = 1 << 23, 1 << 19
"""Pixels that are averaged into a small picture, and from which noise is taken: of larger frames whole rows are left out."""
SURE, ONE_SCENE = 0.5, 0.6
"""Correlation of two pictures at their best place from which that place counts; of their detail from which they show one scene:
shots have 0.95 and more, two bands of one page 0.7, two paintings in frames alike 0.4, else up to 0.2. With 0.3 the frame
decides, with 0.9 a hand before a fifth of the object is another scene."""
TEXTURE = 6.0
"""Spread of a patch over its noise from which it has something to compare."""
BLUR, FAINT, NOISES, SHOWN = 4.0, 0.02, 4.0, 0.15
"""Px of half the small picture below which is detail, above light; contrast, relative and over noise, of which detail has half
its weight; mean square of weighted detail (noise alone has 0.06, a painting 0.4 to 0.8) from which there is something to compare."""
MOVED_PX = 1.0
"""Px of one phase. Stripes of 2 px cancel in the mean of two shots that lie 1 px apart; of a shift of 0.5 px, as stands that tremble
have it, 71 % of them are left; 1.5 px invert them."""
LAMP = 0.1
"""Change of the light of all, or of a part more than of the rest. Lamps that warm up change by some per cent; the least step of a
bracket, 1/3 EV, is 26 %, in a JPEG's codes 11 %. With 0.05 lamps that flicker are refused, with 0.15 such a JPEG passes."""
RELIT = 0.25
"""Share of the lit picture whose light changed more than `LAMP`, the rest's taken off. With 0.12 a hand before the object is
another light, with 0.4 a lamp that was moved a little is none."""
SIZES = {
    "scene": "its detail correlates by {:.2f}",
    "place": "it is moved by {:.1f} px",
    "light": "parts of it changed by {:.0f} % more than the rest",
    "exposure": "it has {:.2g} times the counts",
}
"""In what a shot differs, and by how much."""


@dataclass(frozen=True, eq=False)
class Sight:
    """What of a frame is compared with the other shots of its scene: one channel, reduced, and at full size in nine patches.

    `shape` and `period` are (rows, columns) of the frame, native px, and of its mosaic; `noise` is the standard deviation of a
    pixel, counts.
    """

    shape: np.ndarray
    period: np.ndarray
    picture: np.ndarray
    patches: np.ndarray
    noise: float

    @classmethod
    def of(cls, frame: np.ndarray, period: tuple[int, int]) -> Sight:
        """Return the sight of a frame, (h, w) or (h, w, bands), by its middle phase and band."""
        phases = split(frame.reshape(*frame.shape[:2], -1), *period)
        plane = phases[len(phases) // 2]
        plane = plane[..., plane.shape[2] // 2]
        plane = np.nan_to_num(plane) if plane.dtype.kind == "f" else plane
        noise = noise_of(plane[:: max(1, plane.size // SAMPLE)].astype(np.float32))
        noise = max(0.5, noise) if plane.dtype.kind in "ui" else noise
        shape = np.array(frame.shape[:2])
        return cls(shape, np.array(period), picture_of(plane), patches_of(plane), noise)


def watch_shots(
    frames: Iterable[np.ndarray],
    unlike: list[tuple[int, str, float]],
    period: tuple[int, int],
    *levels: float | None,
) -> Iterator[np.ndarray]:
    """Hand the shots of an object on, and put those into `unlike` that are unlike the first; `levels` as of `difference_between`."""
    first: np.ndarray | Sight | None = None
    for k, frame in enumerate(frames):
        yield frame
        if first is None:
            first = frame
            continue
        first = first if isinstance(first, Sight) else Sight.of(first, period)
        if found := difference_between(first, Sight.of(frame, period), *levels):
            unlike.append((k, *found))


def difference_between(
    first: Sight, shot: Sight, black: float | None = 0.0, full: float | None = None
) -> tuple[str, float] | None:
    """Return in what a shot differs from the first of its stack by more than noise and lamp, and by how much; None in nothing.

    It is ``"scene"``, with the correlation of detail; ``"light"``, % by which parts changed more than the rest; ``"place"``,
    native px; or ``"exposure"``, the ratio of counts above `black`. `full` is the full scale, counts.

    >>> rng = np.random.default_rng(1)
    >>> scene = 60 + 2000 * rng.random((16, 20)).repeat(16, 0).repeat(16, 1)
    >>> def sight(of):
    ...     return Sight.of(rng.normal(of, 20), (1, 1))
    >>> difference_between(sight(scene), sight(60 + 1.03 * (scene - 60)), 60)
    >>> what, by = difference_between(sight(scene), sight(np.roll(scene, 4, 1)), 60)
    >>> what, round(by)
    ('place', 4)
    """
    if first.picture.shape != shot.picture.shape or min(first.picture.shape) < 32:
        return None
    place = shift_between(shot, first, full)
    distance = float(np.hypot(*place)) if place is not None else 0.0
    moved = distance >= MOVED_PX * max(shot.period)
    lights, noises = zip(*(_light_of(one, black or 0.0) for one in (first, shot)), strict=True)
    if not moved and (alike := _likeness(lights, noises)) < ONE_SCENE:
        return "scene", alike
    changed = _change_of_light(lights, max(noises), max(first.noise, shot.noise))
    far = distance > shot.shape[0] / lights[0].shape[0]  # edges look like light then
    if moved and (far or changed is None or changed[0] == "exposure"):
        return "place", distance
    return changed


def _light_of(one: Sight, black: float) -> tuple[np.ndarray, float]:
    """Return the light of half the small picture, counts above black, at least 1 % of the bright parts; and its noise, counts."""
    height, width = (n // 2 for n in one.picture.shape)
    light = reduced(np.nan_to_num(one.picture), (height, width)) - np.float32(black)
    averaged = min(float(np.prod(one.shape / one.period)), MOST_REDUCED) / light.size
    noise = one.noise / np.sqrt(averaged)
    return np.maximum(light, max(0.01 * np.quantile(light, 0.98), noise, 1e-9)), noise


def _likeness(lights: Sequence[np.ndarray], noises: Sequence[float]) -> float:
    """Return the correlation of the detail of two pictures, 1 where either has none.

    Detail is taken over its size around, so that the edges of a frame have no more weight than the face in it.
    """
    import cv2

    details = []
    for light, noise in zip(lights, noises, strict=True):
        logs = np.log(light)
        fine = logs - cv2.GaussianBlur(logs, (0, 0), BLUR)
        least = FAINT**2 + (NOISES * noise / light) ** 2
        details.append(fine / np.sqrt(cv2.GaussianBlur(fine**2, (0, 0), BLUR) + least))
    powers = [float(np.mean(detail**2)) for detail in details]
    if min(powers) < SHOWN:
        return 1.0
    return float(np.mean(details[0] * details[1]) / np.sqrt(np.prod(powers)))


def _change_of_light(
    lights: Sequence[np.ndarray], small: float, noise: float
) -> tuple[str, float] | None:
    """Return ``"light"`` or ``"exposure"`` and its size, as `difference_between`; None where neither changed.

    `small` is the noise of a pixel of `lights`, `noise` of the frames', counts.
    """
    import cv2

    # A blur of sigma b averages 4 pi b^2 pixels; black levels wander by less than the noise of one of the frame's.
    least = max(SIGMAS * small / (np.sqrt(4 * np.pi) * BLUR), noise)
    one, other = (np.maximum(cv2.GaussianBlur(light, (0, 0), BLUR), least) for light in lights)
    brighter, darker = np.maximum(one, other), np.minimum(one, other)
    lit = brighter > DIM * np.quantile(brighter, 0.98)
    apart, limit = np.log(other / one)[lit], np.log1p(np.maximum(LAMP, least / darker[lit]))
    level = float(np.median(apart))
    rest = np.abs(apart - level)
    relit = float(np.mean(rest > limit))
    known = np.log1p(max(LAMP, least / float(np.median(brighter[lit]))))
    if abs(level) < known and relit < RELIT:
        return None
    if relit >= RELIT:
        codes = max(np.log(one[lit]), np.log(other[lit]), key=np.ptp)
        tones = np.polynomial.Polynomial.fit(codes, apart, 3)  # of a camera's own curve, too
        if abs(level) < known or np.mean(np.abs(apart - tones(codes)) > limit) > relit / 2:
            return "light", 100 * float(np.expm1(np.quantile(rest, 0.9)))
    return "exposure", float(np.exp(level))


def picture_of(plane: np.ndarray, most: int = PICTURE) -> np.ndarray:
    """Return a plane reduced to `most` px on its longer side."""
    step = max(1.0, max(plane.shape) / most)
    return reduced(plane, (max(1, int(plane.shape[0] / step)), max(1, int(plane.shape[1] / step))))


def patches_of(plane: np.ndarray) -> np.ndarray:
    """Return nine patches of a plane at full size; none of a small one."""
    kind = plane.dtype if plane.dtype in (np.uint8, np.uint16) else np.dtype(np.float32)
    if min(plane.shape) < 2 * PATCH:
        return np.zeros((0, PATCH, PATCH), kind)
    starts = [
        [min(max(int(n * share) - PATCH // 2, 0), n - PATCH) for share in PLACES]
        for n in plane.shape
    ]
    parts = [plane[y : y + PATCH, x : x + PATCH] for y in starts[0] for x in starts[1]]
    return np.stack(parts).astype(kind)


def noise_of(plane: np.ndarray) -> float:
    """Return the standard deviation from pixel to pixel along rows, by the median of second differences."""
    if plane.shape[1] < 3:
        return float("nan")
    apart = plane[:, :-2] - 2 * plane[:, 1:-1] + plane[:, 2:]
    return 1.4826 * float(np.median(np.abs(apart))) / np.sqrt(6)


def reduced(plane: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return a plane reduced to a size, (rows, columns), by areas, float32."""
    import cv2

    rows, columns = (min(n, m) for n, m in zip(size, plane.shape, strict=True))
    apart = min(max(1, plane.size // MOST_REDUCED), max(1, plane.shape[0] // (2 * rows)))
    # Areas of a float plane are means exactly; those of integers are rounded.
    values = np.ascontiguousarray(plane[::apart], np.float32)
    small = cv2.resize(values, (columns, rows), interpolation=cv2.INTER_AREA)
    if (rows, columns) != size:
        small = cv2.resize(small, size[::-1], interpolation=cv2.INTER_NEAREST)
    return np.asarray(small)


def shift_between(
    frame: Sight, other: Sight, full: float | None = None
) -> tuple[float, float] | None:
    """Return how far a frame lies from another of the same scene, (x, y) native px; None where that is not plain.

    Patches at full size are correlated, the small picture where the shift is larger than they reach.
    """
    if frame.picture.shape != other.picture.shape or min(frame.picture.shape) < 16:
        return None
    step = frame.shape / np.array(frame.picture.shape)
    coarse, peak = _correlate(frame.picture, other.picture)
    if peak < SURE:
        return None
    coarse = (coarse[0] * step[1], coarse[1] * step[0])
    patched = len(frame.patches) == len(other.patches) > 0
    if np.hypot(*coarse) > 12 * max(frame.period) or not patched:
        return coarse
    found = []
    for a, b in zip(frame.patches, other.patches, strict=True):
        if full is not None and max(a.max(), b.max()) >= 0.98 * full:
            continue
        if any(p.std() < TEXTURE * s.noise for p, s in ((a, frame), (b, other))):
            continue
        place, height = _correlate(a, b)
        if height > SURE:
            found.append(place)
    if len(found) < 2:
        return coarse if np.hypot(*coarse) > 2 * step.max() else None
    x, y = np.median(found, 0)
    return float(x * frame.period[1]), float(y * frame.period[0])


def _correlate(one: np.ndarray, other: np.ndarray) -> tuple[tuple[float, float], float]:
    """Return how far the first lies from the second, (x, y) px, and their correlation there.

    Not the phase alone: noise has phases too, and would have as much weight as edges.
    """
    import cv2
    from scipy.fft import irfft2, rfft2

    window = cv2.createHanningWindow(one.shape[::-1], cv2.CV_32F)
    logs = [_floats(plane) for plane in (one, other)]
    planes = [(p - cv2.GaussianBlur(p, (0, 0), 8)) * window for p in logs]
    power = float(np.sqrt(np.prod([np.sum(plane.astype(float) ** 2) for plane in planes])))
    if power == 0:
        return (0.0, 0.0), 0.0
    product = irfft2(rfft2(planes[0]) * np.conj(rfft2(planes[1])), s=one.shape)
    y, x = divmod(int(np.argmax(product)), product.shape[1])
    return (_vertex(product[y], x), _vertex(product[:, x], y)), float(product[y, x]) / power


def _vertex(row: np.ndarray, place: int) -> float:
    """Return where the parabola about a place of a circular correlation is highest, −size/2 to size/2."""
    before, at, after = row[place - 1], row[place], row[(place + 1) % len(row)]
    bend = before - 2 * at + after
    place = place - len(row) if place > len(row) // 2 else place
    return float(place + (0.5 * (before - after) / bend if bend < 0 else 0.0))


def _floats(plane: np.ndarray) -> np.ndarray:
    """Return the logarithm of a plane, of decimals in thousandths of its bright parts: contrast counts alike in bands of unlike light."""
    values = np.nan_to_num(plane.astype(np.float32))
    bright = float(np.quantile(values, 0.98))
    return np.log(np.maximum(values * (1e3 / bright if 0 < bright < 1e3 else 1.0), 1.0))
