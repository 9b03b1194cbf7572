"""A build: the tasks of a campaign's graph, what is fresh left alone; and what of them is stale."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from levkas.building import fingerprints, sources
from levkas.building.build_records import CATALOGUE, BuildRecords, Key, key_of
from levkas.building.camera_pages import CameraPage, camera_pages, prints_of_page, write_camera_page
from levkas.building.catalogue import (
    by_others,
    foreign_files,
    prints_of_catalogue,
    setups_of,
    spectra_of,
    write_catalogue_of,
)
from levkas.building.claiming import check_apart, claim
from levkas.building.executor import Executor, fresh_step
from levkas.building.fingerprints import Inputs
from levkas.building.graph import BuildReport, Graph, Step, Task, draw, graph_of, ordered, summarise
from levkas.building.removal import (
    REMOVED,
    NoReference,
    describe,
    no_longer_there,
    no_reference,
    put_away,
    put_away_stage,
    refused_step,
    removal,
)
from levkas.building.template_cache import TemplateCache
from levkas.campaign.campaign import Campaign, CampaignInvalid, load_campaign
from levkas.campaign.discovery.captures import Capture, Refusals
from levkas.campaign.discovery.check_names import check_names
from levkas.campaign.discovery.file_index import scan_folders
from levkas.campaign.discovery.find_captures import check_edits, find_captures
from levkas.campaign.edits import FILE_NAME, Edits
from levkas.core.problems import Problem, Refused, closest_match
from levkas.database.layout import Places

CODE = "code.json"
"""Among what is kept: the hashes of each stage's code, so that it is not read at every start."""


@dataclass(frozen=True)
class Plan:
    """A campaign, its captures and the graph of its tasks.

    Parameters
    ----------
    refusals : dict of (object, camera, setup) to Refused
        Captures that cannot be begun.
    pages : dict of Key to CameraPage
    """

    campaign: Campaign
    captures: list[Capture]
    refusals: Refusals
    graph: Graph
    pages: dict[Key, CameraPage]

    @property
    def names(self) -> list[str]:
        """Every object, also those of which nothing can be built."""
        return list(
            dict.fromkeys([c.object for c in self.captures] + [key[0] for key in self.refusals])
        )

    def lost(self) -> dict[str, list[Step]]:
        """Return how the captures end that are not in the graph, by object."""
        found: dict[str, list[Step]] = {name: [] for name in self.names}
        for (name, camera, setup), refused in self.refusals.items():
            found[name].append(refused_step(Key(name, camera, setup, "calibrate"), refused))
        for capture in self.captures:
            if key_of(capture, "calibrate") not in self.graph:
                found[capture.object].append(_without_reference(self, capture))
        return found

    def of(self, objects: Sequence[str]) -> Plan:
        """Return the plan of some objects; raises CampaignInvalid where there is none of a name."""
        if missing := [name for name in objects if name not in self.names]:
            raise CampaignInvalid(
                Problem(
                    "E_VALUE",
                    "there is no such object",
                    str(self.campaign.path),
                    "--object",
                    ", ".join(missing),
                    ", ".join(sorted(self.names)),
                    closest_match(missing[0], self.names),
                )
            )
        captures = [c for c in self.captures if c.object in objects]
        refusals = {key: r for key, r in self.refusals.items() if key[0] in objects}
        wanted = (key for key in self.graph if key.object in objects)
        graph = {task.key: task for task in ordered(self.graph, wanted)}
        return Plan(self.campaign, captures, refusals, graph, {})


