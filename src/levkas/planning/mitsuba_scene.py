"""Setups as scenes of Mitsuba 3, the extra ``levkas[render]``.

Mitsuba's world is right-handed with y upwards: ours with y turned round.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Problem
from levkas.planning.refusals import PlanRefused
from levkas.planning.spectra import GRID

if TYPE_CHECKING:
    from levkas.planning.setup import Lamp, Lighting

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


def lamp_objects(mi: Any, lamp: Lamp, name: str, *, spectral: bool = True) -> dict[str, Any]:
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


def _across(lamp: Lamp) -> np.ndarray:
    """The direction across the plane of the lamp and the object's normal."""
    across = np.cross(np.array([0.0, 0.0, 1.0]), lamp.place)
    size = float(np.linalg.norm(across))
    return across / size if size > 1e-6 else np.array([0.0, 1.0, 0.0])


def _power(lamp: Lamp, level: float, spectral: bool) -> Any:
    if not spectral:
        return {"type": "rgb", "value": [level] * 3}
    inside = (GRID >= 360) & (GRID <= 830)
    pairs = list(
        zip(GRID[inside].tolist(), (level * lamp.spectrum[inside] * 300).tolist(), strict=True)
    )
    return {"type": "spectrum", "value": pairs}


def _spot(mi: Any, lamp: Lamp, frame: Any, spectral: bool) -> dict[str, Any]:
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
