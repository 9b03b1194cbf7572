"""Setups as scenes of Mitsuba 3, the extra ``levkas[render]``.

Mitsuba's world is right-handed with y upwards: ours with y turned round.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.colour.srgb import encode_srgb
from levkas.core.files import write_bytes
from levkas.core.problems import Problem
from levkas.planning.light import eye_of
from levkas.planning.spectra import GRID
from levkas.planning.tables import PlanRefused

if TYPE_CHECKING:
    from levkas.planning.setup import Lighting, StudioLamp, StudioSetup
    from levkas.planning.tables import StudioObjectKeys

FLIP = np.array([1.0, -1.0, 1.0])
LOBE_PIXELS = 1024
PX_PER_MM = 1.6
CUTOFF_DEG = 80.0
SHEET_MM = 60.0
"""How far before a lamp or a lens its sheet polariser stands."""


def load_mitsuba(*variants: str) -> Any:
    """Return Mitsuba with the first of `variants` that works here.

    The scalar ones work everywhere. The compiled ones are ten times faster, need LLVM 16 or newer, and
    with an older one end the process: none is asked for by itself.

    Raises
    ------
    PlanRefused
        ``E_NO_RENDERER`` where Mitsuba is not installed.
    """
    try:
        import mitsuba as mi
    except ImportError:
        raise PlanRefused(
            Problem(
                "E_NO_RENDERER", "pictures need Mitsuba, which is not installed",
                expected="mitsuba 3.6 or newer", fix="Install it: pip install 'levkas[render]'.",
            )
        ) from None  # fmt: skip
    known = mi.variants()
    for variant in variants:
        if variant not in known:
            continue
        mi.set_variant(variant)
        return mi
    raise PlanRefused(Problem("E_NO_RENDERER", "no variant of Mitsuba works", found=str(known)))


def flipped(point: np.ndarray) -> list[float]:
    """Return a point or direction in Mitsuba's world."""
    return [float(v) for v in np.asarray(point) * FLIP]


def lamp_objects(mi: Any, lamp: StudioLamp, name: str, *, spectral: bool = True) -> dict[str, Any]:
    """Return a lamp, and its sheet where it has one, as entries of a scene.

    Intensity is the lamp's candela along its axis; the spectrum its relative power.
    """
    aim = lamp.place + lamp.axis
    up = _across(lamp)
    frame = mi.ScalarTransform4f().look_at(flipped(lamp.place), flipped(aim), flipped(up))
    found: dict[str, Any] = {}
    if lamp.size_mm is not None:
        width, height = lamp.size_mm
        level = lamp.candela / (width * height)
        found[name] = {
            "type": "rectangle",
            "to_world": frame @ mi.ScalarTransform4f().scale([width / 2, height / 2, 1]),
            "emitter": {"type": "area", "radiance": _power(lamp, level, spectral)},
        }
    else:
        found[name] = _spot(mi, lamp, frame, spectral)
    if lamp.polariser:
        found[f"{name}-sheet"] = {
            "type": "rectangle",
            "to_world": frame
            @ mi.ScalarTransform4f().translate([0, 0, SHEET_MM])
            @ mi.ScalarTransform4f().scale([400, 400, 1]),
            "bsdf": {"type": "polarizer", "theta": 0.0 if lamp.polariser == "p" else 90.0},
        }
    return found


def _across(lamp: StudioLamp) -> np.ndarray:
    """The direction across the plane of the lamp and the object's normal."""
    across = np.cross(np.array([0.0, 0.0, 1.0]), lamp.place)
    size = float(np.linalg.norm(across))
    return across / size if size > 1e-6 else np.array([0.0, 1.0, 0.0])


def _power(lamp: StudioLamp, level: float, spectral: bool) -> Any:
    if not spectral:
        return {"type": "rgb", "value": [level] * 3}
    inside = (GRID >= 360) & (GRID <= 830)
    pairs = list(
        zip(GRID[inside].tolist(), (level * lamp.spectrum[inside] * 300).tolist(), strict=True)
    )
    return {"type": "spectrum", "value": pairs}


