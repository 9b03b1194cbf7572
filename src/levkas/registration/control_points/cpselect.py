"""Points of MATLAB's Control Point Selection Tool (`cpselect`), in a MAT file of level 5.

Either ``movingPoints`` and ``fixedPoints`` (n × 2; before R2012b ``input_points`` and
``base_points``), or the structure ``cpstruct`` of the whole tool, whose predicted points are left out.
Intrinsic coordinates: x right, y down, the centre of the first pixel at (1, 1).
Sources: MathWorks' documentation of `cpselect`, `cpstruct2pairs` and "Export Control Points to the
Workspace"; MAT-File Format, level 5, for the elements.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from levkas.registration.control_points.conventions import from_origin, to_origin
from levkas.registration.control_points.matfile import read_variables
from levkas.registration.control_points.points import ControlPoints
from levkas.registration.control_points.text import unreadable

NAMES = (("fixedPoints", "movingPoints"), ("base_points", "input_points"))
HEADER = b"MATLAB 5.0 MAT-file, written by Levkas"


def recognises(data: bytes) -> bool:
    """Tell whether it is a MAT file of level 5 (or of 7.3, which is refused when read)."""
    return data[:6] == b"MATLAB" or data[:8] == b"\x89HDF\r\n\x1a\n"


def read(data: bytes) -> ControlPoints:
    """Read exported points, or the structure of the tool; moving is the target, fixed the reference."""
    if data[:8] == b"\x89HDF\r\n\x1a\n" or data.startswith(b"MATLAB 7.3"):
        raise unreadable("a MAT file of version 7.3", "level 5: save(file, '-v7')")
    variables = read_variables(data)
    for fixed, moving in NAMES:
        if fixed in variables and moving in variables:
            return ControlPoints(
                _places(variables[fixed], fixed),
                _places(variables[moving], moving),
                names=_names(variables.get("names")),
                weights=_switch(variables, "weights"),
                enabled=_switch(variables, "enabled"),
                check=_switch(variables, "check"),
            )
    for value in variables.values():
        if isinstance(value, dict) and "inputBasePairs" in value:
            return _tool(value)
    raise unreadable(", ".join(variables)[:80] or "no variables", "movingPoints and fixedPoints")


def _places(value: Any, name: str) -> np.ndarray:
    points = _numbers(value, name)
    if points.size and (points.ndim != 2 or points.shape[1] != 2):
        raise unreadable(f"{name} of {points.shape}", "n rows of x, y")
    return from_origin(points, "one")


def _switch(variables: dict[str, Any], name: str) -> np.ndarray | None:
    return _numbers(variables[name], name) if name in variables else None


def _names(value: Any) -> tuple[str, ...]:
    return tuple(map(str, value)) if isinstance(value, list) else ()


def _numbers(value: Any, name: str) -> np.ndarray:
    if not isinstance(value, np.ndarray):
        raise unreadable(f"{name} is {type(value).__name__}", "numbers")
    return value


def _tool(tool: dict[str, Any]) -> ControlPoints:
    """Valid pairs of a cpstruct: those of `inputBasePairs` that no one predicted."""
    moving, fixed = (_places(tool.get(k), k) for k in ("inputPoints", "basePoints"))
    pairs = _numbers(tool["inputBasePairs"], "inputBasePairs")
    if pairs.size % 2 or not np.isfinite(pairs).all():
        raise unreadable(f"inputBasePairs of {pairs.shape}", "n rows of two numbers")
    keep = [
        (int(i) - 1, int(b) - 1)
        for i, b in pairs.reshape(-1, 2)
        if 1 <= i <= len(moving) and 1 <= b <= len(fixed)
    ]
    guessed = [_marked(tool.get(k)) for k in ("isInputPredicted", "isBasePredicted")]
    keep = [(i, b) for i, b in keep if i not in guessed[0] and b not in guessed[1]]
    return ControlPoints([fixed[b] for _, b in keep], [moving[i] for i, _ in keep])


def _marked(value: Any) -> set[int]:
    return set(np.flatnonzero(value)) if isinstance(value, np.ndarray) else set()


def write(points: ControlPoints) -> tuple[bytes, ...]:
    """Write `movingPoints` and `fixedPoints`, with names, weights and switches beside them."""
    from scipy.io import savemat

    names = np.empty((len(points), 1), object)
    names[:, 0] = points.names
    stream = io.BytesIO()
    savemat(
        stream,
        {
            "movingPoints": to_origin(points.target, "one"),
            "fixedPoints": to_origin(points.reference, "one"),
            "names": names,
            "weights": points.weights[:, None],
            "enabled": points.enabled[:, None],
            "check": points.check[:, None],
        },
    )
    return (HEADER.ljust(116) + stream.getvalue()[116:],)  # scipy writes the time of day there
