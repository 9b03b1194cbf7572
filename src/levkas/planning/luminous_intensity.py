"""Luminous intensity distribution of a lamp: a cosine lobe by its half-width, or a measured table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.planning.tables import LampKeys


@dataclass(frozen=True, eq=False)
class Lobe:
    """Intensity over its value on the axis.

    Parameters
    ----------
    exponent : float
        m of cosᵐ; 0 shines evenly.
    table : (angles, values), optional
        Degrees from the axis, ascending from 0, and relative intensity; used instead of cosᵐ.
    """

    exponent: float = 0.0
    table: tuple[np.ndarray, np.ndarray] | None = None

    def __call__(self, cosine: np.ndarray) -> np.ndarray:
        """Return the relative intensity at the cosine of the angle from the axis."""
        c = np.clip(cosine, 0.0, 1.0)
        if self.table is not None:
            return np.interp(np.degrees(np.arccos(c)), *self.table, right=0.0)
        return c**self.exponent if self.exponent else np.ones_like(c)

    def solid_angle(self) -> float:
        """Return the integral over the half-space, sr: flux over intensity on the axis.

        >>> round(Lobe(1.0).solid_angle(), 4)  # Lambert's law: pi
        3.1416
        """
        if self.table is None:
            return float(2 * np.pi / (self.exponent + 1))
        angle = np.radians(np.linspace(0, 90, 1801))
        values = self(np.cos(angle)) * np.sin(angle)
        return float(2 * np.pi * np.trapezoid(values, angle))


def lobe_exponent(half_width_deg: float) -> float:
    """Return m of the lobe cosᵐ that is at half its intensity at an angle, degrees.

    >>> round(lobe_exponent(15.0), 2), round(lobe_exponent(60.0), 2)
    (19.99, 1.0)
    """
    return float(np.log(0.5) / np.log(np.cos(np.radians(half_width_deg))))


def read_lobe(name: str, keys: LampKeys, root: Path, *, file: str) -> Lobe:
    """Return the lobe of a kind of lamp; a soft light without a beam follows Lambert's law.

    Raises
    ------
    PlanRefused
        Where beam and table are both given, or the table does not begin at 0 degrees.
    """
    from levkas.planning.tables import PlanRefused, wrong

    if keys.lobe is None:
        if keys.beam_deg is None:
            return Lobe(1.0 if keys.size_mm else 0.0)
        return Lobe(lobe_exponent(keys.beam_deg))
    if keys.beam_deg is not None:
        raise PlanRefused(
            wrong(file, f"lamps.{name}.beam_deg", "beam_deg and lobe say one thing twice",
                  keys.beam_deg, "one of them")
        )  # fmt: skip
    angles, values = _read_angles(root / keys.lobe, f"lamps.{name}.lobe", file)
    return Lobe(0.0, (angles, values))


def _read_angles(path: Path, field: str, file: str) -> tuple[np.ndarray, np.ndarray]:
    from levkas.core.text import TextRefused, read_text
    from levkas.planning.tables import PlanRefused, wrong

    try:
        lines = read_text(path, "a CSV of degrees and relative intensity").splitlines()
        rows = [[float(c) for c in line.split(",")] for line in lines if line[:1].isdigit()]
        table = np.array(rows, float)
    except TextRefused as refused:
        raise PlanRefused(*refused.problems) from None
    except ValueError as error:
        raise PlanRefused(wrong(file, field, f"{path.name}: no table", str(error)[:80])) from None
    sound = table.ndim == 2 and table.shape[1] == 2 and len(table) > 1 and table[0, 0] == 0
    sound = sound and np.isfinite(table).all() and (table[:, 1] >= 0).all()
    if not sound or (np.diff(table[:, 0]) <= 0).any() or not table[0, 1] > 0:
        raise PlanRefused(
            wrong(file, field, f"{path.name} is no lobe", f"{len(rows)} rows",
                  "degrees from the axis, ascending from 0, and intensity > 0 there")
        )  # fmt: skip
    return table[:, 0], table[:, 1] / table[0, 1]
