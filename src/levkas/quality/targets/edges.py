"""Slanted edges of a target, named by rectangles."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from levkas.core.cube import Flag, is_flagged
from levkas.core.problems import Problem
from levkas.quality.image_quality.slanted_edge import EdgeRefused, EdgeResponse, measure_edge
from levkas.quality.targets.charts import EDGES
from levkas.quality.targets.indicators import IndicatorRow, indicator

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.core.cube import Band, Cube

Box = tuple[int, int, int, int]


class EdgePlace(NamedTuple):
    """Where an edge is: a rectangle x, y, width, height in the pixels of the cube, and what it is called."""

    label: str
    box: Box


def parse_edges(texts: Sequence[str]) -> tuple[EdgePlace, ...]:
    """Return slanted edges from ``x,y,width,height``.

    Examples
    --------
    >>> parse_edges(["10,20,60,80"])
    (EdgePlace(label='edge 1 (10,20,60,80)', box=(10, 20, 60, 80)),)
    """
    places = []
    for number, text in enumerate(texts, 1):
        try:
            x, y, width, height = (int(part) for part in text.split(","))
        except ValueError:
            raise EdgeRefused(
                Problem("E_VALUE", "the edge cannot be read", None, "--edge", text,
                        "four whole numbers: x,y,width,height")
            ) from None  # fmt: skip
        places.append(EdgePlace(f"edge {number} ({x},{y},{width},{height})", (x, y, width, height)))
    return tuple(places)


@dataclass(frozen=True, eq=False)
class EdgeTable:
    """Spatial frequency response of all bands across one edge."""

    label: str
    axis: str
    box: Box
    angle_deg: float
    bands: tuple[Band, ...]
    response: np.ndarray
    sfr50: np.ndarray
    sfr10: np.ndarray
    efficiency: np.ndarray
    most: np.ndarray
    shift: np.ndarray
    refused: dict[str, str]

    @property
    def largest_shift(self) -> float:
        """Largest distance between the edges of two bands, px."""
        return float(np.nanmax(self.shift) - np.nanmin(self.shift))

    @property
    def frequencies(self) -> np.ndarray:
        """Cycles/px of the columns of `response`."""
        return np.linspace(0, 1, self.response.shape[1])

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for `--json`."""
        parts = {
            "sfr50": self.sfr50, "sfr10": self.sfr10, "sampling_efficiency": self.efficiency,
            "largest_modulation": self.most, "shift_px": self.shift,
        }  # fmt: skip
        return {
            "edge": self.label,
            "axis": self.axis,
            "angle_deg": round(self.angle_deg, 3),
            "rectangle": list(self.box),
            "bands": [
                {"band": band.label, **{k: _plain(v[i]) for k, v in parts.items()}}
                for i, band in enumerate(self.bands)
            ],
            "largest_shift_px": _plain(self.largest_shift),
            "refused": self.refused,
        }


def _plain(value: float) -> float | None:
    return round(float(value), 5) if np.isfinite(value) else None


