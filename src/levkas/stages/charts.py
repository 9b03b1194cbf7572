"""Charts of a campaign or in a cube: developed, found, measured."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.cube import Cube
from levkas.core.problems import Problem, Refused, unknown_name
from levkas.quality.image_quality.slanted_edge import EdgeRefused
from levkas.quality.targets.charts import (
    EDGES,
    Chart,
    ChartReference,
    ChartRefused,
    kind_of,
    reference_of,
)
from levkas.quality.targets.edges import (
    EdgeFindings,
    EdgePlace,
    EdgeTargetMeasure,
    join_findings,
    measure_named,
)
from levkas.quality.targets.indicators import WhiteEvenness
from levkas.quality.targets.locating import locate_in_cube
from levkas.quality.targets.measuring import ChartMeasure, Sighting, measure
from levkas.quality.targets.stray_light import describe_trap
from levkas.stages.chart_files import ChartFiles, charts_in, is_database, read_cube_file

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture, FrameRef
    from levkas.database.layout import Places
    from levkas.stages.parts import CalibratedCapture
    from levkas.stages.template_cache import TemplateCache

CHART = "ColorChecker24"
"""That is looked for where none is named."""
ENCODED = (
    "these are counts: of a rendered photograph the response is that of its encoded values, and "
    "ISO 12233 requires linear ones"
)
Measure = ChartMeasure | EdgeTargetMeasure


@dataclass(frozen=True, eq=False)
class DevelopedChart:
    """A chart's cubes, sensor by sensor, with two independent halves of the shots where there are.

    Parameters
    ----------
    patterns : dict
        Band of each sensel, of sensors with a mosaic.
    steps : dict
        What a step from code to code is of the values of each band.
    count : int
        Shots that the values are the mean of, in the band of fewest.
    edges : dict
        Slanted edges that are named.
    common : dict
        Variance that all shots share.
    trapped : dict
        Stray light in light traps, as `quality.targets.stray_light.OfView.to_dict` writes it.
    """

    cubes: dict[str, Cube]
    shots: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    patterns: Mapping[str, np.ndarray] = field(default_factory=dict)
    captured: str = ""
    steps: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    count: int = 1
    edges: Mapping[str, tuple[EdgePlace, ...]] = field(default_factory=dict)
    common: Mapping[str, np.ndarray] = field(default_factory=dict)
    trapped: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


# --- charts of a campaign, or in files ------------------------------------------------------------


@dataclass(frozen=True)
class ChartReport:
    """All charts of a run: what was measured, and what was refused."""

    measures: list[Measure] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether a chart was measured, and none refused."""
        return bool(self.measures) and not self.problems

    @property
    def text(self) -> str:
        """What a person wants to know."""
        return "\n".join(line for m in self.measures for line in _lines(m))

    def to_dict(self) -> dict[str, Any]:
        """Return the fields of `chart --json`."""
        return {"charts": [m.to_dict() for m in self.measures]}

    def page(self, title: str) -> str:
        """Return a report page as HTML."""
        from levkas import __version__
        from levkas.pages.charts import describe_chart
        from levkas.pages.page import render_page

        return render_page(
            "camera.html",
            page={
                "title": title,
                "subtitle": "Charts: signal, noise and colour",
                "charts": [describe_chart(m) for m in self.measures],
                "problems": [{"code": p.code, "text": str(p)} for p in self.problems],
                "footer": f"Levkas {__version__}. Coordinates are in native pixels.",
            },
        )


