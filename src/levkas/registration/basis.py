"""What a dense map rests on, for its record: the windows that it was fitted to, and those that confirm it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from levkas.registration.checks import Checks
    from levkas.registration.model_selection import Rung

#: A record of more only grows; the rest is told by its number.
MOST_WINDOWS = 1000


def describe_basis(
    sensor: str, source: str, band: str, rung: Rung, checks: Checks | None
) -> dict[str, Any]:
    """Return what the base map of a sensor rests on, JSON-ready; a list a column, reference px.

    Parameters
    ----------
    sensor : str
    source : str
        ``"fused"`` where the windows of several bands were put together, else the band.
    band : str
        By which the map was checked.
    rung : Rung
    checks : Checks or None

    Returns
    -------
    record : dict
        ``windows``: ``x``, ``y``; ``shift_x``, ``shift_y`` from where the map puts a window to where it is
        seen; ``sigma`` of that, either axis; ``held_out``, the length of the same shift from a map that was
        fitted without its block (None where there is none); ``weight`` in the fit, 0..1. ``count`` of all windows, of
        which at most 1000, evenly, are written. ``checks``: the windows that were looked for freely.
    """
    seen = rung.observations
    every = max(1, -(-len(seen) // MOST_WINDOWS))
    chosen = slice(None, None, every)
    shift = seen.residuals(rung.transform)[chosen]
    known = np.trace(seen.information, axis1=1, axis2=2)[chosen] / 2
    held_out = rung.held_out()[chosen]
    return {
        "sensor": sensor,
        "source": source,
        "band": band,
        "count": len(seen),
        "windows": {
            "x": np.round(seen.points[chosen, 0], 1).tolist(),
            "y": np.round(seen.points[chosen, 1], 1).tolist(),
            "shift_x": np.round(shift[:, 0], 4).tolist(),
            "shift_y": np.round(shift[:, 1], 4).tolist(),
            "sigma": [round(float(k**-0.5), 4) if k > 0 else None for k in known],
            "held_out": [round(float(v), 4) if np.isfinite(v) else None for v in held_out],
            "weight": np.round(rung.weights[chosen], 3).tolist(),
        },
        "checks": None if checks is None else checks.to_dict(),
    }
