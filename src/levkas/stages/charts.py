"""Charts of a campaign or in a cube: developed, found, measured."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
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
from levkas.quality.targets.indicators import IndicatorRow, WhiteEvenness
from levkas.quality.targets.locating import locate_in_cube
from levkas.quality.targets.measuring import ChartMeasure, Sighting, measure
from levkas.quality.targets.stray_light import describe_trap
from levkas.stages.capture_statistics import ROUNDING, STRAYED
from levkas.stages.chart_files import Subject, is_database, subjects_of

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture, FrameRef, SensorFrames
    from levkas.database.layout import Places
    from levkas.stages.parts import CalibratedCapture
    from levkas.stages.template_cache import TemplateCache

CHART = "ColorChecker24"
"""That is looked for where none is named."""
NOT_FOUND = ("E_CHART_MISSING", "E_CHART_FRAME", "E_CHART_SIZE", "E_CHART_ORDER")
"""Refusals that say no more than that a layer, which need not be one, is no chart."""

ENCODED = (
    "these are counts: of a rendered photograph the response is that of its encoded values, and "
    "ISO 12233 requires linear ones"
)

# --- charts of a campaign, or in files ------------------------------------------------------------


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
        A campaign (every chart that it declares, by every camera that saw it); a published database
        (the charts that it keeps, or objects that are charts); or a cube: a TIFF or ENVI file of
        reflectance.
    kind : str, optional
        Of the chart in a cube or in layers, "edges" for slanted edges alone; "ColorChecker24" without. A campaign,
        and what a database keeps in charts/, declare their own.
    cameras : sequence of str
        Only these cameras of a campaign or database.
    corners : (4, 2), optional
        Centres of the corner patches, native px, clockwise from the first patch.
    reference : path, optional
        CSV of the chart's spectra; default the published average.
    objects : sequence of str
        Objects of a database that are charts.
    edges : sequence of EdgePlace
        Slanted edges, px of the cube; of a database, of the grid. A campaign says them in `targets.edges`.
    """
    path = Path(subject)
    report = ChartReport()
    if path.is_file() and path.name != "campaign.toml":
        _refuse(path, "a cube", {"--camera": cameras, "--object": objects})
        files = [Subject(path.name, kind_of(kind or CHART), {"": path}, True)]
        return _measure_cubes(files, report, corners, reference, edges)
    if is_database(path):
        known = corners is not None or bool(edges)
        if kind is not None and not objects and (path / "charts").is_dir():
            _refuse(path, "the charts that a database keeps", {"--kind": kind})
        layers = subjects_of(path, kind or CHART, cameras=cameras, objects=objects, corners=known)
        found = _measure_cubes(layers, report, corners, reference, edges)
        if not found.measures and not found.problems:
            found.problems.append(
                Problem(
                    "E_CHART_MISSING",
                    f"no layer of the database shows {kind or CHART}",
                    str(path),
                    fix="Name the chart with --object, or give --corners.",
                )
            )
        return found
    _refuse(path, "a campaign", {"--kind": kind, "--object": objects, "--edge": edges})
    for capture, chart, developed in _of_campaign(path, cameras, report):
        spectra = _reference(chart, reference)
        name = f"{capture.object}/{capture.layer}"
        try:
            measured = measure_capture(name, developed, chart, spectra, corners=corners)
            report.measures.append(measured)
            report.problems.extend(problems_of(name, capture, Refused(*measured.edges.problems)))
        except Refused as refused:
            report.problems.extend(problems_of(name, capture, refused))
    return report


def _refuse(path: Path, what: str, options: Mapping[str, Any]) -> None:
    """Refuse options that mean nothing for a subject; each with a value is one."""
    problems = [
        Problem(
            "E_VALUE",
            f"{option} has no effect with {what}",
            str(path),
            option,
            fix="Leave the option out, or give the subject that it is for.",
        )
        for option, value in options.items()
        if value
    ]
    if problems:
        raise ChartRefused(*problems)


