"""Coordinate transformations of OME-Zarr 0.6 (RFC-5), evaluated by code that knows numpy and Zarr alone."""

import numpy as np


def follow(root, transformation, points, *, back=False):
    """Evaluate a transformation on (n, axes) points, in the axes' order; `root` is the group that paths are in."""
    kind = transformation["type"]
    if kind == "identity":
        return points
    if kind == "scale":
        return points / transformation["scale"] if back else points * transformation["scale"]
    if kind == "affine":
        matrix = np.array(transformation["affine"], float)
        if back:
            return np.linalg.solve(matrix[:, :-1], (points - matrix[:, -1]).T).T
        return points @ matrix[:, :-1].T + matrix[:, -1]
    if kind == "bijection":
        return follow(root, transformation["inverse" if back else "forward"], points)
    if kind == "sequence":
        steps = transformation["transformations"]
        for step in steps[::-1] if back else steps:
            points = follow(root, step, points, back=back)
        return points
    if kind == "byDimension":
        result = points.copy()
        for part in transformation["transformations"]:
            ends = part["inputAxes"], part["outputAxes"]
            take, put = ends[::-1] if back else ends
            result[:, put] = follow(root, part["transformation"], points[:, take], back=back)
        return result
    assert kind == "displacements" and not back and transformation["interpolation"] == "linear"
    return points + _displacements(root[transformation["path"]], points)


def _displacements(group, points):
    (one,) = group.attrs["ome"]["multiscales"]
    (dataset,) = one["datasets"]
    scale, shift = (
        np.array(list(t.values())[1])
        for t in dataset["coordinateTransformations"][0]["transformations"]
    )
    assert [axis["type"] for axis in one["coordinateSystems"][0]["axes"]] == ["displacement", "space", "space"]  # fmt: skip
    field = group[dataset["path"]][:]
    at = (points - shift[1:]) / scale[1:]
    low = np.clip(np.floor(at).astype(int), 0, np.array(field.shape[1:]) - 2)
    part = at - low
    moves = np.zeros_like(points)
    for component in range(2):
        values = field[component]
        for y in (0, 1):
            for x in (0, 1):
                weight = np.where([y, x], part, 1 - part).prod(1)
                moves[:, component] += weight * values[low[:, 0] + y, low[:, 1] + x]
    return moves


def lead(root, scene, points, source, target):
    """Lead points from one coordinate system of a scene to another, by whatever transformations join them.

    A system is its name, or (path of its image, name).
    """
    ends = [
        (_system(step["input"]), _system(step["output"]), step)
        for step in scene["coordinateTransformations"]
    ]
    source, target = _system(source), _system(target)
    reached, waiting = {source: np.asarray(points, float)}, [source]
    while waiting:
        here = waiting.pop(0)
        for start, end, step in ends:
            for a, b, back in ((start, end, False), (end, start, True)):
                if a == here and b not in reached:
                    reached[b] = follow(root, step, reached[here], back=back)
                    waiting.append(b)
    return reached[target]


def _system(named):
    if isinstance(named, dict):
        return named.get("path", ""), named["name"]
    return named if isinstance(named, tuple) else ("", named)
