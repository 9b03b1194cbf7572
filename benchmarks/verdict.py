"""How often a registration succeeds, what each class of verdict is worth, and what unlike light does to both.

    python benchmarks/verdict.py battery [--pairs 320] [--impostors 1000]
    python benchmarks/verdict.py classes [--pairs 200] [--real 160] [--bent 40] [--copies 40] [--impostors 100]
    python benchmarks/verdict.py unlike [--pairs 100] [--impostors 200]

Each takes `--seed N`, `--json OUT` and `--results FILE`. The battery images one painted surface twice through known maps: any rotation, scale 0.2 to 5, shifted by up to
40 % each way, SNR from 10, visible, near infrared or inverted, mirrored, half covered; an impostor has no true map. The
classes add bent surfaces of which a part lost its detail, copies (another panel by the same pattern, with strokes and cracks of its own), and
real captures: two channels of one photograph, or a band twice, of which one is cut, turned, scaled, bent, partly covered or blanked. Unlike light is two lenses of one
camera at opposite ends of its spectrum, a colour camera with a mosaic's bands, and "heat", of which tones are mixed anew from place to place.

A map is right where it is at most 0.5 px wrong in the mean over what both show of the object (unlike light: 1 px), and, by class, at most 2 %
of that is off by more than 1 px; px are of the reference, or of the target where that is coarser.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from results import add_option, record
from scipy import ndimage
from scipy.spatial import cKDTree

from levkas.geometry.transforms import Affine, Composed, Homography, Lens, Polynomial
from levkas.readers.frames import read_frame
from levkas.registration import BandImage, RegistrationRefused, register
from levkas.registration.uncertainty import NINE_OF_TEN

DATA = Path(
    os.environ.get("LEVKAS_REAL_DATA", Path(__file__).resolve().parents[2] / "shared" / "data")
)
SURFACE = (2200, 1650)
SEEN_SHARE = 0.55
COARSE_PX = 360
PAINTED = 12
BEND_PX = 6.0
KINDS = ("visible", "visible", "infrared", "inverted")
SIZE = (400, 300)
RIGHT_PX, UNLIKE_PX, OFF_PX, OFF_SHARE = 0.5, 1.0, 1.0, 0.02


# --- surfaces, and pictures of them


class Surface:
    """What a painting reflects, (h, w) float32 0..1, in the visible and in the near infrared."""

    def __init__(self, visible: np.ndarray, infrared: np.ndarray) -> None:
        self.visible, self.infrared = visible.astype(np.float32), infrared.astype(np.float32)

    def layer(self, kind: str) -> np.ndarray:
        """Return reflectance as a camera of `kind` sees it."""
        if kind == "inverted":
            return 0.95 - self.visible
        return self.infrared if kind == "infrared" else self.visible


def paint(rng: np.random.Generator, pattern: np.random.Generator | None = None) -> Surface:
    """Paint patches of pigment, brush strokes of all sizes and cracks; a `pattern` draws the patches of several panels."""
    drawn = rng if pattern is None else pattern
    w, h = SURFACE
    rows, columns = np.mgrid[0:h:4, 0:w:4]
    places = np.stack([rows.ravel(), columns.ravel()], 1)
    near = cKDTree(drawn.uniform(0, 1, (500, 2)) * (h, w)).query(places, k=1)[1]
    pigment = (near % 14).reshape(rows.shape).astype(np.uint8)
    pigment = cv2.resize(pigment, (w, h), interpolation=cv2.INTER_NEAREST)
    wobble = [90 * _grain(drawn, (12, 12)) / 8 for _ in "xy"]
    x, y = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    pigment = cv2.remap(pigment, x + wobble[0], y + wobble[1], cv2.INTER_NEAREST)
    distance = cKDTree(rng.uniform(0, 1, (2500, 2)) * (h, w)).query(places, k=2)[0]
    edge = cv2.resize((distance[:, 1] - distance[:, 0]).reshape(rows.shape), (w, h))
    cracks = np.exp(-np.square(edge / 2.5))
    sizes = ((0.5, 1.5), (0.7, 4.0), (0.7, 9.0), (0.7, 22.0))
    strokes = sum(a * _grain(rng, (s, 2.5 * s)) for a, s in sizes)
    visible = drawn.uniform(0.08, 0.75, 14)
    infrared = np.clip(0.5 + 0.2 * drawn.normal(0, 1, 14), 0.1, 0.85)
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
    found = []
    for path in sorted((DATA / "paintings").glob("*.jpg")):
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


# --- pairs with a true map, and impostors


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
    size = SIZE
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


def bent_pair(studio: Studio, rng: np.random.Generator, size=SIZE):
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


def copy_pair(rng: np.random.Generator, number: int):
    """Return (name, reference, target) of two panels by one pattern: strokes and cracks are each panel's own."""
    one, other = (paint(rng, np.random.default_rng([17, number])) for _ in "ab")
    home = frame(SIZE, one)
    truth = view(rng, SIZE, SIZE, 1.0, turn=rng.normal(0, 1.5), shift=rng.normal(0, 0.02, 2))
    a = shoot(one.layer("visible"), home, SIZE, rng, snr=60)
    kind = KINDS[number % len(KINDS)]
    b = shoot(other.layer(kind), Composed(truth.inverse, home), SIZE, rng, snr=60)
    return f"copy, {kind}", a, b