def _spot(mi: Any, lamp: StudioLamp, frame: Any, spectral: bool) -> dict[str, Any]:
    """A point whose lobe is a picture: Mitsuba's own falloff is none that lamps have."""
    spot = {
        "type": "spot",
        "to_world": frame,
        "intensity": _power(lamp, lamp.candela, spectral),
        "cutoff_angle": CUTOFF_DEG,
        "beam_width": CUTOFF_DEG - 1e-3,
    }
    if lamp.lobe.exponent == 0 and lamp.lobe.table is None:
        return {"type": "point", "position": flipped(lamp.place), "intensity": spot["intensity"]}
    # Where the light falls the lobe is a few degrees wide: a narrow cone gives the picture detail.
    cone = 25.0
    spot |= {"cutoff_angle": cone, "beam_width": cone - 1e-3}
    at = (np.arange(LOBE_PIXELS) + 0.5) / LOBE_PIXELS * 2 - 1
    x, y = np.meshgrid(at, at)
    cosine = 1 / np.sqrt(1 + (x * x + y * y) * np.tan(np.radians(cone)) ** 2)
    lobe = lamp.lobe(cosine).astype(np.float32)[..., None]
    spot["texture"] = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(lobe),
        "raw": True,
        "wrap_mode": "clamp",
    }
    return spot


def camera_object(
    mi: Any, eye: np.ndarray, size_mm: tuple[float, float], pixels: tuple[int, int], samples: int,
    *, centre: tuple[float, float] = (0.0, 0.0),
) -> dict[str, Any]:  # fmt: skip
    """Return a camera that sees `size_mm` around `centre` of the object's plane."""
    target = np.array([centre[0], centre[1], 0.0])
    # A shifted sensor, not a turned one: the axis stays along the object's normal.
    half = np.degrees(np.arctan(size_mm[0] / 2 / eye[2]))
    frame = mi.ScalarTransform4f().look_at(
        flipped(eye), flipped(np.array([eye[0], eye[1], 0.0])), [0, 1, 0]
    )
    return {
        "type": "perspective",
        "fov": float(2 * half),
        "fov_axis": "x",
        "to_world": frame,
        "near_clip": 1.0,
        "far_clip": 1e5,
        "principal_point_offset_x": float((target[0] - eye[0]) / size_mm[0]),
        "principal_point_offset_y": float((target[1] - eye[1]) / size_mm[1]),
        "film": {
            "type": "hdrfilm",
            "width": pixels[0],
            "height": pixels[1],
            "pixel_format": "rgb",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "stratified", "sample_count": samples, "seed": 0},
    }


def camera_sheet(mi: Any, lighting: Lighting, eye: np.ndarray) -> dict[str, Any]:
    """Return the sheet before the camera, crossed or parallel to the lamps', or nothing."""
    if lighting.camera_polariser is None:
        return {}
    lamp = next(x for x in lighting.lamps if x.polariser)
    along = lamp.place[:2] / np.linalg.norm(lamp.place[:2])
    axis = np.array([along[0], along[1], 0.0])
    if (lamp.polariser == "s") != (lighting.camera_polariser == "crossed"):
        axis = np.array([-along[1], along[0], 0.0])
    # The sheet's x passes; look_at puts x across `up` and the way it looks.
    up = np.cross(axis, [0.0, 0.0, 1.0])
    place = eye - [0, 0, SHEET_MM]
    frame = mi.ScalarTransform4f().look_at(
        flipped(place), flipped(place - [0, 0, 1.0]), flipped(up)
    )
    return {
        "camera-sheet": {
            "type": "rectangle",
            "to_world": frame @ mi.ScalarTransform4f().scale([300, 300, 1]),
            "bsdf": {"type": "polarizer", "theta": 0.0},
        }
    }


@dataclass(frozen=True, eq=False)
class Motif:
    """Maps over an object, (rows, columns), the first row at its top.

    Parameters
    ----------
    colour : ndarray, (rows, columns, 3)
        sRGB, 0 to 1.
    gold : ndarray
        Share of leaf, 0 to 1.
    height : ndarray
        mm above the bent board, recess included.
    details : dict
        Name of a close-up → (x, y) of its middle and its side, mm.
    """

    colour: np.ndarray
    gold: np.ndarray
    height: np.ndarray
    details: dict[str, tuple[float, float, float]]


