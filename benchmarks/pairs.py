"""Pairs of pictures for the battery: one surface imaged twice through known maps, and impostors."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from levkas.geometry.transforms import Affine, Composed, Homography, Lens, Polynomial

SURFACE = (2200, 1650)
SEEN_SHARE = 0.55
COARSE_PX = 360
PAINTED = 12
BEND_PX = 6.0
KINDS = ("visible", "visible", "infrared", "inverted")


class Surface:
    """What a painting reflects, (h, w) float32 0..1, in the visible and in the near infrared."""

    def __init__(self, visible: np.ndarray, infrared: np.ndarray) -> None:
        self.visible, self.infrared = visible.astype(np.float32), infrared.astype(np.float32)

    def layer(self, kind: str) -> np.ndarray:
        """Return reflectance as a camera of `kind` sees it."""
        if kind == "inverted":
            return 0.95 - self.visible
        return self.infrared if kind == "infrared" else self.visible


def paint(rng: np.random.Generator) -> Surface:
    """Paint patches of pigment, brush strokes of all sizes and cracks."""
    w, h = SURFACE
    rows, columns = np.mgrid[0:h:4, 0:w:4]
    places = np.stack([rows.ravel(), columns.ravel()], 1)
    near = cKDTree(rng.uniform(0, 1, (500, 2)) * (h, w)).query(places, k=1)[1]
    pigment = (near % 14).reshape(rows.shape).astype(np.uint8)
    pigment = cv2.resize(pigment, (w, h), interpolation=cv2.INTER_NEAREST)
    wobble = [90 * _grain(rng, (12, 12)) / 8 for _ in "xy"]
    x, y = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    pigment = cv2.remap(pigment, x + wobble[0], y + wobble[1], cv2.INTER_NEAREST)
    distance = cKDTree(rng.uniform(0, 1, (2500, 2)) * (h, w)).query(places, k=2)[0]
    edge = cv2.resize((distance[:, 1] - distance[:, 0]).reshape(rows.shape), (w, h))
    cracks = np.exp(-np.square(edge / 2.5))
    sizes = ((0.5, 1.5), (0.7, 4.0), (0.7, 9.0), (0.7, 22.0))
    strokes = sum(a * _grain(rng, (s, 2.5 * s)) for a, s in sizes)
    visible = rng.uniform(0.08, 0.75, 14)
    infrared = np.clip(0.5 + 0.2 * rng.normal(0, 1, 14), 0.1, 0.85)
    return Surface(
        visible[pigment] * (1 + 0.1 * strokes) * (1 - 0.4 * cracks),
        infrared[pigment] * (1 + 0.06 * strokes) * (1 - 0.15 * cracks),
    )


def _grain(rng: np.random.Generator, sigma: tuple[float, float]) -> np.ndarray:
    (w, h), n = SURFACE, max(1, int(sigma[0] / 2))
    noise = rng.standard_normal((h // n, w // n), np.float32)
    soft = cv2.GaussianBlur(noise, (0, 0), sigmaX=sigma[1] / n, sigmaY=sigma[0] / n)
    soft = cv2.resize(soft, (w, h), interpolation=cv2.INTER_CUBIC)
    return soft / soft.std()


def photographs() -> list[Surface]:
    """Return real paintings where `LEVKAS_REAL_DATA` or ../shared/data has them."""
    here = Path(os.environ.get("LEVKAS_REAL_DATA", Path(__file__).parents[2] / "shared" / "data"))
    found = []
    for path in sorted((here / "paintings").glob("*.jpg")):
        image = cv2.imread(str(path)).astype(np.float32)[..., ::-1] / 255
        scale = SURFACE[0] / max(image.shape)
        image = cv2.resize(image**2.2, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        red, green, blue = np.moveaxis(np.clip(image, 0, 1), -1, 0)
        infrared = np.clip(0.4 + 0.5 * red - 0.5 * blue + 0.1 * green, 0.02, 1)
        found.append(Surface(np.clip(0.05 + 0.8 * green, 0, 1), infrared))
    return found


class Studio:
    """The surfaces of a battery; the same seed, the same surfaces."""

    def __init__(self, seed: int) -> None:
        painted = [paint(np.random.default_rng([seed, 9, k])) for k in range(PAINTED)]
        self.surfaces = [*painted, *photographs()]

    def pick(self, rng: np.random.Generator, count: int) -> list[Surface]:
        """Draw different surfaces."""
        return [self.surfaces[k] for k in rng.permutation(len(self.surfaces))[:count]]


def shoot(layer, to_surface, size, rng, *, snr, blur=0.0):
    """Photograph a layer; `to_surface` takes px of the photograph to px of the layer."""
    x, y = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    places = to_surface(np.stack([x.ravel(), y.ravel()], 1))
    middle = np.add([size[0] / 2, size[1] / 2], [[0, 0], [1, 0], [0, 1]])
    corner = to_surface(middle)
    spacing = np.sqrt(abs(np.linalg.det(corner[1:] - corner[0])))
    limit = np.array(layer.shape[::-1]) - 1
    known = np.all((places >= 0) & (places <= limit), 1)
    # Only what is in view, and what the blur and the spline reach, is worth the time.
    low = np.clip(places.min(0).astype(int) - 40, 0, limit - 80)
    high = np.clip(places.max(0).astype(int) + 40, low + 80, limit + 1)
    part = np.ascontiguousarray(layer[low[1] : high[1], low[0] : high[0]])
    soft = cv2.GaussianBlur(part, (0, 0), 0.45 * max(spacing, 1) * (1 + blur))
    picture = ndimage.map_coordinates(soft, (places - low).T[::-1], order=3, mode="nearest")
    picture = np.where(known, picture, 0.02).reshape(size[1], size[0])
    noise = rng.normal(0, 1, picture.shape) * np.sqrt(np.clip(picture, 0.01, None) * 0.4) / snr
    return (picture + noise).astype(np.float32)


def frame(size, surface: Surface, share: float = SEEN_SHARE) -> Affine:
    """Return picture px → surface px of a picture that shows the middle of a surface, upright."""
    extent = np.array(surface.visible.shape[::-1], float)
    scale = float((share * extent / size).min())
    shift = (extent - 1) / 2 - scale * (np.array(size, float) - 1) / 2
    return Affine(np.column_stack([scale * np.eye(2), shift]))


def view(rng, size, other, scale, *, turn, shift, tilt=0.04, mirror=False):
    """Return reference px → target px: similarity about the centres, perspective, lens."""
    w, h = size
    angle = np.deg2rad(turn)
    linear = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    linear = linear @ np.diag([-1.0 if mirror else 1.0, 1.0])
    centre, middle = np.array([w - 1, h - 1]) / 2, np.array(other, float) / 2 - 0.5
    move = middle - linear @ (centre + np.array(shift) * (w, h))
    matrix, to_centre, back = np.eye(3), np.eye(3), np.eye(3)
    to_centre[:2, 2], back[:2, 2] = -centre, centre
    matrix[2, :2] = rng.uniform(-tilt, tilt, 2) / w
    lens = Lens(middle, max(other) / 2, (rng.uniform(-0.02, 0.02), rng.uniform(-0.004, 0.004)))
    return Composed(
        Homography(back @ matrix @ to_centre), Affine(np.column_stack([linear, move])), lens
    )


FAMILIES = ("campaign", "turned", "scaled", "shifted", "noisy", "mirrored", "all", "covered")


def right_pair(studio: Studio, rng: np.random.Generator, number: int):
    """Return (name, reference, target, true map, px of the target that show the object)."""
    family = FAMILIES[number % len(FAMILIES)]
    kind = KINDS[(number // len(FAMILIES)) % len(KINDS)]
    everything = family == "all"
    scale = rng.uniform(0.7, 1.8)
    if family == "scaled" or everything:
        scale = float(np.exp(rng.uniform(np.log(0.2), np.log(5))))
    turned = family in ("turned", "mirrored") or everything
    turn = rng.uniform(-180, 180) if turned else rng.normal(0, 1.5)
    shift = (
        rng.uniform(-0.4, 0.4, 2) if family == "shifted" or everything else rng.normal(0, 0.02, 2)
    )
    noisy = family == "noisy" or everything
    snr = np.exp(rng.uniform(np.log(10), np.log(30))) if noisy else rng.uniform(30, 100)
    mirror = family == "mirrored" or (everything and rng.uniform() < 0.25)
    # The finer picture holds the coarser one's 360 px times the ratio, 1,200 px at most.
    long = min(COARSE_PX * max(1.0, 1 / scale), 1200.0)
    size = (round(long), round(0.75 * long))
    other = (round(size[0] * scale), round(size[1] * scale))
    surface, cloth = studio.pick(rng, 2)
    truth = view(rng, size, other, scale, turn=turn, shift=shift, mirror=mirror)
    home = frame(size, surface)
    there = Composed(truth.inverse, home)
    reference = shoot(surface.layer("visible"), home, size, rng, snr=60 if not noisy else snr)
    target = shoot(surface.layer(kind), there, other, rng, snr=snr, blur=rng.uniform(0, 0.8))
    shown = np.ones(target.shape, bool)
    if family == "covered":
        rows, columns = (
            np.mgrid[: other[1], : other[0]] / np.array(other[::-1])[:, None, None] - 0.5
        )
        angle = rng.uniform(0, 2 * np.pi)
        shown = columns * np.cos(angle) + rows * np.sin(angle) < rng.uniform(-0.05, 0.05)
        over = shoot(cloth.layer(kind), frame(other, cloth, 0.4), other, rng, snr=snr)
        target = np.where(shown, target, over)
    return f"{family}/{kind}", reference, target, truth, shown


IMPOSTORS = ("other", "other", "framed", "blank", "ornament", "elsewhere", "noise", "other")


def impostor(studio: Studio, rng: np.random.Generator, number: int):
    """Return (name, reference, target) of a pair that has no true map."""
    name = IMPOSTORS[number % len(IMPOSTORS)]
    size = (400, 300)
    one, two = studio.pick(rng, 2)
    home = frame(size, one, rng.uniform(0.4, 0.9))
    a = shoot(one.layer("visible"), home, size, rng, snr=60)
    if name == "blank":
        y, x = np.mgrid[: size[1], : size[0]]
        b = 0.5 + 3e-4 * x * rng.normal() + 3e-4 * y * rng.normal()
        b = b + rng.normal(0, rng.choice((0.002, 0.01)), b.shape)
    elif name == "noise":
        b = ndimage.gaussian_filter(rng.normal(0, 1, a.shape), rng.uniform(0.3, 4))
        b = 0.4 + 0.1 * b / b.std()
    elif name == "ornament":
        a, b = ornaments(rng, size)
    elif name == "elsewhere":
        half = frame((size[0] // 2, size[1]), one, 0.45)
        apart = np.array([[0.26 * one.visible.shape[1], 0.0]])
        sides = [
            Composed(half, Affine(np.column_stack([np.eye(2), s * apart[0]]))) for s in (-1, 1)
        ]
        a, b = (shoot(one.layer("visible"), m, (200, 300), rng, snr=60) for m in sides)
    else:
        kind = KINDS[rng.integers(len(KINDS))]
        scale = np.exp(rng.uniform(np.log(0.5), np.log(2)))
        other = (round(size[0] * scale), round(size[1] * scale))
        if name == "framed":
            other, scale = size, 1.0
        turn = rng.uniform(-180, 180) if rng.uniform() < 0.5 else 0.0
        map_ = view(rng, size, other, scale, turn=turn, shift=(0, 0))
        b = shoot(two.layer(kind), Composed(map_.inverse, frame(size, two)), other, rng, snr=50)
        if name == "framed":
            _frame(rng, a, b)
    return name, a.astype(np.float32), b.astype(np.float32)


def bent(rng: np.random.Generator, size) -> Polynomial:
    """Return reference px → reference px bent by up to `BEND_PX` at the rim, a random cubic."""
    x, y = np.meshgrid(np.linspace(0, size[0] - 1, 21), np.linspace(0, size[1] - 1, 17))
    points = np.stack([x.ravel(), y.ravel()], 1)
    u, v = (2 * points / np.array(size) - 1).T
    terms = np.stack([u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3], 1)
    field = terms @ rng.normal(0, 1, (terms.shape[1], 2))
    field *= rng.uniform(0, BEND_PX) / np.abs(field).max()
    return Polynomial.fit(points, points + field, order=3)


def bent_pair(studio: Studio, rng: np.random.Generator, size=(400, 300)):
    """Return (reference, target, true map, what of the reference's frame lost its detail)."""
    surface = studio.pick(rng, 1)[0]
    kind = ("visible", "inverted")[rng.integers(2)]
    scale = float(rng.uniform(0.8, 1.5))
    other = (round(size[0] * scale), round(size[1] * scale))
    truth = Composed(
        bent(rng, size),
        view(rng, size, other, scale, turn=rng.normal(0, 1.5), shift=rng.normal(0, 0.01, 2)),
    )
    home = frame(size, surface)
    reference = shoot(surface.layer("visible"), home, size, rng, snr=60)
    target = shoot(surface.layer(kind), Composed(truth.inverse, home), other, rng, snr=60)
    blank = cv2.GaussianBlur(target, (0, 0), 30.0)
    blank += rng.normal(0, 0.006, blank.shape).astype(np.float32)
    from_, part = rng.integers(4), rng.uniform(0.25, 0.67)
    rows, columns = np.mgrid[: other[1], : other[0]] / np.array(other[::-1])[:, None, None]
    lost = (rows, columns, 1 - rows, 1 - columns)[from_] > 1 - part
    return reference, np.where(lost, blank, target), truth, lost


def _frame(rng: np.random.Generator, *images: np.ndarray) -> None:
    """Put the same easel, frame and dust on the sensor around two different paintings."""
    border = rng.uniform(0.1, 0.8, 30)
    for image in images:
        image[:24] = image[-24:] = 0.15
        image[:, :24] = image[:, -24:] = 0.15
        for k, level in enumerate(border):
            image[6:12, 12 * k + 14 : 12 * k + 20] = level
        image += rng.normal(0, 0.004, image.shape).astype(np.float32)
    for u, v in rng.integers(30, 270, (25, 2)):
        for image in images:
            image[u : u + 2, v : v + 2] *= 0.6


def ornaments(rng: np.random.Generator, size) -> tuple[np.ndarray, np.ndarray]:
    """Return two views of one repeated ornament, shifted by anything: no view tells which."""
    period = int(rng.integers(14, 60))
    tile = ndimage.gaussian_filter(rng.normal(0, 1, (period, period)), 1.6, mode="wrap")
    tile /= tile.std()
    rows, columns = np.mgrid[: size[1], : size[0]].astype(float)
    views = []
    for dy, dx in (np.zeros(2), rng.uniform(0, period, 2)):
        places = np.stack([(rows + dy) % period, (columns + dx) % period])
        view = 0.5 + 0.1 * ndimage.map_coordinates(tile, places, order=1, mode="grid-wrap")
        views.append(view + rng.normal(0, 0.008, view.shape))
    return views[0], views[1]
