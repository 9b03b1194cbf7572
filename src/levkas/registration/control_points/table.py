"""Our own CSV: ``name,reference_x,reference_y,x,y,weight,enabled,check``, pixel centres at integers.

Only the four coordinates are required; columns may stand in any order and others are passed over.
"""

from __future__ import annotations

from levkas.registration.control_points.points import (
    ControlPoints,
    decode,
    flag,
    number,
    rows,
    unreadable,
    write_rows,
)

PLACES = ("reference_x", "reference_y", "x", "y")


def recognises(data: bytes) -> bool:
    """Return whether the first line names the four coordinates."""
    first = data[:1024].removeprefix(b"\xef\xbb\xbf").split(b"\n")[0].decode("utf-8", "replace")
    return set(PLACES) <= {cell.strip().strip('"') for cell in first.split(",")}


def read(data: bytes) -> ControlPoints:
    """Read pairs and what else the columns say of them."""
    table = rows(decode(data))
    head = [cell.strip() for cell in table[0]] if table else []
    if not set(PLACES) <= set(head):
        raise unreadable(",".join(head)[:80] or "nothing", ",".join(PLACES))
    body = table[1:]
    short = next((i for i, row in enumerate(body, start=2) if len(row) < len(head)), None)
    if short is not None:
        raise unreadable(f"too few columns in row {short}", f"{len(head)}")
    cells = {name: [row[i] for row in body] for i, name in enumerate(head)}
    x, y, u, v = ([number(c, name) for c in cells[name]] for name in PLACES)
    return ControlPoints(
        list(zip(x, y, strict=True)),
        list(zip(u, v, strict=True)),
        names=tuple(cells.get("name", ())),
        weights=[number(c, "weight") for c in cells["weight"]] if "weight" in cells else None,
        enabled=[flag(c) for c in cells["enabled"]] if "enabled" in cells else None,
        check=[flag(c) for c in cells["check"]] if "check" in cells else None,
    )


def write(points: ControlPoints) -> bytes:
    """Write every pair with its name, weight and switches."""
    header = ("name", *PLACES, "weight", "enabled", "check")
    table = [
        [name, *reference, *target, float(weight), int(on), int(check)]
        for name, reference, target, weight, on, check in zip(
            points.names, points.reference.tolist(), points.target.tolist(),
            points.weights, points.enabled, points.check, strict=True,
        )
    ]  # fmt: skip
    return write_rows([header, *table]).encode()