def _measure_cubes(
    subjects: Iterable[Subject],
    report: ChartReport,
    corners: np.ndarray | None,
    reference: str | Path | None,
    edges: Sequence[EdgePlace] = (),
) -> ChartReport:
    """Measure charts in calibrated cubes; a layer that need not hold one is passed over without."""
    for subject in subjects:
        file = str(next(iter(subject.files.values())))
        try:
            measured = _measure_subject(subject, corners, reference, tuple(edges))
            report.measures.append(measured)
            report.problems.extend(replace(p, file=p.file or file) for p in measured.edges.problems)
        except Refused as refused:
            if not subject.certain and all(p.code in NOT_FOUND for p in refused.problems):
                continue
            report.problems.extend(replace(p, file=p.file or file) for p in refused.problems)
    return report


def _measure_subject(
    subject: Subject,
    corners: np.ndarray | None,
    reference: str | Path | None,
    edges: tuple[EdgePlace, ...],
) -> ChartMeasure | EdgeTargetMeasure:
    """Measure the chart of one subject; of a kept one by the edges that its campaign named, where none are given."""
    places = {sensor: edges or subject.edges.get(sensor, ()) for sensor in subject.files}
    if subject.chart is None:
        cubes = {sensor: subject.read(path).cube for sensor, path in subject.files.items()}
        return measure_edges_of(subject.name, cubes, places)
    spectra = _reference(subject.chart, reference)
    sightings: list[Sighting] = []
    notes: tuple[str, ...] = ()
    for sensor, path in subject.files.items():
        cube, notes = subject.read(path)
        near = sightings[0].located.corners if sightings else None
        found = locate_in_cube(cube, subject.chart, spectra, corners=corners, near=near)
        sightings.append(Sighting(sensor, found, cube, edges=places[sensor]))
    return measure(subject.name, subject.chart, sightings, spectra, notes=notes)


def measure_edges_of(
    name: str,
    cubes: Mapping[str, Cube],
    places: Mapping[str, Sequence[EdgePlace]],
    patterns: Mapping[str, np.ndarray] = MappingProxyType({}),
    *,
    trapped: bool = False,
) -> EdgeTargetMeasure:
    """Measure the slanted edges of a target without a colour chart.

    `patterns` are mosaics by sensor; `trapped` says that it has light traps, and needs no edge.

    Raises EdgeRefused, ``E_EDGE_MISSING`` where none is named.
    """
    if not any(places.values()) and not trapped:
        raise EdgeRefused(
            Problem(
                "E_EDGE_MISSING", f"{name}: no slanted edge is declared", None, "targets.edges",
                expected="a rectangle around one edge that is tilted by about 5 degrees",
                fix="Write edges = { TARGET = { CAMERA = [x, y, width, height] } }, or give --edge x,y,width,height.",
            )
        )  # fmt: skip
    periods = {sensor: max(pattern.shape) for sensor, pattern in patterns.items()}
    found = [
        measure_named(cube, places.get(sensor, ()), period=periods.get(sensor, 1))
        for sensor, cube in cubes.items()
    ]
    if any(cube.quantity == "counts" for cube in cubes.values()):
        found.append(EdgeFindings(notes=(ENCODED,)))
    return EdgeTargetMeasure(name, dict(cubes), join_findings(found))


def problems_of(name: str, capture: Capture, refused: Refused) -> list[Problem]:
    """Return what is wrong with a chart, with whose it is and where its frames stand."""
    frame = capture.sensors[0].object[0].path
    return [
        replace(p, message=f"{name}: {p.message}", file=p.file or str(frame.parent))
        for p in refused.problems
    ]


def _of_campaign(
    path: Path, cameras: Sequence[str], report: ChartReport
) -> Iterator[tuple[Capture, Chart | None, Developed]]:
    """Develop every chart of a campaign; what cannot be is named in the report."""
    from levkas.campaign.campaign import load_campaign
    from levkas.campaign.discovery.find_captures import find_charts
    from levkas.database.layout import Places
    from levkas.stages.template_cache import TemplateCache

    campaign = load_campaign(path)
    kinds = {name: kind_of(kind) for name, kind in campaign.targets.charts.items()}
    if not kinds:
        raise ChartRefused(
            Problem(
                "E_CHART_MISSING",
                "the campaign declares no chart",
                str(campaign.path),
                "targets.charts",
                fix='Write charts = { macbeth = "ColorChecker24" } for frames of {target} macbeth.',
            )
        )
    if unknown := [name for name in cameras if name not in campaign.cameras]:
        what, file = "the campaign has no camera of this name", str(campaign.path)
        known = campaign.cameras
        raise ChartRefused(
            *(unknown_name(what, n, known, file=file, field="--camera") for n in unknown)
        )
    templates = TemplateCache(Places(campaign.output).kept)
    captures, refusals = find_charts(campaign)
    report.problems.extend(p for r in refusals.values() for p in r.problems)
    for capture in captures:
        if not cameras or capture.camera in cameras:
            try:
                yield capture, kinds[capture.object], develop_chart(capture, campaign, templates)
            except Refused as refused:
                report.problems.extend(
                    problems_of(f"{capture.object}/{capture.layer}", capture, refused)
                )


