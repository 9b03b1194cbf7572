"""Slanted edges of a target: named by rectangles, or found on the borders of a chart's grey patches."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import numpy as np

from levkas.core.cube import Flag, is_flagged
from levkas.core.problems import Problem
from levkas.geometry.transforms import Homography
from levkas.quality.image_quality.slanted_edge import (
    LEAST_ANGLE,
    EdgeRefused,
    EdgeResponse,
    measure_edge,
)
from levkas.quality.targets.charts import EDGES
from levkas.quality.targets.indicators import IndicatorRow, indicator

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.core.cube import Band, Cube
    from levkas.quality.targets.charts import Chart
    from levkas.quality.targets.locating import Located

Box = tuple[int, int, int, int]
MOST_BORDER_ANGLE = 10.0
"""Degrees: borders of patches are short."""
LEAST_BORDER_LUMINANCE = 0.15
"""Of a grey patch, against the black round it."""
BORDER = 0.41
"""Of the pitch: half the side of a patch."""
ALONG, ACROSS = 0.3, 0.14
"""Half sides of a border's rectangle, of the pitch: clear of corners, and of the patch next to it."""


class EdgePlace(NamedTuple):
    """Where an edge is: a rectangle x, y, width, height in the pixels of the cube, and what it is called."""

    label: str
    box: Box


def parse_edges(texts: Sequence[str]) -> tuple[EdgePlace, ...]:
    """Return slanted edges from ``x,y,width,height``.

    Raises
    ------
    EdgeRefused
        ``E_VALUE``.

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
    """Spatial frequency response of all bands across one edge, or the median of several alike.

    Parameters
    ----------
    label : str
    axis : {"x", "y"}
    boxes : tuple of Box
    angle_deg : float
    bands : tuple of Band
    response : ndarray, (bands, frequencies)
        NaN where a band was refused.
    sfr50, sfr10 : ndarray, (bands,)
        Cycles/px.
    efficiency, most : ndarray, (bands,)
        Sampling efficiency, 0 … 1; largest modulation.
    shift : ndarray, (bands,)
        Place of the edge about the bands' mean, px normal to the edge.
    origin : float
        That mean, px in the cube's frame; NaN for the median of several edges.
    refused : dict
        By band, why its response could not be measured.
    """

    label: str
    axis: str
    boxes: tuple[Box, ...]
    angle_deg: float
    bands: tuple[Band, ...]
    response: np.ndarray
    sfr50: np.ndarray
    sfr10: np.ndarray
    efficiency: np.ndarray
    most: np.ndarray
    shift: np.ndarray
    origin: float
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
            "rectangles": [list(box) for box in self.boxes],
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


def measure_borders(cube: Cube, located: Located, chart: Chart, *, period: int = 1) -> EdgeFindings:
    """Measure the borders of a chart's bright greys where the chart leans by 2 to 10 degrees."""
    sides = located.corners[[1, 3]] - located.corners[0]
    lean = [
        abs((np.rad2deg(np.arctan2(*side[::-1])) + 45) % 90 - 45) for side in sides.astype(float)
    ]
    if min(lean) < LEAST_ANGLE or max(lean) > MOST_BORDER_ANGLE:
        note = (
            f"the borders of the patches lean by {np.mean(lean):.1f} degrees: turn the chart by about 5 "
            "degrees, or name slanted edges, for the spatial frequency response and colour misregistration"
        )
        return EdgeFindings(notes=(note,))
    found: dict[str, list[EdgeTable]] = {"x": [], "y": []}
    for place in border_places(located, chart, (cube.values.shape[1], cube.values.shape[0])):
        try:
            table = _tabulate(cube, place, period)
            found[table.axis].append(table)
        except EdgeRefused:
            continue  # a border may be too short, or soft: others are there
    tables = tuple(_median(axis, several) for axis, several in found.items() if several)
    notes = () if tables else ("no border of a patch is long and sharp enough for its response",)
    return EdgeFindings(tables, notes=notes)