# --- real captures


def real_bands() -> dict[str, list[np.ndarray]]:
    """Return bands of one exposure each that lie on one another, (h, w) float32, by the picture's name."""
    found = {}
    for path in sorted((DATA / "paintings").glob("*.jpg")):
        image = cv2.imread(str(path)).astype(np.float32)
        found[path.stem] = [image[..., c] for c in range(3)]
    for folder in ("board", "scene1", "scene2"):
        kinect = cv2.imread(str(DATA / f"silios-kinect/{folder}/2020511_kinect_hd_rgb.png"))
        half = cv2.resize(kinect, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        found[f"kinect {folder}"] = [half[..., c].astype(np.float32) for c in range(3)]
        path = DATA / f"silios-kinect/{folder}/2020511_multispectral_camera.png"
        mosaic = np.asarray(read_frame(path), np.float32).squeeze()
        h, w = (n // 3 * 3 for n in mosaic.shape)
        found[f"silios {folder}"] = [mosaic[1:h:3, 1:w:3]]  # its bands lie up to 0.4 px apart
    for number in ("0000", "0001"):
        for lens in range(1, 6):
            path = DATA / f"rededge-5lens/IMG_{number}_{lens}.tif"
            band = np.asarray(read_frame(path), np.float32).squeeze()
            half = cv2.resize(band, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            found[f"rededge {number} {lens}"] = [half]
    for path in sorted((DATA / "stain-landmarks").rglob("*.jpg")):
        image = cv2.imread(str(path)).astype(np.float32)
        if min(image.shape[:2]) >= SIZE[1]:
            found[f"tissue {path.stem}"] = [image[..., c] for c in range(3)]
    return found


def real_pair(pictures: dict[str, list[np.ndarray]], rng: np.random.Generator):
    """Return (name, reference, target, true map, what of the target shows the object)."""
    names = list(pictures)
    name, other = (names[k] for k in rng.permutation(len(names))[:2])
    first, second = (pictures[name][k] for k in rng.integers(len(pictures[name]), size=2))
    inverted = rng.uniform() < 0.15
    h, w = first.shape
    ratio = min(0.9 * w / SIZE[0], 0.9 * h / SIZE[1], float(rng.uniform(1.0, 1.6)))
    corner = rng.uniform(0, [w - 1 - ratio * SIZE[0], h - 1 - ratio * SIZE[1]])
    home = Affine(np.column_stack([ratio * np.eye(2), corner]))
    scale = float(np.exp(rng.uniform(np.log(0.5), np.log(2.0))))
    size = (round(SIZE[0] * scale), round(SIZE[1] * scale))
    turn = rng.uniform(-180, 180) if rng.uniform() < 0.3 else rng.normal(0, 2)
    shift = rng.uniform(-0.35, 0.35, 2) if rng.uniform() < 0.3 else rng.normal(0, 0.03, 2)
    truth = view(rng, SIZE, size, scale, turn=turn, shift=shift)
    kind = "plain"
    if rng.uniform() < 0.3:
        truth, kind = Composed(bent(rng, SIZE), truth), "bent"
    reference = sample(first, home, SIZE)
    target = sample(second, Composed(truth.inverse, home), size)
    target = target.max() - target if inverted else target
    shown = np.ones(target.shape, bool)
    part = rng.uniform()
    if part < 0.4:
        rows, columns = np.mgrid[: size[1], : size[0]] / np.array(size[::-1])[:, None, None] - 0.5
        angle = rng.uniform(0, 2 * np.pi)
        shown = columns * np.cos(angle) + rows * np.sin(angle) < rng.uniform(-0.1, 0.3)
        if part < 0.2:
            over = cv2.resize(pictures[other][0], size, interpolation=cv2.INTER_AREA)
            kind += ", covered"
        else:
            over = cv2.GaussianBlur(target, (0, 0), 30.0)
            kind += ", blank"
        target = np.where(shown, target, over)
        if "blank" in kind:
            shown = np.ones(target.shape, bool)  # the object is there, if without detail
    for image in (reference, target):
        image += rng.normal(0, image.std() / rng.uniform(10, 60), image.shape).astype(np.float32)
    return f"real, {kind}", reference, target, truth, shown, name


def sample(picture: np.ndarray, to_picture, size) -> np.ndarray:
    """Return a picture at places of another, (h, w) float32, 0.02 of its range outside of it."""
    x, y = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    places = to_picture(np.stack([x.ravel(), y.ravel()], 1))
    step = to_picture(np.add([size[0] / 2, size[1] / 2], [[0, 0], [1, 0], [0, 1]]))
    spacing = np.sqrt(abs(np.linalg.det(step[1:] - step[0])))
    soft = cv2.GaussianBlur(picture, (0, 0), 0.45 * max(spacing, 1.0))
    inside = np.all((places >= 0) & (places <= np.array(picture.shape[::-1]) - 1), 1)
    found = ndimage.map_coordinates(soft, places.T[::-1], order=3, mode="nearest")
    return (
        np.where(inside, found, 0.02 * picture.max()).reshape(size[1], size[0]).astype(np.float32)
    )


# --- unlike light


def lens_pairs() -> list[tuple[str, np.ndarray, np.ndarray, object]]:
    """Return (name, picture, other picture, map between them) of lenses and cameras far apart in the spectrum."""
    found = []
    for number in ("0000", "0001"):
        lenses = {
            lens: np.asarray(
                read_frame(DATA / f"rededge-5lens/IMG_{number}_{lens}.tif"), np.float32
            ).squeeze()
            for lens in range(1, 6)
        }
        for one, other in ((1, 4), (2, 4), (3, 4), (1, 5), (3, 5)):
            found.append((f"lenses {number} {one} {other}", lenses[one], lenses[other]))
    for folder in ("board", "scene1", "scene2"):
        kinect = cv2.imread(str(DATA / f"silios-kinect/{folder}/2020511_kinect_hd_rgb.png"))
        path = DATA / f"silios-kinect/{folder}/2020511_multispectral_camera.png"
        mosaic = np.asarray(read_frame(path), np.float32).squeeze()
        h, w = (n // 3 * 3 for n in mosaic.shape)
        for channel, (row, column) in ((0, (2, 2)), (2, (0, 0))):
            band = mosaic[row:h:3, column:w:3]
            found.append(
                (f"cameras {folder} {channel}", band, kinect[..., channel].astype(np.float32))
            )
    pairs = []
    for name, first, second in found:
        try:
            known = register(
                [BandImage.of("a", first)], [BandImage.of("b", second)], reference_band="a"
            )
        except RegistrationRefused:
            continue
        if known.verdict.decision != "refuse":
            pairs.append((name, first, second, known.transforms["b"]))
    return pairs


def heat(rng: np.random.Generator, picture: np.ndarray) -> np.ndarray:
    """Return a picture of the same outlines in which tones are mixed anew from place to place."""

    def field(share: float) -> np.ndarray:
        sigma = share * max(picture.shape)
        coarse = rng.normal(size=(48, 48)).astype(np.float32)
        soft = cv2.GaussianBlur(coarse, (0, 0), 48 * share)
        values = cv2.resize(soft, picture.shape[::-1], interpolation=cv2.INTER_CUBIC)
        return values / max(values.std(), 1e-9) if sigma else values

    tone = cv2.GaussianBlur(picture, (0, 0), 2.0)
    tone = (tone - tone.min()) / np.ptp(tone)
    waves = [
        field(0.08) * np.cos(2 * np.pi * (f * tone + rng.uniform())) / f for f in (0.5, 1, 1.5)
    ]
    mixed = sum(waves)
    return (mixed / mixed.std() + 0.5 * field(0.15)).astype(np.float32)


def scene(name: str) -> str:
    """Return what a picture shows: pictures of one scene are no impostors of one another."""
    kind, *rest = name.split()
    if kind in ("kinect", "silios", "cameras"):
        return "vine"  # one view, with a chart before it or without
    if kind in ("rededge", "lenses"):
        return rest[0]
    return rest[0][:4] if kind == "tissue" else kind


def unlike_pair(rng: np.random.Generator, lenses: list, pictures: dict, *, same: bool = True):
    """Return (name, reference, target, true map or None, what of the target shows the object)."""
    if rng.uniform() < 0.5:
        names = list(pictures)
        name, *others = (names[k] for k in rng.permutation(len(names)))
        other = next(one for one in others if scene(one) != scene(name))
        first = pictures[name][0]
        second = heat(rng, first if same else pictures[other][0])
        between, kind, most = Affine.identity(), "heat", 1.5
        if not same:
            first, second = (
                part[: min(first.shape[0], second.shape[0]), : min(first.shape[1], second.shape[1])]
                for part in (first, second)
            )
    else:
        drawn = [lenses[k] for k in rng.permutation(len(lenses))]
        name, first, second, between = drawn[0]
        kind, most = name.split()[0], 5.0
        if not same:
            _, _, second, between = next(one for one in drawn if scene(one[0]) != scene(name))
    size = (int(rng.integers(180, 401)), int(rng.integers(140, 301)))
    h, w = first.shape
    ratio = min(0.95 * w / size[0], 0.95 * h / size[1], float(rng.uniform(1.2, most)))
    corner = rng.uniform(0, [w - 1 - ratio * size[0], h - 1 - ratio * size[1]])
    home = Affine(np.column_stack([ratio * np.eye(2), corner]))
    scale = float(np.exp(rng.uniform(np.log(0.5), np.log(1.5))))
    other_size = (round(size[0] * scale), round(size[1] * scale))
    turn = rng.uniform(-180, 180) if rng.uniform() < 0.2 else rng.normal(0, 2)
    truth = view(rng, size, other_size, scale, turn=turn, shift=rng.normal(0, 0.05, 2))
    reference = sample(first, home, size)
    target = sample(second, Composed(truth.inverse, home, between), other_size)
    target = cv2.GaussianBlur(target, (0, 0), float(rng.uniform(0.3, 2.0)))
    for image in (reference, target):
        image += rng.normal(0, image.std() / rng.uniform(6, 30), image.shape).astype(np.float32)
    shown = sample(np.ones_like(second), Composed(truth.inverse, home, between), other_size) > 0.9
    return (
        kind if same else f"impostor, {kind}",
        reference,
        target,
        truth if same else None,
        shown,
        name,
    )


# --- judged and told


def judged(name, reference, target, truth=None, shown=None, picture="") -> dict:
    """Register a pair; return the numbers of its verdict and how wrong its map is, in px."""
    start = time.perf_counter()
    bands = [[BandImage.of("grey", image)] for image in (reference, target)]
    row = {
        "name": name,
        "picture": picture,
        "true": truth is not None,
        "decision": "refuse",
        "reasons": [],
    }
    try:
        found = register(*bands, reference_band="grey")
    except RegistrationRefused as refused:
        return row | {"reasons": [str(refused)], "seconds": time.perf_counter() - start}
    row |= found.verdict.to_dict()
    if truth is not None:
        shown = np.ones(target.shape, bool) if shown is None else shown
        numbers = row["numbers"].get("sensor", row["numbers"])
        box = numbers.get("verification", numbers).get("box") or [0, 0, *reference.shape[::-1]]
        row |= errors(found, truth, box, shown)
    return row | {"seconds": time.perf_counter() - start}


def errors(found, truth, box, shown) -> dict[str, float]:
    """Return mean error, share that is off, and share within nine-of-ten circles, of what both show of the object.

    `box` is where the registration sees the object: a database publishes that part of the reference.
    """
    x, y = (np.linspace(box[k] + 2, box[k] + box[2 + k] - 3, n) for k, n in ((0, 41), (1, 31)))
    points = np.stack([v.ravel() for v in np.meshgrid(x, y)], 1)
    places = truth(points)
    both = np.all((places >= 0) & (places <= np.array(shown.shape[::-1]) - 1), 1)
    column, row = np.rint(places[both]).astype(int).T
    both[both] = shown[row, column]
    middle = np.array([x.mean(), y.mean()])
    spread = truth(middle + np.array([[0, 0], [1, 0], [0, 1]]))
    scale = min(1.0, float(np.sqrt(abs(np.linalg.det(spread[1:] - spread[0])))))
    points = points[both]
    miss = np.linalg.norm(truth.inverse(found.transforms["grey"](points)) - points, axis=1)
    miss = np.where(np.isfinite(miss), miss, 1e3)
    held = miss <= NINE_OF_TEN * found.sigma["grey"](points)
    return {
        "error": float(miss.mean() * scale),
        "off": float((miss * scale > OFF_PX).mean()),
        "held": float(held.mean()),
    }


def tell(rows: list[dict], right: Callable[[dict], bool]) -> Counter:
    """Print right and wrong maps by class; return the counts of all, by (right, decision)."""
    print(f"{'pairs':28s} {'n':>4s}  right: accept doubtful refuse  wrong: accept doubtful refuse")
    for name in [*sorted({r["name"] for r in rows}), "all"]:
        group = [r for r in rows if name in ("all", r["name"])]
        said = Counter((right(r), r["decision"]) for r in group)
        cells = [said[good, one] for good in (True, False) for one in ("accept", "warn", "refuse")]
        print(f"{name:28s} {len(group):4d} ", *(f"{n:8d}" for n in cells))
    for r in rows:
        if not right(r) and r["decision"] == "accept":
            print("  accepted and wrong:", r["name"], f"{r.get('error', 1e3):.2f} px")
    return said


def battery(given: argparse.Namespace, draw: Callable) -> tuple[list, Callable]:
    """Return makers of pairs, and what a run of them says."""
    studio = Studio(given.seed)
    makers = [
        (given.pairs or 320, lambda k: right_pair(studio, draw(0, k), k)),
        (given.impostors or 1000, lambda k: impostor(studio, draw(1, k), k)),
    ]

    def figures(rows: list[dict]) -> dict[str, float]:
        said = tell(rows, lambda r: r["true"] and r.get("error", 1e3) <= RIGHT_PX)
        pairs = [r for r in rows if r["true"]]
        good = said[True, "accept"] + said[True, "warn"]
        passed = sum(not r["true"] and r["decision"] != "refuse" for r in rows)
        return {
            f"{len(pairs):,} true pairs: right, not refused": 100 * good / max(len(pairs), 1),
            f"{len(rows) - len(pairs):,} impostors: accepted": passed,
        }

    return makers, figures


def classes(given: argparse.Namespace, draw: Callable) -> tuple[list, Callable]:
    """Return makers of pairs, and what a run of them says."""
    studio, pictures = Studio(given.seed), real_bands()
    makers = [
        (given.real, lambda k: real_pair(pictures, draw(0, k))),
        (given.pairs or 200, lambda k: right_pair(studio, draw(1, k), k)),
        (given.bent, lambda k: ("bent, part blank", *bent_pair(studio, draw(2, k))[:3])),
        (given.copies, lambda k: copy_pair(draw(4, k), k)),
        (given.impostors or 100, lambda k: ("impostor", *impostor(studio, draw(3, k), k)[1:])),
    ]

    def is_right(row: dict) -> bool:
        return row["true"] and row.get("error", 1e3) <= RIGHT_PX and row["off"] <= OFF_SHARE

    def figures(rows: list[dict]) -> dict[str, float]:
        said = tell(rows, is_right)
        accepted = said[True, "accept"] + said[False, "accept"]
        right = sum(n for (good, _), n in said.items() if good)
        doubtful = said[True, "warn"] + said[False, "warn"]
        return {
            "accepted maps that are right": 100 * said[True, "accept"] / max(accepted, 1),
            "right maps that are accepted": 100 * said[True, "accept"] / max(right, 1),
            "doubtful maps that are wrong somewhere": 100 * said[False, "warn"] / max(doubtful, 1),
        }

    return makers, figures


def unlike(given: argparse.Namespace, draw: Callable) -> tuple[list, Callable]:
    """Return makers of pairs, and what a run of them says."""
    lenses, pictures = lens_pairs(), real_bands()
    makers = [
        (given.pairs or 100, lambda k: unlike_pair(draw(1, k), lenses, pictures)),
        (given.impostors or 200, lambda k: unlike_pair(draw(0, k), lenses, pictures, same=False)),
    ]

    def figures(rows: list[dict]) -> dict[str, float]:
        tell(rows, lambda r: r["true"] and r.get("error", 1e3) <= UNLIKE_PX)
        pairs = [r for r in rows if r["true"]]
        said = Counter((r.get("error", 1e3) <= UNLIKE_PX, r["decision"]) for r in pairs)
        impostors = [r["decision"] for r in rows if not r["true"]]
        return {
            f"unlike light, {len(pairs)} pairs: right, accepted": said[True, "accept"],
            "right, doubtful": said[True, "warn"],
            "wrong, accepted": said[False, "accept"],
            f"{len(impostors)} impostors: not refused": sum(d != "refuse" for d in impostors),
        }

    return makers, figures


RUNS = {"battery": (battery, 1), "classes": (classes, 31), "unlike": (unlike, 51)}
"""Name → makers, seed."""


def main() -> None:
    """Register the pairs of one run, and say what came of them."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", choices=RUNS)
    for name, count in (("real", 160), ("bent", 40), ("copies", 40)):
        parser.add_argument(f"--{name}", type=int, default=count)
    for name in ("pairs", "impostors", "seed"):
        parser.add_argument(f"--{name}", type=int)
    parser.add_argument("--json", type=Path)
    add_option(parser)
    given = parser.parse_args()
    run, seed = RUNS[given.run]
    given.seed = seed if given.seed is None else given.seed
    makers, figures = run(
        given, lambda kind, number: np.random.default_rng([given.seed, kind, number])
    )
    rows = []
    for count, make in makers:
        for number in range(count):
            rows.append(judged(*make(number)))
            if given.json:
                given.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    record(given.results, "verdict", found := figures(rows))
    for name, value in found.items():
        print(f"{name}: {value:.4g}")
    print(f"seconds a pair, median {np.median([r['seconds'] for r in rows]):.2f}")


if __name__ == "__main__":
    main()