def draw_motif(thing: StudioObjectKeys, *, rng: np.random.Generator) -> Motif:
    """Return the motif, drawn to an object's size; relief has the object's rms slope."""
    width, height = thing.size_mm
    columns, rows = round(width * PX_PER_MM) | 1, round(height * PX_PER_MM) | 1
    # Centimetres of an icon of 32 cm: the drawing scales with the shorter side.
    unit = min(width, height) / 320
    x = np.linspace(-width / 2, width / 2, columns)[None] / unit
    y = np.linspace(-height / 2, height / 2, rows)[:, None] / unit
    # The icon lies on its side: its top is at the left.
    u, v = y, x
    colour = np.empty((rows, columns, 3))
    colour[:] = (0.72, 0.58, 0.36)
    gold = np.zeros((rows, columns))
    inner = (np.abs(x * unit) < width / 2 - thing.border_mm) & (
        np.abs(y * unit) < height / 2 - thing.border_mm
    )
    colour[inner] = (0.80, 0.70, 0.48)
    robe = (np.abs(u) < 40 + 0.42 * (v + 60)) & (v > -20)
    garment = robe & (u > 4 - 0.10 * v)
    colour[robe] = (0.20, 0.13, 0.10)
    colour[garment] = (0.55, 0.14, 0.10)
    halo = np.hypot(u, v + 62) < 62
    gold[halo & inner] = 1.0
    face = np.hypot(u / 0.78, v + 58) < 34
    gold[face] = 0.0
    colour[face] = (0.62, 0.44, 0.28)
    folds = garment & (np.abs(np.mod(u * 0.9 + 0.55 * v + 6 * np.sin(v / 17), 34) - 17) < 3)
    colour[folds] = (0.80, 0.38, 0.28)
    hatch = robe & ~garment & (np.mod(u + 0.9 * v, 9) < 1.3) & (v > 15) & (v < 96)
    gold[hatch & inner] = 1.0
    gold = gold * inner
    relief = _relief(rows, columns, rng) * np.where(gold > 0, 0.5, 1.0)
    slope = np.sqrt(np.mean(np.square(np.gradient(relief, 1 / PX_PER_MM))))
    relief *= thing.relief_slope / slope if thing.relief_slope else 0.0
    edge = np.minimum(width / 2 - np.abs(x * unit), height / 2 - np.abs(y * unit))
    sunk = np.clip((edge - thing.border_mm) / thing.bevel_mm, 0, 1) * thing.recess_mm
    places = {
        "gold": (-95.0, 38.0), "varnish": (128.0, -32.0), "garment": (60.0, 45.0),
        "hatching": (50.0, -20.0),
    }  # fmt: skip
    details = {k: (a * unit, b * unit, 62.0 * unit) for k, (a, b) in places.items()}
    return Motif(np.clip(colour, 0, 1), gold, relief - sunk, details)


def _relief(rows: int, columns: int, rng: np.random.Generator) -> np.ndarray:
    """Brush strokes, long in one direction, and a net of cracks."""
    noise = rng.standard_normal((rows, columns))
    fx = np.fft.rfftfreq(columns)[None] * PX_PER_MM
    fy = np.fft.fftfreq(rows)[:, None] * PX_PER_MM
    strokes = np.exp(-((fx / 0.16) ** 2) - ((fy / 0.45) ** 2)) * (np.hypot(fx, fy) > 0.02)
    brush = np.fft.irfft2(np.fft.rfft2(noise) * strokes, (rows, columns))
    seeds = rng.uniform(0, 1, (260, 2)) * [rows, columns]
    from scipy.spatial import cKDTree

    grid = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), -1)
    near, _ = cKDTree(seeds).query(grid.reshape(-1, 2), k=2)
    crack = ((near[:, 1] - near[:, 0]) < 1.6).reshape(rows, columns)
    return brush / brush.std() - 2.0 * crack


WHOLE_PX, DETAIL_PX = 330, 150
VARIANT = "scalar_spectral_polarized"
"""The compiled variants are faster, but end the whole process where LLVM is older than 16."""
SAMPLES = 16
"""Rays a pixel, a square power of two."""


@dataclass(frozen=True, eq=False)
class Rendered:
    """Pictures of one lighting: linear sRGB over white, (rows, columns, 3)."""

    name: str
    title: str
    whole: np.ndarray
    details: dict[str, np.ndarray]


def render_sheet(setup: StudioSetup, path: str | Path, *, seed: int = 1) -> Path:
    """Write the contact sheet of all setups of a file, and of the best pair of lamps.

    Parameters
    ----------
    setup : StudioSetup
    path : path
        PNG.
    seed : int
        Of the painted motif and the search.

    Raises
    ------
    PlanRefused
        Where Mitsuba is not installed.
    """
    pictures = list(_render_setups(setup, seed))
    stream = io.BytesIO()
    lay_out(pictures, setup.bench.title).save(stream, "PNG", optimize=True)
    write_bytes(path, stream.getvalue())
    return Path(path)


