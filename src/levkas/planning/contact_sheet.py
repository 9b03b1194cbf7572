"""Contact sheet of a camera's view under every setup, rendered with close-ups (Figure 4)."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.files import write_bytes
from levkas.planning.light import eye_of
from levkas.planning.mitsuba_scene import (
    Motif,
    camera_object,
    camera_sheet,
    draw_motif,
    lamp_objects,
    load_mitsuba,
)

if TYPE_CHECKING:
    from levkas.planning.setup import Lighting, StudioSetup
    from levkas.planning.tables import StudioObjectKeys

WHOLE_PX, DETAIL_PX = 330, 150
VARIANTS = ("scalar_spectral_polarized",)
"""The compiled variants are faster, but end the whole process where LLVM is older than 16."""


@dataclass(frozen=True, eq=False)
class Rendered:
    """Pictures of one lighting: linear sRGB over white, (rows, columns, 3)."""

    name: str
    title: str
    whole: np.ndarray
    details: dict[str, np.ndarray]


def render_sheet(
    setup: StudioSetup,
    path: str | Path,
    *,
    seed: int = 1,
    samples: int = 16,
    with_best: bool = True,
) -> Path:
    """Write the contact sheet of all setups of a file, and of the best pair of lamps.

    Parameters
    ----------
    setup : StudioSetup
    path : path
        PNG.
    seed : int
        Of the painted motif and the search.
    samples : int
        Rays a pixel, a square power of two.

    Raises
    ------
    PlanRefused
        Where Mitsuba is not installed.
    """

    pictures = list(render_setups(setup, seed=seed, samples=samples, with_best=with_best))
    stream = io.BytesIO()
    lay_out(pictures, setup.bench.title).save(stream, "PNG", optimize=True)
    write_bytes(path, stream.getvalue())
    return Path(path)


def render_setups(
    setup: StudioSetup, *, seed: int = 1, samples: int = 16, with_best: bool = True,
    variants: tuple[str, ...] = VARIANTS,
) -> Iterator[Rendered]:  # fmt: skip
    """Yield the pictures of one lighting after another."""
    mi = load_mitsuba(*variants)
    motif = draw_motif(setup.object, rng=np.random.default_rng(seed))
    panel = _panel(mi, setup.object, motif)
    lightings = list(setup.lightings.values())
    if with_best:
        lightings.append(_best(setup, seed))
    for lighting in lightings:
        yield _render(mi, setup, lighting, motif, panel, samples)


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


def _render(
    mi: Any, setup: StudioSetup, lighting: Lighting, motif: Motif, panel: Any, samples: int
) -> Rendered:
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
    white = _shoot(mi, {**scene, "board": board}, eye, view, (0, 0), 66, 4 * samples)
    white = _smooth(white)
    painted = {**scene, "panel": panel}
    whole = _shoot(mi, painted, eye, view, (0, 0), WHOLE_PX, samples)
    details = {}
    for name, (x, y, side) in motif.details.items():
        seen = _shoot(mi, painted, eye, (side, side), (x, y), DETAIL_PX, samples)
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
EXPOSED = 1.0
"""White of the board on the sheet; brighter gold is shown burnt out, as a camera would."""


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """Return 8-bit sRGB of linear values over white.

    >>> to_srgb(np.array([0.0, 0.2140, 1.0, 2.0])).tolist()
    [0, 127, 255, 255]
    """
    c = np.clip(linear / EXPOSED, 0, 1)
    coded = np.where(c <= 0.0031308, 12.92 * c, 1.055 * np.maximum(c, 1e-9) ** (1 / 2.4) - 0.055)
    return (255 * coded + 0.5).astype(np.uint8)


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
        sheet.paste(Image.fromarray(to_srgb(picture.whole)), (GAP, top))
        for k, name in enumerate(names):
            detail = Image.fromarray(to_srgb(picture.details[name])).resize((tall, tall), 3)
            sheet.paste(detail, (GAP + wide + GAP + k * (tall + GAP), top))
        words = f"{picture.name}: {picture.title}" if picture.title else picture.name
        draw.text((GAP, top + tall + 4), words, INK, small)
    return sheet