def _reference(chart: Chart | None, path: str | Path | None) -> ChartReference | None:
    if chart is None:
        return None
    from levkas.core.text import read_text
    from levkas.quality.targets.charts import parse_reference

    if path is None:
        return reference_of(chart)
    text = read_text(Path(path), "a CSV of the chart's spectra")
    return parse_reference(text, chart, file=str(path))


# --- developing -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Developed:
    """A chart's cubes, sensor by sensor, with two independent halves of the shots where there are."""

    cubes: dict[str, Cube]
    shots: dict[str, tuple[np.ndarray, np.ndarray]]
    patterns: dict[str, np.ndarray]
    """Band of each sensel, of sensors with a mosaic."""
    captured: str = ""
    steps: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """What a step from code to code is of the values of each band."""
    count: int = 1
    """Shots that the values are the mean of, in the band of fewest."""
    edges: dict[str, tuple[EdgePlace, ...]] = field(default_factory=dict)
    """Slanted edges that the campaign names, by sensor."""
    common: dict[str, np.ndarray] = field(default_factory=dict)
    """Variance that all shots share, by sensor."""
    trapped: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Stray light in light traps, by sensor, as `quality.targets.stray_light.OfView.to_dict` writes it."""


def develop_chart(capture: Capture, campaign: Campaign, templates: TemplateCache) -> Developed:
    """Calibrate a chart's frames in two halves where every band has two shots, else as one."""
    from levkas.calibration.patterns import channel_table
    from levkas.stages.calibrate import develop

    patterns = {
        s.name: channel_table(s.pattern, [band.label for band in s.bands])
        for s in capture.sensors
        if s.pattern is not None
    }
    traits = campaign.cameras[capture.camera].traits
    edges = edges_of(campaign, capture)
    parts = None if traits.is_scanned else _halves(capture)
    if parts is None:
        whole = develop(capture, campaign, templates)
        most = min(_shots_of(capture))
        steps = _steps_of(whole)
        return Developed(
            *(whole.cubes, {}, patterns, whole.captured or "", steps, most, edges),
            trapped=_trapped(whole),
        )
    first, second, whole = (develop(p, campaign, templates) for p in (*parts, _joined(*parts)))
    shots = {name: (a.values, second.cubes[name].values) for name, a in first.cubes.items()}
    common = {
        name: found
        for name, cube in whole.cubes.items()
        if (found := _common_variance(cube, first, second, name)) is not None
    }
    count = 2 * min(_shots_of(parts[0]))
    steps = _steps_of(whole)
    read = (whole.cubes, shots, patterns, whole.captured or "")
    return Developed(*read, steps, count, edges, common, _trapped(whole))


def _trapped(whole: CalibratedCapture) -> dict[str, dict[str, Any]]:
    return {name: one[STRAYED] for name, one in whole.measured.items() if STRAYED in one}


def _joined(first: Capture, second: Capture) -> Capture:
    """Return a capture with the shots of both halves."""
    sensors = (
        replace(a, object=(*a.object, *b.object))
        for a, b in zip(first.sensors, second.sensors, strict=True)
    )
    return replace(first, sensors=tuple(sensors))