def build(
    path: str | Path,
    *,
    output: str | Path | None = None,
    objects: list[str] | None = None,
    keep_removed: bool = False,
    verify: bool = False,
) -> Iterator[Step]:
    """Build the database of a campaign, yielding each stage as it begins and as it ends.

    Parameters
    ----------
    path : path
        A campaign's folder or its campaign.toml.
    output : path, optional
        The database, instead of the campaign's own `output`.
    objects : list of str, optional
        Only these objects.
    keep_removed : bool
        Leave layers, objects, cameras and charts in the database that the campaign no longer has. They
        are moved to the folder OUTPUT.removed otherwise.
    verify : bool
        Read every file anew, whatever its size, times and inode say.

    Yields
    ------
    step : Step
        A refused capture ends its own stages; the other cameras and objects are built.

    Raises
    ------
    Refused
        Where the campaign itself cannot be read, or the output cannot be written.
    """
    from levkas.core.sweeping import sweep

    whole = _plan(path)
    plan = whole.of(objects) if objects else whole
    spectra_of(plan.campaign, setups_of(plan.campaign))  # refused before any work
    places = Places(Path(output).resolve() if output else plan.campaign.output)
    claim(plan.campaign, places, whole.captures, whole.names)
    for folder in (places.output, places.kept):
        sweep(folder)
    sources.remember(places.kept / CODE)
    records = BuildRecords(places.kept, places.output, keep_removed=keep_removed, verify=verify)
    gone = no_longer_there(
        plan.campaign, records, plan.captures, plan.refusals, plan.pages, objects
    )
    total = _count(plan) + bool(describe(gone, records))
    steps = _steps(plan, places, records, gone, whole=not objects)
    yield from _numbered(steps, plan.graph, total)
    records.hashes.save()
    sources.keep(places.kept / CODE)


def _steps(
    plan: Plan, places: Places, records: BuildRecords, gone: Sequence[Key], *, whole: bool
) -> Iterator[Step]:
    """Yield the steps of a build."""
    campaign = plan.campaign
    shared = len(plan.names) > 1
    templates = TemplateCache(places.kept / "templates", records.hashes, shared=shared)
    executor = Executor(campaign, places, records, templates, plan.graph)
    lost = plan.lost()
    for step in (step for steps in lost.values() for step in steps):
        put_away(step.key.object, step.key.camera, step.key.setup, records)
        yield step
    for name in plan.names:
        if Key(name, stage="report") not in plan.graph:
            put_away_stage(Key(name, stage="report"), records)
    for of_captures, tasks in groupby(plan.graph.values(), lambda task: task.capture is not None):
        if of_captures:
            yield from executor.run(list(tasks))
            continue
        for task in tasks:
            if task.key.stage == "report":
                ended = [s for k, s in executor.ended.items() if k.object == task.key.object]
                steps = [*lost[task.key.object], *ended]
                yield from _report(plan, places, records, executor.inputs, task, steps)
            elif task.key.stage == "camera":
                yield from _camera(plan, places, records, templates, task)
    yield from removal(gone, records)
    step = write_catalogue_of(campaign, places, records, plan.captures, plan.names, whole=whole)
    warnings = (*campaign.without_effect, *step.warnings)
    yield replace(step, output=places.output, warnings=warnings)


def _count(plan: Plan) -> int:
    """Return how many steps of a build end: tasks, what cannot be begun, and the catalogue."""
    lost = sum(len(steps) for steps in plan.lost().values())
    return len(plan.graph) + lost + (CATALOGUE not in plan.graph)


def _numbered(steps: Iterator[Step], graph: Graph, total: int) -> Iterator[Step]:
    """Say of every step how many tasks are behind it; a lost capture takes its later ones along."""
    stages: dict[tuple[str, str], list[str]] = {}
    for key, task in graph.items():
        if task.capture is not None:
            stages.setdefault((key.object, key.layer), []).append(key.stage)
    done = 0
    for step in steps:
        if step.finished:
            mine = stages.get((step.key.object, step.key.layer), [])
            lost = step.state == "refused" and step.key.stage in mine
            done += 1 + (len(mine) - 1 - mine.index(step.key.stage) if lost else 0)
        yield replace(step, done=total if step.key == CATALOGUE else min(done, total), total=total)