def measure_charts(
    subject: str | Path,
    *,
    kind: str | None = None,
    cameras: Sequence[str] = (),
    corners: np.ndarray | None = None,
    reference: str | Path | None = None,
    objects: Sequence[str] = (),
    edges: Sequence[EdgePlace] = (),
) -> ChartReport:
    """Measure the charts of a campaign or of a published database, or one in a calibrated cube.

    Raises Refused where the campaign, the cube or the reference cannot be read, or an option has no meaning for it. What is
    wrong with single charts is in the report.

    Parameters
    ----------
    subject : path
        A campaign (every chart that it declares, by every camera that saw it); a published database (the charts that it keeps,
        or `objects` that are charts); or a cube: a TIFF or ENVI file of reflectance, or a photograph.
    kind : str, optional
        Of the chart in a cube or in layers, "edges" for slanted edges alone; "ColorChecker24" without. A campaign, and what a
        database keeps in charts/, declare their own.
    cameras : sequence of str
        Only these cameras of a campaign or database.
    corners : (4, 2), optional
        Centres of the corner patches, native px, clockwise from the first patch.
    reference : path, optional
        CSV of the chart's spectra; default the published average.
    edges : sequence of EdgePlace
        Slanted edges, px of the cube; of a database, of the grid. A campaign says them in `targets.edges`.
    """
    path, report = Path(subject), ChartReport()
    charts: Iterable[tuple[str, Path, Chart | None, Callable[[], DevelopedChart]]]
    if path.is_file() and path.name != "campaign.toml":
        _refuse(path, "a cube", {"--camera": cameras, "--object": objects})
        one = ChartFiles(path.name, kind_of(kind or CHART), {"": path}, quantity="")
        charts = map(partial(_of_files, tuple(edges)), [one])
    elif is_database(path):
        if not objects:
            _refuse(path, "the charts that a database keeps", {"--kind": kind})
        found = charts_in(path, kind or CHART, cameras=cameras, objects=objects)
        charts = map(partial(_of_files, tuple(edges)), found)
    else:
        _refuse(path, "a campaign", {"--kind": kind, "--object": objects, "--edge": edges})
        charts = _of_campaign(path, cameras, report)
    for name, file, chart, develop in charts:
        try:
            spectra = _reference(chart, reference)
            measured = measure_chart(name, develop(), chart, spectra, corners=corners)
            report.measures.append(measured)
            report.problems.extend(problems_of(name, file, measured.edges.problems))
        except Refused as refused:
            report.problems.extend(problems_of(name, file, refused.problems))
    return report


Subject = tuple[str, Path, Chart | None, Callable[[], DevelopedChart]]
"""A name for people, where it stands, the chart, None where slanted edges alone are measured, and how it is developed."""


def _refuse(path: Path, what: str, options: Mapping[str, Any]) -> None:
    """Refuse options that mean nothing for a subject; each with a value is one."""
    fix = "Leave the option out, or give the subject that it is for."
    problems = [
        Problem("E_VALUE", f"{option} has no effect with {what}", str(path), option, fix=fix)
        for option, value in options.items()
        if value
    ]
    if problems:
        raise ChartRefused(*problems)


def _reference(chart: Chart | None, path: str | Path | None) -> ChartReference | None:
    if chart is None:
        return None
    from levkas.core.text import read_text
    from levkas.quality.targets.charts import parse_reference

    if path is None:
        return reference_of(chart)
    text = read_text(Path(path), "a CSV of the chart's spectra")
    return parse_reference(text, chart, file=str(path))


def _of_files(edges: tuple[EdgePlace, ...], chart: ChartFiles) -> Subject:
    """Return a chart in files; those of a database say of which quantity they are."""

    def read() -> DevelopedChart:
        cubes: dict[str, Cube] = {}
        said: tuple[str, ...] = ()
        for sensor, path in chart.files.items():
            cube, said = read_cube_file(path)
            cubes[sensor] = replace(cube, quantity=chart.quantity or cube.quantity)
        places = {sensor: edges or chart.edges.get(sensor, ()) for sensor in cubes}
        return DevelopedChart(cubes, edges=places, notes=(*said, *chart.notes))

    return chart.name, next(iter(chart.files.values())), chart.chart, read


