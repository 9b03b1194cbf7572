"""Least-squares fit of the lamps' model to a measured white frame: places and aims."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from levkas.planning.setup import Lobe, drop, illuminate, lamp_place
from levkas.planning.surface import bent

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.planning.setup import Lighting
    from levkas.planning.tables import StudioObjectKeys

SPREAD = {"power": 0.3, "angle": 4.0, "azimuth": 4.0, "distance": 0.06, "aim": 60.0, "beam": 0.4}
"""How far a set-up is expected to miss its plan: one standard deviation of each parameter, in
natural logarithm, degrees, degrees, natural logarithm, mm, natural logarithm of the exponent."""
SPREAD_OF = ("power", "angle", "azimuth", "distance", "aim", "aim", "beam")
UNDETERMINED = 0.8
"""Of `SPREAD`: a standard deviation above it is the plan's own, not the white's."""


LENS = (0.3, 0.1)
"""What a lens takes of the corners, as r² and as r⁴: one standard deviation of each. A profile that is not quite r²
would else be taken for lamps that stand metres from their places."""
NOISE = 0.002
"""Least relative error of a block: boards and lenses are no better known than that."""
WIDEST = 3.0
"""Most by which `SPREAD` is widened where lamps turn out to hang farther from their plan."""
ROUNDS = 6


@dataclass(frozen=True)
class LampError:
    """Uncertainty of a lamp fitted to a white: one standard deviation each.

    Parameters
    ----------
    angle_deg, azimuth_deg, distance_mm : float
    place_mm : float
        Of the lamp's place in space.
    power : float
        Of its share of the lamps' mean.
    kept : tuple of str
        What the white hardly determines, so that the plan's own is kept: ``"angle"``, ``"distance"`` …
    """

    angle_deg: float
    azimuth_deg: float
    distance_mm: float
    place_mm: float
    power: float
    kept: tuple[str, ...]


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
    errors : tuple of LampError
        One a lamp.
    """

    lighting: Lighting
    model: np.ndarray
    residual: float
    drop: float
    planned_drop: float
    moved: tuple[str, ...]
    errors: tuple[LampError, ...]