def status(
    path: str | Path, *, output: str | Path | None = None, verify: bool = False
) -> BuildReport:
    """Say of every stage whether it is fresh or stale, and why; no pixel is read.

    Parameters are those of `build`, and it raises as `build`.
    """
    plan = _plan(path)
    campaign = plan.campaign
    places = Places(Path(output).resolve() if output else campaign.output)
    check_apart(campaign, places.output, plan.captures)
    sources.remember(places.kept / CODE)
    records = BuildRecords(places.kept, places.output, verify=verify)
    lost = plan.lost()
    inputs = Inputs(campaign, records)
    ended: dict[Key, Step] = {}
    refused: dict[tuple[str, str], Step] = {}
    for task in plan.graph.values():
        key = task.key
        if task.capture is not None:
            step = _state(plan, records, inputs, task, refused)
            if step is not None:
                ended[step.key] = step
            continue
        if key.stage == "report":
            mine = [*lost[key.object], *(s for k, s in ended.items() if k.object == key.object)]
            prints = _report_prints(plan, inputs, key.object, mine)
        elif key.stage == "camera":
            prints = prints_of_page(plan.pages[key], campaign, records)
        else:
            continue
        why = records.why_stale(key, prints)
        ended[key] = Step(key, "stale" if why else "fresh", why)
    steps = [*(step for steps in lost.values() for step in steps), *ended.values()]
    gone = no_longer_there(campaign, records, plan.captures, plan.refusals, plan.pages, None)
    if why := describe(gone, records):
        steps.append(Step(REMOVED, "stale", why))
    steps.append(_state_of_catalogue(plan, places, records, steps))
    report = summarise(steps, places.output)
    chart = draw(plan.graph, {step.key: step.state for step in steps})
    warnings = (*campaign.without_effect, *report.warnings)
    return replace(report, warnings=warnings, graph=chart)


def _state(
    plan: Plan,
    records: BuildRecords,
    inputs: Inputs,
    task: Task,
    refused: dict[tuple[str, str], Step],
) -> Step | None:
    """Return whether a task of a capture is fresh, stale or refused; None behind one that is refused."""
    capture, lead, key = task.capture, task.reference, task.key
    layer = (key.object, key.layer)
    prints = inputs.of(task, refused)  # other setups are compared with what this would be
    if layer in refused or capture is None or lead is None:
        return None
    if not task.leads and (failed := refused.get((lead.object, lead.layer))):
        step = refused_step(
            key_of(capture, "calibrate"), no_reference(key.object, lead.layer, failed)
        )
    else:
        why = records.why_stale(key, prints)
        step = Step(key, "stale", why) if why else fresh_step(key, records)
        if why and (problems := records.refusal(key, prints)):
            root = plan.campaign.root
            there = (replace(p, file=p.file and str(root / p.file)) for p in problems)
            step = refused_step(key, Refused(*there))
    if step.state == "refused":
        refused[layer] = step
    return step


def _state_of_catalogue(
    plan: Plan, places: Places, records: BuildRecords, steps: Sequence[Step]
) -> Step:
    """Return whether catalogue and manifest are stale, because what they list is, or by themselves."""
    if any(step.state == "stale" for step in steps):
        return Step(CATALOGUE, "stale", "what it lists is stale")
    prints = prints_of_catalogue(plan.campaign, places, records, plan.captures, plan.names)
    why = records.why_stale(CATALOGUE, prints)
    warnings = foreign_files(by_others(places, records))
    return Step(CATALOGUE, "stale" if why else "fresh", why, warnings=warnings)


def _plan(path: str | Path) -> Plan:
    """Read a campaign, find its captures and lay out its tasks."""
    campaign = load_campaign(path)
    check_detectors(campaign)
    index = scan_folders(campaign)
    captures, refusals = find_captures(campaign, index)
    check_names(campaign, index, refusals)
    _check_edits(campaign, captures, refusals)
    pages = camera_pages(campaign, captures, index)
    return Plan(campaign, captures, refusals, graph_of(campaign, captures), pages)