def _of_campaign(path: Path, cameras: Sequence[str], report: ChartReport) -> Iterator[Subject]:
    """Yield every chart of a campaign; what cannot be found is named in the report."""
    from levkas.campaign.campaign import load_campaign
    from levkas.campaign.discovery.find_captures import find_charts
    from levkas.database.layout import Places
    from levkas.stages.template_cache import TemplateCache

    campaign = load_campaign(path)
    file, kinds = str(campaign.path), campaign.targets.charts
    if not kinds:
        raise ChartRefused(
            Problem(
                "E_CHART_MISSING",
                "the campaign declares no chart",
                file,
                "targets.charts",
                fix='Write charts = { macbeth = "ColorChecker24" } for frames of {target} macbeth.',
            )
        )
    what, known = "the campaign has no camera of this name", campaign.cameras
    if unknown := [n for n in cameras if n not in known]:
        named = (unknown_name(what, n, known, file=file, field="--camera") for n in unknown)
        raise ChartRefused(*named)
    templates = TemplateCache(Places(campaign.output).kept)
    captures, refusals = find_charts(campaign)
    report.problems.extend(p for r in refusals.values() for p in r.problems)
    for capture in captures:
        if not cameras or capture.camera in cameras:
            name, chart = f"{capture.object}/{capture.layer}", kind_of(kinds[capture.object])
            develop = partial(develop_chart, capture, campaign, templates)
            yield name, folder_of_frames(capture), chart, develop


# --- developing -----------------------------------------------------------------------------------


