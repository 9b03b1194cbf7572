"""Points of MATLAB's Control Point Selection Tool (`cpselect`), exported as a table.

``writetable(array2table([movingPoints fixedPoints], 'VariableNames', {'moving_x', 'moving_y', 'fixed_x',
'fixed_y'}), 'points.csv')`` writes one. Intrinsic coordinates: x right, y down, the centre of the first
pixel at (1, 1). Source: MathWorks, "Export Control Points to the Workspace".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from levkas.registration.control_points import table
from levkas.registration.control_points.points import ControlPoints, from_origin, to_origin

PLACES = ("fixed_x", "fixed_y", "moving_x", "moving_y")


def recognises(data: bytes) -> bool:
    """Return whether the first line names the four coordinates."""
    return table.names(data, PLACES)


def read(data: bytes) -> ControlPoints:
    """Read exported points; moving is the target, fixed the reference."""
    return _moved(table.read(data, PLACES), from_origin)


def write(points: ControlPoints) -> tuple[bytes, ...]:
    """Write every pair with its name, weight and switches."""
    return table.write(_moved(points, to_origin), PLACES)


def _moved(points: ControlPoints, move: Callable[[np.ndarray, str], np.ndarray]) -> ControlPoints:
    """Return points whose coordinates count from one, or those from centres at zero."""
    return replace(
        points, reference=move(points.reference, "one"), target=move(points.target, "one")
    )
