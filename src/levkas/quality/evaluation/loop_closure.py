"""Loop closure of a built database: its cameras registered to one another from their native cubes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from glob import escape
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.database.registrations import read_registrations
from levkas.geometry import from_dict
from levkas.registration import RegistrationRefused, register

if TYPE_CHECKING:
    from levkas.geometry.transforms import Transform
    from levkas.registration.bands import BandImage


def close_database(database: Path) -> list[dict[str, Any]]:
    """Return a record of every loop of every object: two cameras registered straight to each other.

    Parameters
    ----------
    database : path

    Returns
    -------
    loops : list of dict
        ``object``, and the fields of `Loop.to_dict`; setups other than the
        default and layers that were refused take no part.

    Raises
    ------
    ComparisonRefused
        Where the database holds no native pixels.
    """

    found = []
    folders = {p.parent.parent.name for p in database.glob("objects/*/registration/*.json")}
    for name in sorted(folders):
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


def _view(database: Path, name: str, record: dict[str, Any]) -> LoopView | None:
    """Read the sensor of a camera that holds its reference channel; None where there is none."""
    from levkas.quality.evaluation.native_layers import read_native_layer

    camera, band = record["camera"], record["target"]["band"]
    images = read_native_layer(database, name, camera, "").images()
    sensor = next((image.sensor for image in images if image.label == band), None)
    transform = from_dict(record["bands"][band]["transform"])
    of_sensor = [image for image in images if image.sensor == sensor]
    return LoopView(camera, of_sensor, band, transform) if of_sensor else None


def loops_text(loops: list[dict[str, Any]]) -> str:
    """Return a table for people: a line a loop, errors in reference pixels."""
    if not loops:
        return "No loops: no object has two registered cameras or more beside its reference."
    lines = [f"{'loop':44} {'mean px':>8} {'p95 px':>8} {'max px':>8}"]
    for one in loops:
        name = f"{one['object']}: reference, {one['first']}, {one['second']}"
        if one["mean"] is None:
            lines.append(f"{name:44} not closed: {one['refused'] or 'no point is in view of all'}")
        else:
            lines.append(f"{name:44} {one['mean']:8.3f} {one['p95']:8.3f} {one['max']:8.3f}")
    return "\n".join(lines)


GRID = (25, 19)


@dataclass(frozen=True)
class LoopView:
    """One camera in a loop.

    Parameters
    ----------
    name : str
    images : sequence of BandImage
        Bands of one sensor.
    band : str
        The band whose map is followed.
    transform : Transform
        Reference px → native px of that band, from its own registration.
    """

    name: str
    images: Sequence[BandImage]
    band: str
    transform: Transform


@dataclass(frozen=True)
class Loop:
    """How far reference → first → second → reference comes back from where it began, reference px.

    `verdict` is that of the registration that closes the loop. `error` holds one distance a point that all
    see; empty, with the reason, where the pair that closes the loop is refused.
    """

    first: str
    second: str
    error: np.ndarray
    refused: str = ""
    verdict: str = "refuse"

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        known = len(self.error) > 0
        return {
            "first": self.first,
            "second": self.second,
            "points": len(self.error),
            "mean": float(self.error.mean()) if known else None,
            "p95": float(np.percentile(self.error, 95)) if known else None,
            "max": float(self.error.max()) if known else None,
            "verdict": self.verdict,
            "refused": self.refused or None,
        }


def close_loops(views: Sequence[LoopView], points: np.ndarray) -> Iterator[Loop]:
    """Register every pair of cameras by itself, and follow points around.

    Parameters
    ----------
    views : sequence of View
        The cameras that are not the reference.
    points : ndarray, (n, 2), reference px

    Yields
    ------
    loop : Loop
        A pair, in the order of `views`.

    Notes
    -----
    The registration that closes the loop uses nothing of the reference camera: neither a start nor
    bands. Errors that all three share do not show. A pair is registered both ways,
    and the way with the smaller predicted sigma closes the loop.
    """
    for one, other in combinations(views, 2):
        ways = [_register(one, other, points), _register(other, one, points)]
        known = [way for way in ways if not way.refused]
        if not known:
            yield Loop(one.name, other.name, np.empty(0), ways[0].refused)
            continue
        best = min(known, key=lambda way: way.sigma)
        start = one.transform(points)
        end = best.map(start) if best.leader is one else best.map.inverse(start)
        within = _on(one, start) & _on(other, end)
        miss = np.linalg.norm(other.transform.inverse(end[within]) - points[within], axis=1)
        yield Loop(one.name, other.name, miss[np.isfinite(miss)], verdict=best.verdict)


@dataclass(frozen=True)
class _Way:
    """One camera of a pair registered to the other one, `leader`; `sigma` in reference px."""

    leader: LoopView
    map: Transform
    sigma: float = np.inf
    verdict: str = "refuse"
    refused: str = ""


def _register(leader: LoopView, led: LoopView, points: np.ndarray) -> _Way:
    try:
        found = register(leader.images, led.images, reference_band=leader.band)
    except RegistrationRefused as refused:
        return _Way(leader, leader.transform, refused=str(refused))
    if found.verdict.decision == "refuse":
        return _Way(leader, leader.transform, refused=found.verdict.reasons[0])
    places = leader.transform(points)
    within = _on(leader, places)
    scale = np.sqrt(np.abs(np.linalg.det(leader.transform.jacobian(points[within]))))
    sigma = found.sigma[led.band](places[within]) / scale
    median = float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else np.inf
    return _Way(leader, found.transforms[led.band], median, found.verdict.decision)


def _on(view: LoopView, places: np.ndarray) -> np.ndarray:
    """Return which places lie on valid px of the view's band."""
    valid = next(image.valid for image in view.images if image.label == view.band)
    known = np.isfinite(places).all(1)
    x, y = np.rint(np.where(known[:, None], places, -9)).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < valid.shape[1]) & (y < valid.shape[0])
    inside[inside] &= valid[y[inside], x[inside]]
    return inside


def points_on(image: BandImage) -> np.ndarray:
    """Return points on the object that an image shows, (n, 2) px, 25 x 19 of the frame without its background."""
    from levkas.registration.bands import sqrt_images
    from levkas.registration.foreground import ObjectArea

    x, y = (np.linspace(0.02, 0.98, k) * (n - 1) for k, n in zip(GRID, image.size, strict=True))
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    within = ObjectArea.of(sqrt_images([image])[image.label]).compared
    column, row = np.rint(points).astype(int).T
    return points[within[row, column]]