def develop_chart(capture: Capture, campaign: Campaign, templates: TemplateCache) -> DevelopedChart:
    """Calibrate a chart's frames in two halves where every band has two shots, else as one."""
    from levkas.calibration.patterns import channel_table
    from levkas.stages.calibrate import develop

    groups = _groups(capture)
    count = min(len(group) for group in groups)
    halves = count > 1 and not campaign.cameras[capture.camera].traits.is_scanned
    if halves:  # an odd shot is left out
        groups = [group[: len(group) // 2 * 2] for group in groups]
        count = count // 2 * 2
    whole = develop(_with_shots(capture, groups), campaign, templates)
    cubes, shots, common = whole.cubes, {}, {}
    if halves:
        sides = (_with_shots(capture, [group[k::2] for group in groups]) for k in (0, 1))
        first, second = (develop(half, campaign, templates).cubes for half in sides)
        for name, cube in cubes.items():
            one, other = first[name], second[name]
            shots[name] = one.values, other.values
            if cube.sigma is not None and one.sigma is not None and other.sigma is not None:
                # Half of the shots have the variance o + c, all of them o/2 + c.
                both, *two = (
                    np.square(s, dtype=float) for s in (cube.sigma, one.sigma, other.sigma)
                )
                common[name] = 2 * both - (two[0] + two[1]) / 2
    return DevelopedChart(
        cubes,
        shots,
        {
            s.name: channel_table(s.pattern, [band.label for band in s.bands])
            for s in capture.sensors
            if s.pattern is not None
        },
        whole.captured or "",
        {
            name: tuple(
                _of_sensor(whole, name, "rounding").get(label, 0.0) for label in cube.labels
            )
            for name, cube in cubes.items()
        },
        count,
        edges_of(campaign, capture),
        common,
        {n: found for n in whole.measured if (found := _of_sensor(whole, n, "stray_light"))},
    )


def _of_sensor(native: CalibratedCapture, sensor: str, key: str) -> dict[str, Any]:
    """Return what was measured of a sensor under a key; empty where nothing was."""
    found: dict[str, Any] = native.measured.get(sensor, {}).get(key, {})
    return found


def edges_of(campaign: Campaign, capture: Capture) -> dict[str, tuple[EdgePlace, ...]]:
    """Return the slanted edges that a campaign names in a capture of a chart, by sensor."""
    named = capture.boxes(campaign.targets.edges.get(capture.object, {}))
    return {
        sensor: tuple(
            EdgePlace(f"edge {i} ({x},{y},{w},{h})", (x, y, w, h))
            for i, (x, y, w, h) in enumerate(boxes, 1)
        )
        for sensor, boxes in named.items()
    }


def _groups(capture: Capture) -> list[list[FrameRef]]:
    """Return the shots of each sensor, band and exposure."""
    groups: dict[Any, list[FrameRef]] = {}
    for sensor in capture.sensors:
        for frame in sensor.object:
            key = sensor.name, frame.band, frame.exposure_s, frame.page
            groups.setdefault(key, []).append(frame)
    return list(groups.values())


def _with_shots(capture: Capture, groups: Sequence[Sequence[FrameRef]]) -> Capture:
    """Return a capture with these shots alone."""
    chosen = {frame for group in groups for frame in group}
    kept = (tuple(f for f in sensor.object if f in chosen) for sensor in capture.sensors)
    sensors = zip(capture.sensors, kept, strict=True)
    return replace(capture, sensors=tuple(replace(s, object=some) for s, some in sensors))


# --- measuring ------------------------------------------------------------------------------------


def measure_chart(
    name: str,
    developed: DevelopedChart,
    chart: Chart | None,
    reference: ChartReference | None,
    *,
    corners: np.ndarray | None = None,
    evenness: WhiteEvenness | None = None,
) -> Measure:
    """Find the chart in every sensor's cube, and measure it; without a chart, its slanted edges."""
    traps = tuple(text for one in developed.trapped.values() if (text := describe_trap(one)))
    if chart is None:
        edges = _measure_edges(name, developed)
        edges = replace(edges, notes=(*edges.notes, *traps))
        return EdgeTargetMeasure(name, developed.cubes, edges, stray_light="; ".join(traps))
    sightings: list[Sighting] = []
    for sensor, cube in developed.cubes.items():
        near = sightings[0].located.corners if sightings else None
        sightings.append(
            Sighting(
                sensor,
                locate_in_cube(cube, chart, reference, corners=corners, near=near),
                cube,
                developed.shots.get(sensor),
                developed.steps.get(sensor),
                developed.count,
                developed.patterns.get(sensor),
                developed.edges.get(sensor, ()),
                developed.common.get(sensor),
            )
        )
    notes = developed.notes
    found = measure(name, chart, sightings, reference, evenness=evenness, notes=notes)
    return replace(found, notes=(*found.notes, *traps), trapped="; ".join(traps))


def _measure_edges(name: str, developed: DevelopedChart) -> EdgeFindings:
    """Measure the slanted edges of a target without a colour chart; raises EdgeRefused, ``E_EDGE_MISSING`` where none is named."""
    cubes, places = developed.cubes, developed.edges
    if not any(places.values()) and not developed.trapped:
        raise EdgeRefused(
            Problem(
                "E_EDGE_MISSING", f"{name}: no slanted edge is declared", None, "targets.edges",
                expected="a rectangle around one edge that is tilted by about 5 degrees",
                fix="Write edges = { TARGET = { CAMERA = [x, y, width, height] } }, or give --edge x,y,width,height.",
            )
        )  # fmt: skip
    periods = {sensor: max(pattern.shape) for sensor, pattern in developed.patterns.items()}
    found = [
        measure_named(cube, places.get(sensor, ()), period=periods.get(sensor, 1))
        for sensor, cube in cubes.items()
    ]
    if any(cube.quantity == "counts" for cube in cubes.values()):
        found.append(EdgeFindings(notes=(ENCODED,)))
    return join_findings(found)


def folder_of_frames(capture: Capture) -> Path:
    """Return where the frames of a capture stand."""
    return capture.sensors[0].object[0].path.parent


def problems_of(name: str, file: Path, problems: Sequence[Problem]) -> list[Problem]:
    """Return what is wrong with a chart, with whose it is and where it stands."""
    return [replace(p, message=f"{name}: {p.message}", file=p.file or str(file)) for p in problems]


def stray_light_in(developed: DevelopedChart, measured: Measure) -> dict[str, Any]:
    """Return the stray light that a chart's light traps show, else its greys; empty where neither does.

    As `quality.targets.stray_light.OfView.to_dict` writes it; of several sensors together.
    """
    if developed.trapped:
        every = [*developed.trapped.values()]
        return every[0] | {"bands": {b: v for one in every for b, v in one["bands"].items()}}
    if isinstance(measured, EdgeTargetMeasure) or measured.stray is None:
        return {}
    found = measured.stray.of_view
    return {} if found is None else found.to_dict(measured.bands)


def _lines(measure: Measure) -> list[str]:
    """Return what a person wants to know of a chart."""
    tables = measure.edges.tables
    if isinstance(measure, EdgeTargetMeasure):
        lines = [f"{measure.name}: {len(tables)} slanted edge{'s' * (len(tables) != 1)}"]
    else:
        greys = list(measure.chart.greys)
        white, black = (_span(measure.snr_db[g]) for g in (greys[0], greys[-1]))
        agreement = min(s.located.agreement for s in measure.sightings)
        lines = [
            f"{measure.name}: {measure.chart.name} found, rank correlation {agreement:.3f}",
            f"  SNR of the white patch {white}, of the black one {black} (dB of Eq. 1)",
        ]
        known = zip(measure.bands, measure.preblurs, strict=True)
        if blurred := [band.label for band, blur in known if blur and blur.found]:
            lines.append(
                f"  the noise of neighbouring pixels is correlated in {', '.join(blurred)} (blur or "
                "demosaicing): SNR corrected"
            )
    for table in tables:
        found = "; ".join(
            f"{name} {np.nanmin(values):.3f} to {np.nanmax(values):.3f}"
            for name, values in (("SFR50", table.sfr50), ("SFR10", table.sfr10))
        )
        lines.append(
            f"  {table.label}: {abs(table.angle_deg):.1f} degrees, along {table.axis}: {found} cycles/px"
        )
    lines += [
        f"  {row.name}: {f'{row.value:.2f} {row.unit}'.rstrip()} (aim {row.aim}; FADGI {row.fadgi}, ISO 19264-1 {row.iso}; "
        "indicators only)"
        for row in measure.rows
    ]
    return lines + [f"  note: {note}" for note in measure.notes]


def _span(values: np.ndarray) -> str:
    good = values[np.isfinite(values)]
    return f"{good.min():.1f} to {good.max():.1f}" if good.size else "not known"


def write_chart(
    places: Places,
    campaign: Campaign,
    capture: Capture,
    developed: DevelopedChart,
    measure: Measure,
) -> list[Path]:
    """Write charts/CHART/: calibrated cubes in native pixels, one a sensor, and what was measured."""
    from levkas.core.files import write_json
    from levkas.database.credits import Credits
    from levkas.database.layers import Layer, write_tiffs
    from levkas.stages.spectra import broad_centroids

    kind = EDGES if isinstance(measure, EdgeTargetMeasure) else measure.chart.name
    folder = places.output / "charts" / capture.object
    credits = Credits(f"{kind}, {capture.layer}", date=developed.captured or "")
    centroids = broad_centroids(campaign, capture.camera, capture.bands)
    layer = Layer(
        *(capture.object, capture.camera, capture.setup), credits=credits, centroids=centroids
    )
    written = []
    for sensor, cube in developed.cubes.items():
        stem = "_".join(part for part in (layer.id.stem, sensor) if part)
        written += write_tiffs(folder / stem, layer, cube)
    record = folder / f"{layer.id.stem}.json"
    head = {"chart": kind, "quantity": next(iter(developed.cubes.values())).quantity}
    named = {
        sensor: {label: list(box) for label, box in edges}
        for sensor, edges in developed.edges.items()
    }
    edges = {"named_edges": named} if named else {}
    write_json(record, {**head, **edges, **measure.to_dict()})
    return [*written, record]
