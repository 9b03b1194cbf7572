"""Points layers of napari: one CSV a layer, so two for a pair of pictures (as affinder sets them).

Header ``index,axis-0,axis-1`` and a column a property. Axes are those of the array: y first, then x;
a stack has its other axes before them. Pixel centres are integers. Names, weights and switches
travel as properties of the reference's layer.
Source: `napari_builtins.io` of https://github.com/napari/napari and its "Using the points layer".
"""

from __future__ import annotations

import re

from levkas.registration.control_points.points import (
    ControlPoints,
    decode,
    flag,
    number,
    rows,
    unreadable,
    write_rows,
)

_HEADER = re.compile(rb"^(\xef\xbb\xbf)?\"?(index\"?,\"?)?axis-0\b")
PROPERTIES = ("name", "weight", "enabled", "check")


def recognises(data: bytes) -> bool:
    """Return whether the header names axes."""
    return _HEADER.match(data[:64]) is not None


def read(data: bytes, target: bytes | None = None) -> ControlPoints:
    """Read the layer of the reference and that of the target."""
    if target is None:
        raise unreadable("one points layer", "two CSV files, of the reference and of the target")
    head, body = _table(data)
    places, others = _places(data), _places(target)
    if len(places) != len(others):
        raise unreadable(
            f"{len(places)} and {len(others)} points", "as many in both layers, in one order"
        )
    more = {name: [row[head.index(name)] for row in body] for name in PROPERTIES if name in head}
    return ControlPoints(
        places,
        others,
        names=tuple(more.get("name", ())),
        weights=[number(w, "weight") for w in more["weight"]] if "weight" in more else None,
        enabled=[flag(v) for v in more["enabled"]] if "enabled" in more else None,
        check=[flag(v) for v in more["check"]] if "check" in more else None,
    )


def _table(data: bytes) -> tuple[list[str], list[list[str]]]:
    table = rows(decode(data))
    if not table:
        raise unreadable("an empty file", "index,axis-0,axis-1")
    head = [cell.strip() for cell in table[0]]
    short = next((i for i, row in enumerate(table) if len(row) < len(head)), None)
    if short is not None:
        raise unreadable(f"{len(table[short])} columns in line {short + 1}", f"{len(head)}")
    return head, table[1:]


def _places(data: bytes) -> list[list[float]]:
    head, body = _table(data)
    axes = [i for i, name in enumerate(head) if re.fullmatch(r"axis-\d", name)]
    if len(axes) < 2:
        raise unreadable(",".join(head)[:80], "index,axis-0,axis-1")
    y, x = axes[-2:]
    return [
        [number(row[x], f"line {line}"), number(row[y], f"line {line}")]
        for line, row in enumerate(body, start=2)
    ]


def write(points: ControlPoints) -> tuple[bytes, ...]:
    """Write two layers, reference then target."""
    head = ["index", "axis-0", "axis-1"]
    more = [
        [name, float(weight), str(bool(on)), str(bool(check))]
        for name, weight, on, check in zip(
            points.names, points.weights, points.enabled, points.check, strict=True
        )
    ]
    tables = [
        [
            [*head, *PROPERTIES],
            *([i, y, x, *more[i]] for i, (x, y) in enumerate(points.reference.tolist())),
        ],
        [head, *([i, y, x] for i, (x, y) in enumerate(points.target.tolist()))],
    ]
    return tuple(write_rows(table).encode() for table in tables)