def border_places(located: Located, chart: Chart, size: tuple[int, int]) -> list[EdgePlace]:
    """Return upright rectangles round the middle of the four borders of every bright grey patch."""
    plane = Homography.fit(chart.corners, located.corners)
    places = []
    for patch in (g for g in chart.greys if chart.luminances[g] > LEAST_BORDER_LUMINANCE):
        for name, way in (("left", (-1, 0)), ("right", (1, 0)), ("top", (0, -1)), ("bottom", (0, 1))):  # fmt: skip
            out = np.array(way, float)
            middle = chart.centres[patch] + BORDER * out
            ends = np.array([middle, middle + ACROSS * out, middle + ALONG * out[::-1]])
            at, across, along = plane(ends)
            half = np.maximum(np.abs(across - at), np.abs(along - at))
            low = np.ceil(at - half).astype(int)
            high = np.floor(at + half).astype(int) + 1
            if np.all(low >= 0) and high[0] <= size[0] and high[1] <= size[1]:
                box = (int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))
                places.append(EdgePlace(f"{chart.patches[patch]}, {name}", box))
    return places


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
    origin = float(np.nanmean(places))
    return EdgeTable(
        place.label,
        first.axis,
        (place.box,),
        float(np.nanmedian(over_bands("angle_deg"))),
        bands,
        np.array([found[i].response if i in found else nothing for i in range(len(bands))]),
        over_bands("sfr50"),
        over_bands("sfr10"),
        over_bands("efficiency"),
        over_bands("most"),
        places - origin,
        origin + place.box[0 if first.axis == "x" else 1],
        {bands[i].label: refused.problems[0].message for i, refused in refusals.items()},
    )


def _median(axis: str, tables: list[EdgeTable]) -> EdgeTable:
    """Return the median over edges that lean alike, band by band."""
    import warnings

    def middle(name: str) -> np.ndarray:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a band that no edge has
            return np.asarray(np.nanmedian([getattr(t, name) for t in tables], axis=0))

    first = tables[0]
    refused_bands = {band for table in tables for band in table.refused}
    nowhere = {b: first.refused[b] for b in refused_bands if all(b in t.refused for t in tables)}
    return EdgeTable(
        f"{len(tables)} border{'s' * (len(tables) > 1)} of grey patches",
        axis,
        tuple(box for table in tables for box in table.boxes),
        float(np.median([table.angle_deg for table in tables])),
        first.bands,
        middle("response"),
        middle("sfr50"),
        middle("sfr10"),
        middle("efficiency"),
        middle("most"),
        middle("shift"),
        float("nan"),
        nowhere,
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


class _Measured(Protocol):
    """A chart or a target of edges that was measured."""

    @property
    def name(self) -> str: ...
    @property
    def edges(self) -> EdgeFindings: ...


def layer_rows(measures: Sequence[_Measured]) -> list[IndicatorRow]:
    """Return the shift between the layers of each object on the grid, at every edge that several of them show.

    Notes
    -----
    A layer's edge lies where its bands have it in the mean. Names of measures are OBJECT/LAYER.
    """
    places_of: dict[tuple[str, str, str], list[tuple[str, float]]] = {}
    for measure in measures:
        thing, slash, layer = measure.name.partition("/")
        for table in measure.edges.tables:
            if slash and np.isfinite(table.origin):
                places = places_of.setdefault((thing, table.label, table.axis), [])
                places.append((layer, table.origin))
    rows = []
    for (thing, label, axis), places in places_of.items():
        if len(places) > 1:
            low, high = (pick(places, key=lambda p: p[1]) for pick in (min, max))
            name = f"{thing}, {label}, along {axis}: shift between layers, largest ({low[0]} to {high[0]})"
            rows.append(indicator("misregistration", name, high[1] - low[1], "px"))
    return rows
