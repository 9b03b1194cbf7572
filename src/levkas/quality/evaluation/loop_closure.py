"""Loop closure of a built database: its cameras registered to one another from their native cubes."""

from __future__ import annotations

from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.database.registrations import read_registrations
from levkas.geometry import from_dict

if TYPE_CHECKING:
    from levkas.quality.evaluation.loops import View


def close_database(database: Path) -> list[dict[str, Any]]:
    """Return a record of every loop of every object: two cameras registered straight to each other.

    Parameters
    ----------
    database : path

    Returns
    -------
    loops : list of dict
        ``object``, and what `levkas.quality.evaluation.loops.Loop.to_dict` says; setups other than the
        default and layers that were refused take no part.
    """
    from levkas.quality.evaluation.loops import close_loops, points_on

    found = []
    for folder in sorted(database.glob("objects/*/registration")):
        name = folder.parent.name
        records = [record for _, record in read_registrations(database, escape(name))]
        views, points = [], None
        for record in records:
            if (
                record.get("setup")
                or not record.get("bands")
                or record["verdict"]["decision"] == "refuse"
            ):
                continue
            if record["camera"] == record["reference"]["camera"]:
                own = _view(database, name, record)
                if own is not None:
                    points = points_on(next(i for i in own.images if i.label == own.band))
                continue
            view = _view(database, name, record)
            if view is not None:
                views.append(view)
        if points is not None:
            found += [{"object": name, **loop.to_dict()} for loop in close_loops(views, points)]
    return found


def _view(database: Path, name: str, record: dict[str, Any]) -> View | None:
    """Read the sensor of a camera that holds its reference channel; None where it is not kept."""
    from levkas.quality.comparison.captures import ComparisonRefused, read_capture
    from levkas.quality.evaluation.loops import View

    camera, band = record["camera"], record["target"]["band"]
    try:
        images = read_capture(database, name, camera, "").images()
    except ComparisonRefused:
        return None
    sensor = next((image.sensor for image in images if image.label == band), None)
    transform = from_dict(record["bands"][band]["transform"])
    mates = [image for image in images if image.sensor == sensor]
    return View(camera, mates, band, transform) if mates else None


def tell(loops: list[dict[str, Any]]) -> str:
    """Return a table for people: a line a loop, errors in reference pixels."""
    lines = [f"{'loop':44} {'mean px':>8} {'p95 px':>8} {'max px':>8}"]
    for one in loops:
        name = f"{one['object']}: reference, {one['first']}, {one['second']}"
        if one["mean"] is None:
            lines.append(f"{name:44} not closed: {one['refused'] or 'no point is seen by all'}")
        else:
            lines.append(f"{name:44} {one['mean']:8.3f} {one['p95']:8.3f} {one['max']:8.3f}")
    return "\n".join(lines)
