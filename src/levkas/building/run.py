"""A build: the tasks of a campaign's graph, what is fresh left alone; and what of them is stale."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.building import fingerprints
from levkas.building.build_records import CATALOGUE, BuildRecords, Key, key_of
from levkas.building.camera_pages import prints_of_charts, prints_of_page, write_camera_page
from levkas.building.catalogue import (
    setups_of,
    spectra_of,
    write_catalogue_of,
)
from levkas.building.claiming import check_apart, claim, places_of
from levkas.building.executor import DryRun, Executor
from levkas.building.graph import BuildReport, Graph, Step, Task, page_key, summarise
from levkas.building.hashes import hashes_of_session
from levkas.building.outcomes import (
    REMOVED,
    Due,
    Outcomes,
    describe,
    is_of_the_disk,
    no_longer_named,
    put_away_stage,
    refused_step,
    removal,
    within,
)
from levkas.building.plan import Plan, plan_of
from levkas.campaign.campaign import load_campaign
from levkas.campaign.edits import sweep_corrections
from levkas.core.internal_errors import as_refusal
from levkas.core.problems import Refused
from levkas.database.layout import Places
from levkas.stages.template_cache import TemplateCache
from levkas.stages.written import Written

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture


def build(
    path: str | Path,
    *,
    output: str | Path | None = None,
    objects: list[str] | None = None,
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

    Examples
    --------
    A second build of a campaign computes nothing:

    >>> {step.state for step in build(plates)}
    {'fresh'}
    """
    from levkas.core.sweeping import sweep

    campaign = load_campaign(path)
    places = places_of(campaign, output)
    whole = plan_of(campaign)
    plan = whole.of(objects) if objects else whole
    spectra_of(campaign, setups_of(campaign))  # refused before any work
    claim(campaign, places, whole.captures, whole.names)
    for folder in (places.output, places.kept):
        sweep(folder)
    sweep_corrections(campaign.root)
    records = BuildRecords(
        places.kept, places.output, verify=verify,
        session=hashes_of_session(campaign.root),
    )  # fmt: skip
    plan = plan.with_missing(records, objects)
    removed = no_longer_named(campaign, records, objects)
    total = _count(plan) + bool(describe(removed, records))
    digests = records.hashes.of_frame if len(plan.names) > 1 else None
    templates = TemplateCache(places.kept / "templates", digests)
    outcomes = Outcomes(campaign, places, records, plan.graph)
    executor = Executor(outcomes, templates)
    steps = _steps(plan, outcomes, executor, templates, removed, whole=not objects)
    yield from _numbered(steps, plan.graph, total)
    if not objects:
        templates.remove_all_but(_used_templates(records))
    records.hashes.save()


def _used_templates(records: BuildRecords) -> set[str]:
    """Return the names of the templates that recorded calibrations were made with."""
    keys = (key for key in records.recorded() if key.stage == "calibrate")
    return {name for key in keys for name in records.notes(key).get("templates", ())}


def _steps(
    plan: Plan,
    outcomes: Outcomes,
    executor: Executor | DryRun,
    templates: TemplateCache,
    removed: Sequence[Key],
    *,
    whole: bool,
) -> Iterator[Step]:
    """Yield the steps of a build; of a dry one, what they would be."""
    campaign, places, records = plan.campaign, outcomes.places, outcomes.records
    lost = plan.lost()
    for step in (step for steps in lost.values() for step in steps):
        refused = plan.refusals.get((step.key.object, step.key.camera, step.key.setup))
        yield outcomes.lose(step, refused)
    for name in plan.names:
        page = Task(Key(name, stage="report"))
        if page.key not in plan.graph and any(layer.object == name for layer in outcomes.earlier):
            yield from _report(plan, outcomes, page, lost[name])
        elif page.key not in plan.graph and not outcomes.dry:
            put_away_stage(page.key, records)
    places_in_graph = {key: place for place, key in enumerate(plan.graph)}

    def write_page(task: Task) -> Iterator[Step]:
        if task.key.stage == "camera":
            return _camera(plan, outcomes, templates, task)
        name = task.key.object
        ended = sorted(outcomes.of(name), key=lambda step: places_in_graph[step.key])
        return _report(plan, outcomes, task, [*lost[name], *ended])

    tasks = [task for task in plan.graph.values() if task.key != CATALOGUE]
    stale = False
    for of_captures, group in groupby(tasks, lambda task: task.capture is not None):
        mine = list(group)
        pages = chain.from_iterable(map(write_page, mine))
        for step in executor.run(mine) if of_captures else pages:
            stale |= step.state == "stale"
            yield step
    if not outcomes.dry:
        yield from removal(removed, records)
    elif why := describe(removed, records):
        stale = True
        yield Step(REMOVED, "stale", why)
    step = _catalogue(plan, outcomes, whole=whole, stale=stale)
    warnings = (*campaign.without_effect, *step.warnings)
    yield replace(step, output=places.output, warnings=warnings)