def fit_lamps(
    white: np.ndarray, lighting: Lighting, thing: StudioObjectKeys, *, is_bent: bool = False,
    centre_mm: tuple[float, float] = (0.0, 0.0),
) -> FittedLamps:  # fmt: skip
    """Return the lamps that explain a measured white.

    Parameters
    ----------
    white : ndarray, (rows, columns)
        Frame of a white board, dark subtracted, that fills the object's size; any scale.
    lighting : Lighting
        The plan that was hung.
    thing : StudioObjectKeys
        Its size is that of the board.
    is_bent : bool
        Whether the board is bent as the object is; white boards are flat.
    centre_mm : (x, y)
        Of the frame, from the object's middle.

    Raises
    ------
    ValueError
        Where the frame is empty, dark or not finite.

    Notes
    -----
    Least squares of log(measured/model) with the plan as a prior: a white alone cannot distinguish
    a strong far lamp from a weak near one. The lens darkens the corners as exp(v·r² + w·r⁴), v and w
    fitted too. The frame weighs by its own noise; `SPREAD` is widened, by as
    much as is likeliest, where lamps hang farther from their plan than that.
    """
    white = np.asarray(white, float)
    if white.ndim != 2 or white.size < 16 or not np.isfinite(white).all() or white.min() <= 0:
        raise ValueError("the white must be a frame (rows, columns) of finite values above 0")
    flat = thing if is_bent else thing.model_copy(update={"bend": None, "recess_mm": 0.0})
    board = _Board.of(_thinned(white), lighting, flat, centre_mm)
    found, spread, wide = _solve(board)
    lamps = moved_lighting(lighting, board.shifts(found))
    light = board.light(found)
    edges = [np.linspace(-side / 2, side / 2, 21) for side in thing.size_mm]
    grid = np.meshgrid(edges[0] + centre_mm[0], edges[1] + centre_mm[1])
    drops = [drop(illuminate(one.lamps, *bent(*grid, flat))) for one in (lamps, lighting)]
    errors = _errors(board, found, spread, wide)
    return FittedLamps(
        lamps, np.exp(light), _rms(np.exp(board.measured - light) - 1), drops[0], drops[1],
        tuple(_differences(lighting, lamps, errors)), errors,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Board:
    """A white as it is fitted: log of its light, without the mean, and where its blocks lie."""

    measured: np.ndarray
    noise: float
    lighting: Lighting
    points: np.ndarray
    normals: np.ndarray
    lens: np.ndarray

    @classmethod
    def of(
        cls, blocks: np.ndarray, lighting: Lighting, thing: StudioObjectKeys,
        centre: tuple[float, float],
    ) -> _Board:  # fmt: skip
        measured = np.log(blocks)
        sides = [
            ((np.arange(n) + 0.5) / n - 0.5) * size
            for n, size in zip(measured.shape[::-1], thing.size_mm, strict=True)
        ]
        along, across = np.meshgrid(sides[0] + centre[0], sides[1] + centre[1])
        width, height = thing.size_mm
        radius2 = (along**2 + across**2) / (width**2 + height**2) * 4
        lens = np.stack([size * radius2**k for k, size in enumerate(LENS, 1)])
        points, normals = bent(along, across, thing)
        noise = max(NOISE, _roughness(measured))
        return cls(measured - measured.mean(), noise, lighting, points, normals, lens)

    def shifts(self, p: np.ndarray) -> np.ndarray:
        """Return what of the parameters is the lamps', (lamps, 7)."""
        return np.asarray(p[: -len(LENS)].reshape(-1, 7))

    def light(self, p: np.ndarray) -> np.ndarray:
        """Return the log of the light behind the lens, without its mean."""
        lamps = moved_lighting(self.lighting, self.shifts(p)).lamps
        light = np.log(np.maximum(illuminate(lamps, self.points, self.normals), 1e-30))
        light = light + np.tensordot(p[-len(LENS) :], self.lens, 1)
        return np.asarray(light - light.mean())


def _solve(board: _Board) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the parameters in units of `SPREAD`, their covariance, and by how much it was widened."""
    from scipy.optimize import least_squares

    count = 7 * len(board.lighting.lamps)
    found, wide = np.zeros(count + len(LENS)), 1.0
    for _ in range(ROUNDS):
        scale = np.append(np.full(count, wide), np.ones(len(LENS)))

        def misses(p: np.ndarray, scale: np.ndarray = scale) -> np.ndarray:
            return np.concatenate(
                [((board.light(p) - board.measured) / board.noise).ravel(), p / scale]
            )

        best = least_squares(misses, found, method="trf", x_scale=scale, max_nfev=100)
        found, spread = best.x, np.linalg.inv(best.jac.T @ best.jac)
        # What is likeliest: an expectation and maximisation of the prior's own width.
        expected = np.mean(found[:count] ** 2 + np.diag(spread)[:count])
        wide = float(np.clip(np.sqrt(expected), 1.0, WIDEST))
    return found, spread, wide


def _errors(
    board: _Board, found: np.ndarray, spread: np.ndarray, wide: float
) -> tuple[LampError, ...]:
    """Return the uncertainty of each lamp."""
    shifts, sizes = board.shifts(found), board.shifts(np.sqrt(np.diag(spread)))
    lamps, errors = moved_lighting(board.lighting, shifts).lamps, []
    for i, (lamp, size) in enumerate(zip(lamps, sizes, strict=True)):
        own = slice(7 * i, 7 * i + 7)
        slopes = _place_slopes(board.lighting, shifts, i)
        away = float(np.sqrt(np.trace(slopes.T @ spread[own, own] @ slopes)))
        share = np.zeros(len(found))
        share[: shifts.size : 7] = -1 / len(lamps)
        share[7 * i] += 1.0
        power = SPREAD["power"] * float(np.sqrt(max(share @ spread @ share, 0.0)))
        kept = [n for n, s in zip(SPREAD_OF, size, strict=True) if s > UNDETERMINED * wide]
        if len(lamps) == 1:
            kept = [n for n in kept if n != "power"]  # it has no other to be compared with
        errors.append(
            LampError(
                SPREAD["angle"] * size[1], SPREAD["azimuth"] * size[2],
                SPREAD["distance"] * size[3] * lamp.distance_mm, away, power, tuple(dict.fromkeys(kept)),
            )
        )  # fmt: skip
    return tuple(errors)


def _place_slopes(lighting: Lighting, shifts: np.ndarray, lamp: int) -> np.ndarray:
    """Return by how much each parameter of a lamp moves its place, (7, 3) mm."""
    step = 1e-3

    def place(shift: np.ndarray) -> np.ndarray:
        moved = shifts.copy()
        moved[lamp] += shift
        return moved_lighting(lighting, moved).lamps[lamp].place

    return np.stack([(place(step * one) - place(-step * one)) / (2 * step) for one in np.eye(7)])


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _roughness(measured: np.ndarray) -> float:
    """Return the noise of blocks: what a smooth surface of order 4 leaves of them."""
    y, x = (np.linspace(-1, 1, n) for n in measured.shape)
    terms = np.stack([np.outer(y**i, x**k).ravel() for i in range(5) for k in range(5 - i)], 1)
    rest = measured.ravel() - terms @ np.linalg.lstsq(terms, measured.ravel(), rcond=None)[0]
    return float(np.sqrt(np.sum(rest**2) / max(rest.size - terms.shape[1], 1)))


def _thinned(white: np.ndarray) -> np.ndarray:
    """Average blocks, so that about 24 columns are left: light has no detail, noise has."""
    block = max(1, white.shape[1] // 24)
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


def _differences(plan: Lighting, found: Lighting, errors: Sequence[LampError]) -> list[str]:
    sentences = []
    level = np.mean([b.candela / a.candela for a, b in zip(plan.lamps, found.lamps, strict=True)])
    for a, b, e in zip(plan.lamps, found.lamps, errors, strict=True):
        power = 100 * b.candela / a.candela / level
        strength = f"power {power:.0f} ± {100 * e.power:.0f} % of the lamps' mean, "
        sentences.append(
            f"{a.name}: {b.angle_deg:.0f} ± {e.angle_deg:.0f}° instead of {a.angle_deg:.0f}°, "
            f"{b.distance_mm / 10:.0f} ± {e.distance_mm / 10:.0f} cm instead of {a.distance_mm / 10:.0f} cm, "
            f"{strength if len(errors) > 1 else ''}its place known to {e.place_mm / 10:.0f} cm."
        )
        if e.kept:
            sentences[-1] += f" The white hardly constrains its {_listed(e.kept)}."
    return sentences


def _listed(names: Sequence[str]) -> str:
    """Return names as a sentence has them.

    >>> _listed(["power", "aim", "beam"])
    'power, aim and beam'
    """
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