def _common_variance(
    cube: Cube, first: CalibratedCapture, second: CalibratedCapture, name: str
) -> np.ndarray | None:
    """Return the variance that all shots of a chart share, of white and dark; None where noise is not known.

    Half of the shots have the variance o + c, all of them o/2 + c.
    """
    halves = [one.cubes[name].sigma for one in (first, second)]
    if cube.sigma is None or any(sigma is None for sigma in halves):
        return None
    squares = [np.square(sigma, dtype=np.float64) for sigma in halves if sigma is not None]
    return np.asarray(2 * np.square(cube.sigma, dtype=np.float64) - (squares[0] + squares[1]) / 2)


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


def _steps_of(developed: CalibratedCapture) -> dict[str, tuple[float, ...]]:
    found = {name: of_sensor.get(ROUNDING, {}) for name, of_sensor in developed.measured.items()}
    return {
        name: tuple(float(found[name].get(band.label, 0.0)) for band in cube.bands)
        for name, cube in developed.cubes.items()
    }


def _shots_of(capture: Capture) -> list[int]:
    """Return how many shots there are of each band and exposure."""
    groups = Counter(
        (sensor.name, frame.band, frame.exposure_s, frame.page)
        for sensor in capture.sensors
        for frame in sensor.object
    )
    return list(groups.values())