def _render_setups(setup: StudioSetup, seed: int) -> Iterator[Rendered]:
    """Yield the pictures of one lighting after another."""
    mi = load_mitsuba(VARIANT)
    motif = draw_motif(setup.object, rng=np.random.default_rng(seed))
    panel = _panel(mi, setup.object, motif)
    for lighting in (*setup.lightings.values(), _best(setup, seed)):
        yield _render(mi, setup, lighting, motif, panel)


def _best(setup: StudioSetup, seed: int) -> Lighting:
    """The pair that the search finds, with the spectrum of the first lighting's lamp."""
    from levkas.planning.optimisation import judge_of, optimise

    judge = judge_of(setup)
    found = optimise(judge, rng=np.random.default_rng(seed)).best
    lamp = setup.lighting().lamps[0]
    pair = found.lighting(setup.object.size_mm, judge.lobe)
    lamps = tuple(replace(x, spectrum=lamp.spectrum) for x in pair.lamps)
    title = f"The pair that the search finds: {found.angle_deg:.0f}°"
    return replace(pair, name="best", title=title, lamps=lamps)


def _render(mi: Any, setup: StudioSetup, lighting: Lighting, motif: Motif, panel: Any) -> Rendered:
    eye, size = eye_of(setup), setup.object.size_mm
    scene: dict[str, Any] = {"type": "scene", "integrator": {"type": "volpath", "max_depth": 3}}
    for i, lamp in enumerate(lighting.lamps):
        scene |= lamp_objects(mi, lamp, f"lamp{i}")
    scene |= camera_sheet(mi, lighting, eye)
    board = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().scale([size[0] * 0.6, size[1] * 0.6, 1]),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 1.0}},
    }
    view = (size[0] * 1.04, size[1] * 1.04)
    white = _shoot(mi, {**scene, "board": board}, eye, view, (0, 0), 66, 4 * SAMPLES)
    white = _smooth(white)
    painted = {**scene, "panel": panel}
    whole = _shoot(mi, painted, eye, view, (0, 0), WHOLE_PX, SAMPLES)
    details = {}
    for name, (x, y, side) in motif.details.items():
        seen = _shoot(mi, painted, eye, (side, side), (x, y), DETAIL_PX, SAMPLES)
        details[name] = seen / _at(white, view, (x, y))
    return Rendered(lighting.name, lighting.title, whole / _grown(white, whole.shape), details)


def _shoot(
    mi: Any, scene: dict[str, Any], eye: np.ndarray, view: tuple[float, float],
    centre: tuple[float, float], width: int, samples: int,
) -> np.ndarray:  # fmt: skip
    pixels = (width, max(1, round(width * view[1] / view[0])))
    camera = camera_object(mi, eye, view, pixels, samples, centre=centre)
    made = mi.load_dict({**scene, "sensor": camera})
    return np.array(mi.render(made, seed=1))[..., :3].astype(float)


def _smooth(white: np.ndarray) -> np.ndarray:
    """Fit the white board with a quadric: its light has no detail, its render has noise."""
    rows, columns = white.shape[:2]
    y, x = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
    terms = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], -1)
    flat = terms.reshape(-1, terms.shape[-1])
    fitted = np.linalg.lstsq(flat, white.reshape(-1, 3), rcond=None)[0]
    return np.maximum((flat @ fitted).reshape(white.shape), 1e-12)