def check_detectors(campaign: Campaign) -> None:
    """Refuse a campaign whose key points the installed OpenCV cannot find; raises CampaignInvalid."""
    tables = {"registration": campaign.registration}
    tables |= {f"cameras.{n}.registration": c.registration for n, c in campaign.cameras.items()}
    asked = {where: keys.detector for where, keys in tables.items() if keys.detector}
    if set(asked.values()) <= {"sift"}:
        return
    from levkas.registration.features import available_detectors, no_detector

    here = available_detectors()
    missing = [no_detector(name, f"{w}.detector") for w, name in asked.items() if name not in here]
    if missing:
        raise CampaignInvalid(*(replace(p, file=str(campaign.path)) for p in missing))


def _check_edits(campaign: Campaign, captures: list[Capture], refusals: Refusals) -> None:
    """Refuse corrections by hand of what the campaign does not have; what is refused is had."""
    lost = [Capture(name, camera, setup, ()) for name, camera, setup in refusals]
    lost_frames = {(c.object, c.layer) for c in lost}
    frames = {
        (name, frame): edits
        for (name, frame), edits in campaign.edits.frames.items()
        if (name, frame.partition(":")[0]) not in lost_frames
    }
    if frames:
        check_edits(Edits(frames), captures, campaign.root / FILE_NAME)


def _without_reference(plan: Plan, capture: Capture) -> Step:
    """Return the step of a capture that there is nothing to register to."""
    name, reference = capture.object, plan.campaign.reference.camera
    lost = plan.refusals.get((name, reference, ""))
    problem = Problem(
        "E_NO_REFERENCE",
        f"{name}: there is no image by the reference camera {reference}, so nothing can be registered",
        field="campaign.reference",
        found=lost.problems[0].message if lost else "no capture",
        fix="Mend the reference camera's frames first.",
    )
    return refused_step(key_of(capture, "calibrate"), NoReference(problem))


def _report_prints(plan: Plan, inputs: Inputs, name: str, steps: Sequence[Step]) -> dict[str, Any]:
    """Return the fingerprint of an object's page; `steps` is how its captures ended."""
    lost = [s for s in steps if s.state == "refused"]
    unbegun = {s.key for s in lost if s.key.stage == "calibrate"}
    made = [s.key for s in steps if s.key not in unbegun and s.key in inputs.digests]
    layers = {f"{key.layer} {key.stage}": inputs.digests[key] for key in made}
    for step in lost:
        told = (fingerprints.written(plan.campaign, p) for p in step.problems)
        layers[f"{step.key.layer} refused"] = "\n".join(told)
    return fingerprints.of_report(plan.campaign, name, layers)


def _report(
    plan: Plan,
    places: Places,
    records: BuildRecords,
    inputs: Inputs,
    task: Task,
    steps: list[Step],
) -> Iterator[Step]:
    """Write the page of an object where it is stale."""
    key = task.key
    prints = _report_prints(plan, inputs, key.object, steps)
    why = records.why_stale(key, prints)
    if not why:
        yield Step(key, "fresh")
        return
    yield Step(key, "running", why)
    from levkas.building.report_pages import write_report  # heavy

    captures = [c for c in plan.captures if c.object == key.object]
    try:
        files = write_report(plan.campaign, places, records, captures, steps)
    except Refused as error:
        yield refused_step(key, error)
        return
    records.keep(key, prints, files)
    yield Step(key, "done", why)


def _camera(
    plan: Plan, places: Places, records: BuildRecords, templates: TemplateCache, task: Task
) -> Iterator[Step]:
    """Write the page of a camera where it is stale."""
    key, page = task.key, plan.pages[task.key]
    prints = prints_of_page(page, plan.campaign, records)
    why = records.why_stale(key, prints)
    if not why:
        yield Step(key, "fresh", warnings=tuple(records.notes(key).get("warnings", ())))
        return
    yield Step(key, "running", why)
    try:
        made = write_camera_page(page, plan.campaign, places, records, templates)
    except Refused as error:
        yield refused_step(key, error)
        return
    records.keep(key, prints, made.files, **made.notes)
    yield Step(key, "done", why, warnings=made.warnings)