def _catalogue(plan: Plan, outcomes: Outcomes, *, whole: bool, stale: bool) -> Step:
    """Write what lists all layers where it is stale; of a dry build, report whether it is."""
    if outcomes.dry and stale:
        return Step(CATALOGUE, "stale", "it lists stale files")
    try:
        return write_catalogue_of(outcomes, plan.names, whole=whole)
    except Refused:
        raise
    except Exception as error:
        refused = as_refusal(error, "catalogue")
        if not outcomes.dry:
            refused = outcomes.records.with_report(CATALOGUE, refused)
        return refused_step(CATALOGUE, refused)


def _count(plan: Plan) -> int:
    """Return how many steps of a build end: tasks, what cannot be begun, and the catalogue."""
    lost = sum(len(steps) for steps in plan.lost().values())
    return len(plan.graph) + lost + (CATALOGUE not in plan.graph)


def _numbered(steps: Iterator[Step], graph: Graph, total: int) -> Iterator[Step]:
    """Report of every step how many tasks are behind it; later ones of a refused capture are, in the end."""
    places = {key: number for number, key in enumerate(graph, 1)}
    place = done = 0
    for step in steps:
        done += step.finished
        place = places.get(step.key, place)
        behind = total if step.key == CATALOGUE else min(done, total)
        yield replace(step, done=behind, total=total, place=place)


def status(
    path: str | Path,
    *,
    output: str | Path | None = None,
    verify: bool = False,
) -> BuildReport:
    """Return of every stage whether it is fresh or stale, and why; no pixel is read.

    Parameters
    ----------
    path : path
        A campaign's folder or its campaign.toml.
    output : path, optional
        The database, instead of the campaign's own `output`.
    verify : bool
        As of `build`.

    Returns
    -------
    report : BuildReport
        `stages`: a `Step` each with `state` and `why`; `text`: a line a stage that is not fresh.

    Raises
    ------
    Refused
        Where the campaign cannot be read.

    Examples
    --------
    >>> [str(step.key.stage) for step in status(plates).stages if step.state == "stale"]
    []
    """
    campaign = load_campaign(path)
    places = places_of(campaign, output)
    plan = plan_of(campaign)
    check_apart(campaign, places.output, plan.captures)
    records = BuildRecords(places.kept, places.output, verify=verify)
    plan = plan.with_missing(records)
    removed = no_longer_named(campaign, records)
    templates = TemplateCache(places.kept / "templates", records.hashes.of_frame)
    outcomes = Outcomes(campaign, places, records, plan.graph, dry=True, unread=not verify)
    steps = [*_steps(plan, outcomes, DryRun(outcomes), templates, removed, whole=True)]
    return summarise(steps, places.output)


