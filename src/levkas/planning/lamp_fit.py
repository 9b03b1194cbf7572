"""Fit the model of the lamps to a measured white frame: where they really stand, and how they aim."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from levkas.planning.irradiance import drop, illuminate
from levkas.planning.lobes import Lobe
from levkas.planning.setup import lamp_place

if TYPE_CHECKING:
    from levkas.planning.setup import Lighting
    from levkas.planning.tables import ObjectKeys

SPREAD = {"power": 0.3, "angle": 4.0, "azimuth": 4.0, "distance": 0.06, "aim": 60.0, "beam": 0.4}
"""How far a set-up is expected to miss its plan: one standard deviation of each parameter, in
natural logarithm, degrees, degrees, natural logarithm, mm, natural logarithm of the exponent."""


@dataclass(frozen=True, eq=False)
class FittedLamps:
    """Lamps as a measured white shows them.

    Parameters
    ----------
    lighting : Lighting
        The lamps, moved and turned; powers relative to one another.
    model : ndarray, (rows, columns)
        Light over its mean, as fitted.
    residual : float
        Root mean square of measured over model, less one.
    drop, planned_drop : float
        Of the light of these lamps over the board, and of the plan's.
    moved : tuple of str
        What differs from the plan, in sentences.
    """

    lighting: Lighting
    model: np.ndarray
    residual: float
    drop: float
    planned_drop: float
    moved: tuple[str, ...]


def fit_lamps(
    white: np.ndarray, lighting: Lighting, thing: ObjectKeys, *, bent: bool = False,
    vignetting: bool = True, centre_mm: tuple[float, float] = (0.0, 0.0),
) -> FittedLamps:  # fmt: skip
    """Return the lamps that explain a measured white.

    Parameters
    ----------
    white : ndarray, (rows, columns)
        Frame of a white board, dark subtracted, that fills the object's size; any scale.
    lighting : Lighting
        The plan that was hung.
    thing : ObjectKeys
        Its size is that of the board.
    bent : bool
        Whether the board is bent as the object is; white boards are flat.
    vignetting : bool
        Whether the lens darkens the corners as 1 + v·r², v fitted too.
    centre_mm : (x, y)
        Of the frame, from the object's middle.

    Raises
    ------
    ValueError
        Where the frame is empty, dark or not finite.

    Notes
    -----
    Least squares of log(measured/model) with the plan as a prior: a white alone cannot tell a
    strong far lamp from a weak near one.
    """
    from scipy.optimize import least_squares

    white = np.asarray(white, float)
    if white.ndim != 2 or white.size < 16 or not np.isfinite(white).all() or white.min() <= 0:
        raise ValueError("the white must be a frame (rows, columns) of finite values above 0")
    flat = thing if bent else thing.model_copy(update={"bend": None, "recess_mm": 0.0})
    measured = np.log(_thinned(white))
    measured -= measured.mean()
    rows, columns = measured.shape
    width, height = thing.size_mm
    middle = np.asarray(centre_mm, float)
    x = (np.arange(columns) + 0.5) / columns * width - width / 2 + middle[0]
    y = (np.arange(rows) + 0.5) / rows * height - height / 2 + middle[1]
    along, across = np.meshgrid(x, y)
    points, normals = _board(along, across, flat)
    radius2 = (along**2 + across**2) / (width**2 + height**2) * 4
    count = len(lighting.lamps)

    def model(p: np.ndarray) -> np.ndarray:
        lamps = moved_lighting(lighting, p[: 7 * count].reshape(count, 7)).lamps
        light = np.log(np.maximum(illuminate(lamps, points, normals), 1e-30))
        if vignetting:
            light = light + p[-1] * 0.1 * radius2
        return light - light.mean()

    def misses(p: np.ndarray) -> np.ndarray:
        return np.concatenate([((model(p) - measured) / 0.004).ravel(), p])

    def drop_over(lamps: Lighting) -> float:
        edges = [np.linspace(-side / 2, side / 2, 21) for side in (width, height)]
        right, below = np.meshgrid(edges[0] + middle[0], edges[1] + middle[1])
        return drop(illuminate(lamps.lamps, *_board(right, below, flat)))

    found = least_squares(misses, np.zeros(7 * count + 1), method="trf", max_nfev=30)
    fitted = moved_lighting(lighting, found.x[: 7 * count].reshape(count, 7))
    residual = float(np.sqrt(np.mean((np.exp(measured - model(found.x)) - 1) ** 2)))
    return FittedLamps(
        fitted, np.exp(model(found.x)), residual, drop_over(fitted), drop_over(lighting),
        tuple(_differences(lighting, fitted)),
    )  # fmt: skip


def _board(
    along: np.ndarray, across: np.ndarray, thing: ObjectKeys
) -> tuple[np.ndarray, np.ndarray]:
    """Return points and normals, (rows, columns, 3), of a board that is flat, or bent as the object is."""
    if thing.bend is None:
        zero = np.zeros_like(along)
        return np.stack([along, across, zero], -1), np.stack([zero, zero, zero + 1], -1)
    wide = thing.bend.straight == "width"
    turn = (across if wide else along) / thing.bend.radius_mm
    out, up = thing.bend.radius_mm * np.sin(turn), thing.bend.radius_mm * (np.cos(turn) - 1)
    zero = np.zeros_like(turn)
    if wide:
        return np.stack([along, out, up], -1), np.stack([zero, np.sin(turn), np.cos(turn)], -1)
    return np.stack([out, across, up], -1), np.stack([np.sin(turn), zero, np.cos(turn)], -1)


def _thinned(white: np.ndarray, most: int = 24) -> np.ndarray:
    """Average blocks, so that about 24 columns are left: light has no detail, noise has."""
    block = max(1, white.shape[1] // most)
    rows, columns = white.shape[0] // block, white.shape[1] // block
    cut = white[: rows * block, : columns * block]
    return cut.reshape(rows, block, columns, block).mean((1, 3))


def moved_lighting(lighting: Lighting, shifts: np.ndarray) -> Lighting:
    """Return a lighting whose lamps miss their plan.

    Parameters
    ----------
    lighting : Lighting
    shifts : ndarray, (lamps, 7)
        Power, angle, azimuth, distance, aim along x and y, beam; in standard deviations of `SPREAD`.
    """
    s = SPREAD
    lamps = []
    for lamp, p in zip(lighting.lamps, shifts, strict=True):
        target = lamp.place - lamp.axis * lamp.place[2] / min(lamp.axis[2], -1e-6)
        place = lamp_place(
            float(np.clip(lamp.angle_deg + s["angle"] * p[1], 1.0, 88.0)),
            lamp.azimuth_deg + s["azimuth"] * p[2],
            lamp.distance_mm * float(np.exp(s["distance"] * p[3])),
        )
        axis = target + s["aim"] * np.array([p[4], p[5], 0.0]) - place
        lobe = lamp.lobe
        if lobe.table is None and lobe.exponent:
            lobe = Lobe(lobe.exponent * float(np.exp(s["beam"] * p[6])))
        power = lamp.candela * float(np.exp(s["power"] * p[0]))
        axis = axis / np.linalg.norm(axis)
        lamps.append(replace(lamp, place=place, axis=axis, candela=power, lobe=lobe))
    return replace(lighting, lamps=tuple(lamps))


def _differences(plan: Lighting, found: Lighting) -> list[str]:
    told = []
    level = np.mean([b.candela / a.candela for a, b in zip(plan.lamps, found.lamps, strict=True)])
    for a, b in zip(plan.lamps, found.lamps, strict=True):
        power = b.candela / a.candela / level
        told.append(
            f"{a.name}: {b.angle_deg:.0f}° instead of {a.angle_deg:.0f}°, {b.distance_mm / 10:.0f} cm "
            f"instead of {a.distance_mm / 10:.0f} cm, power {100 * power:.0f} % of the lamps' mean."
        )
    return told