def _grown(white: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    rows = np.clip(((np.arange(shape[0]) + 0.5) / shape[0] * white.shape[0]).astype(int), 0, None)
    columns = ((np.arange(shape[1]) + 0.5) / shape[1] * white.shape[1]).astype(int)
    return white[np.ix_(rows, columns)]


def _at(white: np.ndarray, view: tuple[float, float], place: tuple[float, float]) -> np.ndarray:
    row = int((place[1] / view[1] + 0.5) * white.shape[0])
    return white[row, int((place[0] / view[0] + 0.5) * white.shape[1])]


def _panel(mi: Any, thing: StudioObjectKeys, motif: Motif) -> Any:
    """Return the bent, sunken, brushed panel as a mesh with paint, varnish and leaf."""
    rows, columns = motif.height.shape
    width, height = thing.size_mm
    along = np.linspace(-width / 2, width / 2, columns)[None].repeat(rows, 0)
    across = np.linspace(-height / 2, height / 2, rows)[:, None].repeat(columns, 1)
    points = np.stack([along, across, motif.height], -1)
    if thing.bend is not None:
        radius = thing.bend.radius_mm
        turn = (across if thing.bend.straight == "width" else along) / radius
        out, up = (radius + motif.height) * np.sin(turn), (radius + motif.height) * np.cos(turn)
        first, second = (along, out) if thing.bend.straight == "width" else (out, across)
        points = np.stack([first, second, up - radius], -1)
    points[..., 1] *= -1
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate(
        [np.stack([a, d, b], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)]
    )
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(_material(mi, thing, motif))
    mesh = mi.Mesh(
        "panel", rows * columns, len(faces), has_vertex_normals=True, has_vertex_texcoords=True,
        props=properties,
    )  # fmt: skip
    u = (np.arange(columns) + 0.5) / columns
    v = (np.arange(rows) + 0.5) / rows
    texcoords = np.stack(np.meshgrid(u, v), -1)
    found = mi.traverse(mesh)
    found["vertex_positions"] = np.ascontiguousarray(points, np.float32).ravel()
    found["vertex_texcoords"] = np.ascontiguousarray(texcoords, np.float32).ravel()
    found["faces"] = np.ascontiguousarray(faces, np.uint32).ravel()
    found["vertex_normals"] = _normals(points).astype(np.float32).ravel()
    found.update()
    return mesh


def _normals(points: np.ndarray) -> np.ndarray:
    """Normals of a grid of points whose rows go down."""
    down, right = np.gradient(points, axis=0), np.gradient(points, axis=1)
    normals = np.cross(down, right)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def _material(mi: Any, thing: StudioObjectKeys, motif: Motif) -> dict[str, Any]:
    colour = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.round(255 * motif.colour).astype(np.uint8)),
    }
    paint: dict[str, Any] = {"type": "diffuse", "reflectance": colour}
    if thing.varnish is not None:
        paint = {
            "type": "pplastic",
            "distribution": "ggx",  # its default is Beckmann
            "alpha": thing.varnish.roughness,
            "int_ior": thing.varnish.index,
            "diffuse_reflectance": colour,
        }
    if thing.gold is None:
        return {"type": "twosided", "bsdf": paint} if thing.varnish is None else paint
    leaf = {
        "type": "blendbsdf",
        "weight": 0.03,
        "metal": {
            "type": "roughconductor",
            "material": "Au",
            "distribution": "ggx",
            "alpha": thing.gold.roughness,
        },
        "ground": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.5}},
    }
    mask = mi.Bitmap(motif.gold.astype(np.float32)[..., None])
    weight = {"type": "bitmap", "bitmap": mask, "raw": True, "filter_type": "nearest"}
    return {"type": "blendbsdf", "weight": weight, "paint": paint, "leaf": leaf}


GAP, HEAD, LABEL = 14, 64, 26
PAPER, INK, SOFT = (24, 22, 18), (236, 231, 218), (167, 159, 141)


def lay_out(pictures: Sequence[Rendered], title: str) -> Any:
    """Return the sheet as a PIL image: a row a setup, the whole object and its close-ups."""
    from PIL import Image, ImageDraw, ImageFont

    names = list(pictures[0].details)
    tall = max(p.whole.shape[0] for p in pictures)
    wide = pictures[0].whole.shape[1]
    width = GAP + wide + GAP + len(names) * (tall + GAP)
    row = tall + LABEL + GAP
    sheet = Image.new("RGB", (width, HEAD + len(pictures) * row), PAPER)
    draw = ImageDraw.Draw(sheet)
    big, small = ImageFont.load_default(21), ImageFont.load_default(14)
    draw.text((GAP, 12), title or "Setups", INK, big)
    for k, name in enumerate(names):
        draw.text((GAP + wide + GAP + k * (tall + GAP), 40), name, SOFT, small)
    for i, picture in enumerate(pictures):
        top = HEAD + i * row
        sheet.paste(Image.fromarray(encode_srgb(picture.whole)), (GAP, top))
        for k, name in enumerate(names):
            detail = Image.fromarray(encode_srgb(picture.details[name])).resize((tall, tall), 3)
            sheet.paste(detail, (GAP + wide + GAP + k * (tall + GAP), top))
        words = f"{picture.name}: {picture.title}" if picture.title else picture.name
        draw.text((GAP, top + tall + 4), words, INK, small)
    return sheet