def calibrate_aside(capture: Capture, campaign: Campaign, places: Places) -> Path:
    """Return a folder beside the database with a capture's native pixels; calibrate it where they are not there yet."""
    from levkas.stages.calibrate import load_calibrated, write_shown

    records = BuildRecords(places.kept, places.output)
    made_of = records.fingerprint(key_of(capture, "calibrate"))
    version = fingerprints.digest(made_of)
    folder = places.kept_native(capture.object, capture.layer, version)
    if not folder.is_dir():
        templates = TemplateCache(places.kept / "templates", records.hashes.of_frame)
        notes = records.notes(key_of(capture, "calibrate"))
        made = load_calibrated(capture, campaign, places, notes, templates)
        write_shown(made, capture, campaign, places, folder)
    return folder


def _report_prints(
    plan: Plan, outcomes: Outcomes, name: str, steps: Sequence[Step]
) -> dict[str, Any]:
    """Return the fingerprint of an object's page; `steps` is how its captures ended."""
    inputs, earlier = outcomes.inputs, outcomes.earlier
    lost = [s for s in steps if s.state == "refused"]
    unbegun = {s.key for s in lost if s.key.stage == "calibrate"}
    made = [s.key for s in steps if s.key not in unbegun and s.key in inputs.digests]
    layers = {f"{key.layer} {key.stage}": inputs.digests[key] for key in made}
    for step in lost:
        written = (fingerprints.written(plan.campaign, p) for p in step.problems)
        layers[f"{step.key.layer} refused"] = "\n".join(written)
        layers |= {f"{o.name} of an earlier build": earlier[o] for o in earlier if o == step.key.of}
    captures = [capture for capture in plan.captures if capture.object == name]
    hashes = inputs.records.hashes
    prints = fingerprints.of_report(plan.campaign, name, layers, captures, hashes)
    for camera in dict.fromkeys(c.camera for c in captures):
        if (page := plan.pages.get(page_key(camera))) is not None:
            charts = prints_of_charts(page, plan.campaign, inputs.records)
            prints |= {f"{camera}: {chart}": made for chart, made in charts.items()}
    return prints


def _report(plan: Plan, outcomes: Outcomes, task: Task, steps: list[Step]) -> Iterator[Step]:
    """Write the page of an object where it is stale; `steps` is how its captures ended."""
    name, places, records = task.key.object, outcomes.places, outcomes.records

    def write() -> Written:
        from levkas.building.layer_verdicts import confirm_layers
        from levkas.building.report_pages import write_report  # heavy

        captures = [c for c in plan.captures if c.object == name]
        confirm_layers(captures, plan.campaign.edits, places, records)
        made = write_report(outcomes, name, captures, steps)
        return Written(made, {})

    prints = partial(_report_prints, plan, outcomes, name, steps)
    return _page(plan, outcomes, task, prints, write)


def _camera(plan: Plan, outcomes: Outcomes, templates: TemplateCache, task: Task) -> Iterator[Step]:
    """Write the page of a camera where it is stale."""
    page = plan.pages[task.key]
    prints = partial(prints_of_page, page, outcomes)
    write = partial(write_camera_page, page, outcomes, templates)
    return _page(plan, outcomes, task, prints, write)


def _page(
    plan: Plan,
    outcomes: Outcomes,
    task: Task,
    prints_of: Callable[[], dict[str, Any]],
    write: Callable[[], Written],
) -> Iterator[Step]:
    """Write a page where it is stale; whatever is raised refuses this page, and nothing else."""
    key, records = task.key, outcomes.records
    prints: dict[str, Any] = {}
    try:
        prints = prints_of()
        why = records.why_stale(key, prints)
        if outcomes.dry or not why:
            yield outcomes.state(Due(task, prints, why))
            return
        yield Step(key, "running", why)
        made = write()
        records.keep(key, prints, made.files, **made.notes)
    except Exception as error:
        what = " ".join(part for part in (key.object, key.camera, "page") if part)
        refused = as_refusal(error, what)
        if outcomes.dry:
            yield Step(key, "stale", refused.problems[0].message)
            return
        refused = records.with_report(key, refused)
        if not is_of_the_disk(refused.problems):
            records.refuse(key, prints, within(plan.campaign, refused.problems))
        yield refused_step(key, refused)
        return
    yield Step(key, "done", why, warnings=made.warnings)