def _halves(capture: Capture) -> tuple[Capture, Capture] | None:
    """Two captures of half the shots each; an odd one is left out. None where a band has one shot."""
    halves: tuple[list[SensorFrames], list[SensorFrames]] = ([], [])
    for sensor in capture.sensors:
        groups: dict[Any, list[FrameRef]] = {}
        for frame in sensor.object:
            groups.setdefault((frame.band, frame.exposure_s, frame.page), []).append(frame)
        if any(len(group) < 2 for group in groups.values()):
            return None
        for side, half in enumerate(halves):
            chosen = [f for g in groups.values() for f in g[side : len(g) // 2 * 2 : 2]]
            half.append(replace(sensor, object=tuple(chosen)))
    first, second = (replace(capture, sensors=tuple(half)) for half in halves)
    return first, second


# --- measuring ------------------------------------------------------------------------------------


def measure_capture(
    name: str,
    developed: Developed,
    chart: Chart | None,
    reference: ChartReference | None,
    *,
    corners: np.ndarray | None = None,
    evenness: WhiteEvenness | None = None,
) -> ChartMeasure | EdgeTargetMeasure:
    """Find the chart in every sensor's cube, and measure it; without a chart, its slanted edges."""
    if chart is None:
        edges_found = measure_edges_of(
            *(name, developed.cubes, developed.edges, developed.patterns),
            trapped=bool(developed.trapped),
        )
        return _with_traps(edges_found, developed)
    sightings: list[Sighting] = []
    for sensor, cube in developed.cubes.items():
        near = sightings[0].located.corners if sightings else None
        found = locate_in_cube(cube, chart, reference, corners=corners, near=near)
        shots, steps = developed.shots.get(sensor), developed.steps.get(sensor)
        pattern = developed.patterns.get(sensor)
        edges = developed.edges.get(sensor, ())
        sighting = Sighting(
            sensor, found, cube, shots, steps, developed.count, pattern, edges=edges
        )
        sightings.append(replace(sighting, common=developed.common.get(sensor)))
    return _with_traps(measure(name, chart, sightings, reference, evenness=evenness), developed)


def _with_traps(
    measured: ChartMeasure | EdgeTargetMeasure, developed: Developed
) -> ChartMeasure | EdgeTargetMeasure:
    """Return what was measured of a chart with what its light traps show among its notes."""
    notes = tuple(text for one in developed.trapped.values() if (text := describe_trap(one)))
    text = "; ".join(notes)
    if isinstance(measured, EdgeTargetMeasure):
        edges = replace(measured.edges, notes=(*measured.edges.notes, *notes))
        return replace(measured, edges=edges, stray_light=text)
    return replace(measured, notes=(*measured.notes, *notes), trapped=text)


def stray_light_in(
    developed: Developed, measured: ChartMeasure | EdgeTargetMeasure
) -> dict[str, Any]:
    """Return the stray light that a chart's light traps show, else its greys; empty where neither does.

    As `quality.targets.stray_light.OfView.to_dict` writes it; of several sensors together.
    """
    if developed.trapped:
        first, *others = developed.trapped.values()
        return first | {
            "bands": {b: v for one in (first, *others) for b, v in one["bands"].items()}
        }
    if isinstance(measured, EdgeTargetMeasure) or measured.stray is None:
        return {}
    found = measured.stray.of_view
    return {} if found is None else found.to_dict(measured.bands)


@dataclass(frozen=True)
class ChartReport:
    """All charts of a run: what was measured, and what was refused."""

    measures: list[ChartMeasure | EdgeTargetMeasure] = field(default_factory=list)
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


def _lines(measure: ChartMeasure | EdgeTargetMeasure) -> list[str]:
    if isinstance(measure, EdgeTargetMeasure):
        count = len(measure.edges.tables)
        lines = [f"{measure.name}: {count} slanted edge{'s' * (count != 1)}"]
        return lines + _edge_lines(measure)
    greys = list(measure.chart.greys)
    white, black = (measure.snr_db[g] for g in (greys[0], greys[-1]))
    agreement = min(s.located.agreement for s in measure.sightings)
    lines = [
        f"{measure.name}: {measure.chart.name} found, rank correlation {agreement:.3f}",
        f"  SNR of the white patch {_span(white)}, of the black one {_span(black)} (dB of Eq. 1)",
    ]
    blurred = [
        b.label for b, p in zip(measure.bands, measure.preblurs, strict=True) if p and p.found
    ]
    if blurred:
        lines.append(
            f"  the noise of neighbouring pixels is correlated in {', '.join(blurred)} (blur or "
            "demosaicing): SNR corrected"
        )
    return lines + _edge_lines(measure)


def _edge_lines(measure: ChartMeasure | EdgeTargetMeasure) -> list[str]:
    """Return what edges, indicators and notes say."""
    lines = []
    for table in measure.edges.tables:
        found = "; ".join(
            f"{name} {np.nanmin(values):.3f} to {np.nanmax(values):.3f}"
            for name, values in (("SFR50", table.sfr50), ("SFR10", table.sfr10))
        )
        lines.append(
            f"  {table.label}: {abs(table.angle_deg):.1f} degrees, along {table.axis}: {found} cycles/px"
        )
    lines += [_row_line(row) for row in measure.rows]
    return lines + [f"  note: {note}" for note in measure.notes]


def _row_line(row: IndicatorRow) -> str:
    value = f"{row.value:.2f} {row.unit}".rstrip()
    return f"  {row.name}: {value} (aim {row.aim}; FADGI {row.fadgi}, ISO 19264-1 {row.iso}; indicators only)"


def _span(values: np.ndarray) -> str:
    good = values[np.isfinite(values)]
    return f"{good.min():.1f} to {good.max():.1f}" if good.size else "not known"


def write_chart(
    places: Places,
    campaign: Campaign,
    capture: Capture,
    developed: Developed,
    measure: ChartMeasure | EdgeTargetMeasure,
) -> list[Path]:
    """Write charts/CHART/: calibrated cubes in native pixels, one a sensor, and what was measured."""
    from levkas.core.files import write_json
    from levkas.database.credits import Credits
    from levkas.database.layers import Layer, write_tiffs
    from levkas.stages.spectra import broad_centroids

    chart = capture.object
    folder = places.output / "charts" / chart
    credits = Credits(f"{_kind(measure)}, {capture.layer}", date=developed.captured or "")
    centroids = broad_centroids(campaign, capture.camera, capture.bands)
    layer = Layer(chart, capture.camera, capture.setup, credits=credits, centroids=centroids)
    written = []
    for sensor, cube in developed.cubes.items():
        stem = "_".join(part for part in (layer.id.stem, sensor) if part)
        written += write_tiffs(folder / stem, layer, cube)
    record = folder / f"{layer.id.stem}.json"
    quantity = next(iter(developed.cubes.values())).quantity
    named = {
        sensor: {label: list(box) for label, box in places}
        for sensor, places in developed.edges.items()
    }
    edges = {"named_edges": named} if named else {}
    write_json(
        record, {"chart": _kind(measure), "quantity": quantity, **edges, **measure.to_dict()}
    )
    return [*written, record]


def _kind(measure: ChartMeasure | EdgeTargetMeasure) -> str:
    return EDGES if isinstance(measure, EdgeTargetMeasure) else measure.chart.name
