"""Setups as scenes of Mitsuba 3, the extra ``levkas[render]``.

Mitsuba's world is right-handed with y upwards: ours with y turned round.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Problem
from levkas.planning.spectra import GRID
from levkas.planning.tables import PlanRefused

if TYPE_CHECKING:
    from levkas.planning.setup import Lighting, StudioLamp
    from levkas.planning.tables import StudioObjectKeys

FLIP = np.array([1.0, -1.0, 1.0])
LOBE_PIXELS = 1024
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
    *, centre: tuple[float, float] = (0.0, 0.0), seed: int = 0, film: str = "rgb",
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
            "pixel_format": film,
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "stratified", "sample_count": samples, "seed": seed},
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


def draw_motif(
    thing: StudioObjectKeys, *, rng: np.random.Generator, px_per_mm: float = 1.6
) -> Motif:
    """Return the motif, drawn to an object's size; relief has the object's rms slope."""
    width, height = thing.size_mm
    columns, rows = round(width * px_per_mm) | 1, round(height * px_per_mm) | 1
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
    relief = _relief(rows, columns, px_per_mm, rng) * np.where(gold > 0, 0.5, 1.0)
    slope = np.sqrt(np.mean(np.square(np.gradient(relief, 1 / px_per_mm))))
    relief *= thing.relief_slope / slope if thing.relief_slope else 0.0
    edge = np.minimum(width / 2 - np.abs(x * unit), height / 2 - np.abs(y * unit))
    sunk = np.clip((edge - thing.border_mm) / thing.bevel_mm, 0, 1) * thing.recess_mm
    places = {
        "gold": (-95.0, 38.0), "varnish": (128.0, -32.0), "garment": (60.0, 45.0),
        "hatching": (50.0, -20.0),
    }  # fmt: skip
    details = {k: (a * unit, b * unit, 62.0 * unit) for k, (a, b) in places.items()}
    return Motif(np.clip(colour, 0, 1), gold, relief - sunk, details)


def _relief(rows: int, columns: int, px_per_mm: float, rng: np.random.Generator) -> np.ndarray:
    """Brush strokes, long in one direction, and a net of cracks."""
    noise = rng.standard_normal((rows, columns))
    fx = np.fft.rfftfreq(columns)[None] * px_per_mm
    fy = np.fft.fftfreq(rows)[:, None] * px_per_mm
    strokes = np.exp(-((fx / 0.16) ** 2) - ((fy / 0.45) ** 2)) * (np.hypot(fx, fy) > 0.02)
    brush = np.fft.irfft2(np.fft.rfft2(noise) * strokes, (rows, columns))
    seeds = rng.uniform(0, 1, (260, 2)) * [rows, columns]
    from scipy.spatial import cKDTree

    grid = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), -1)
    near, _ = cKDTree(seeds).query(grid.reshape(-1, 2), k=2)
    crack = ((near[:, 1] - near[:, 0]) < 1.6).reshape(rows, columns)
    return brush / brush.std() - 2.0 * crack