@dataclass(frozen=True, eq=False)
class EdgeFindings:
    """Edges of one cube: tables, those that were named and refused, and notes."""

    tables: tuple[EdgeTable, ...] = ()
    problems: tuple[Problem, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def rows(self) -> list[IndicatorRow]:
        """Return the indicators."""
        return rate_edges(self.tables)


@dataclass(frozen=True, eq=False)
class EdgeTargetMeasure:
    """Measurement of a target of slanted edges that has no colour chart, by one camera under one setup."""

    name: str
    cubes: dict[str, Cube]
    edges: EdgeFindings
    stray: ClassVar[None] = None
    """Needs a chart's greys."""
    stray_light: str = ""
    """A sentence on stray light in light traps; empty without any that is certain."""

    @property
    def rows(self) -> tuple[IndicatorRow, ...]:
        """Indicators."""
        return tuple(self.edges.rows)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the report says of the edges."""
        return self.edges.notes

    def to_dict(self) -> dict[str, Any]:
        """Return the record for `--json`."""
        return {
            "name": self.name,
            "chart": EDGES,
            "bands": [band.label for cube in self.cubes.values() for band in cube.bands],
            "indicators": [row.to_dict() for row in self.rows],
            "edges": [table.to_dict() for table in self.edges.tables],
            "notes": list(self.notes),
        }


def join_findings(found: Sequence[EdgeFindings]) -> EdgeFindings:
    """Return the findings of several cubes as one."""
    return EdgeFindings(
        tuple(t for f in found for t in f.tables),
        tuple(p for f in found for p in f.problems),
        tuple(dict.fromkeys(n for f in found for n in f.notes)),
    )


def measure_named(cube: Cube, places: Sequence[EdgePlace], *, period: int = 1) -> EdgeFindings:
    """Measure edges that a user named; what is refused in every band is a problem, in some a note.

    `period` is that of the mosaic, px, which the cube was interpolated from.
    """
    tables, problems, notes = [], [], []
    for place in places:
        try:
            found = _tabulate(cube, place, period)
        except EdgeRefused as refused:
            problems += [
                replace(p, message=f"{place.label}: {p.message}", field=p.field or "edges")
                for p in refused.problems
            ]
            continue
        tables.append(found)
        if found.refused:
            bands = ", ".join(list(found.refused)[:6])
            why = next(iter(found.refused.values()))
            notes.append(f"{place.label}: no response of {bands}: {why}")
    return EdgeFindings(tuple(tables), tuple(problems), tuple(notes))


def _tabulate(cube: Cube, place: EdgePlace, period: int) -> EdgeTable:
    """Measure one edge in every band; raises EdgeRefused where none has one."""
    x, y, width, height = place.box
    rows, columns = cube.values.shape[:2]
    if min(x, y) < 0 or min(width, height) < 1 or x + width > columns or y + height > rows:
        raise EdgeRefused(
            Problem("E_REGION", "the rectangle of the edge does not lie in the frame", None, "edges",
                    f"{x},{y},{width},{height}", f"x,y,width,height within {columns} x {rows} px",
                    "Give native pixels of the camera that recorded it.")
        )  # fmt: skip
    cut = np.s_[y : y + height, x : x + width]
    full = is_flagged(cube.flags[cut], Flag.SATURATED)
    found: dict[int, EdgeResponse] = {}
    refusals: dict[int, EdgeRefused] = {}
    for band in range(len(cube.bands)):
        try:
            found[band] = measure_edge(cube.values[cut][..., band], full[..., band], period=period)
        except EdgeRefused as refused:
            refusals[band] = refused
    if not found:
        raise refusals[0]
    axes = [response.axis for response in found.values()]
    axis = max(set(axes), key=axes.count)
    found = {band: response for band, response in found.items() if response.axis == axis}
    return _table_of(cube.bands, place, found, refusals)


def _table_of(
    bands: tuple[Band, ...],
    place: EdgePlace,
    found: dict[int, EdgeResponse],
    refusals: dict[int, EdgeRefused],
) -> EdgeTable:
    first = next(iter(found.values()))

    def over_bands(name: str) -> np.ndarray:
        return np.array(
            [getattr(found[i], name) if i in found else np.nan for i in range(len(bands))]
        )

    nothing = np.full(len(first.response), np.nan)
    places = over_bands("position")
    return EdgeTable(
        place.label,
        first.axis,
        place.box,
        float(np.nanmedian(over_bands("angle_deg"))),
        bands,
        np.array([found[i].response if i in found else nothing for i in range(len(bands))]),
        over_bands("sfr50"),
        over_bands("sfr10"),
        over_bands("efficiency"),
        over_bands("most"),
        places - np.nanmean(places),
        {bands[i].label: refused.problems[0].message for i, refused in refusals.items()},
    )


def rate_edges(tables: Sequence[EdgeTable]) -> list[IndicatorRow]:
    """Return the rows of slanted edges: each of the worst band and axis."""
    if not tables:
        return []
    rows = []
    for key, name, unit, part, scale, best in (
        ("efficiency", "sampling efficiency, least", "%", "efficiency", 100, np.nanargmin),
        ("half", "frequency of half modulation, least", "% of half sampling", "sfr50", 200, np.nanargmin),
        ("sharpening", "largest modulation (sharpening)", "", "most", 1, np.nanargmax),
    ):  # fmt: skip
        values = [getattr(table, part) for table in tables]
        ends = [float(v[best(v)]) for v in values]
        worst = int(best(ends))
        table = tables[worst]
        where = f"{table.bands[int(best(values[worst]))].label}, {table.axis}"
        rows.append(indicator(key, f"{name} ({where})", scale * ends[worst], unit))
    several = [table for table in tables if np.isfinite(table.shift).sum() > 1]
    if several:
        table = max(several, key=lambda t: t.largest_shift)
        low, high = (
            table.bands[int(i)].label
            for i in (np.nanargmin(table.shift), np.nanargmax(table.shift))
        )
        name = f"colour misregistration, largest ({low} to {high}, {table.axis})"
        rows.append(indicator("misregistration", name, table.largest_shift, "px"))
    return rows
