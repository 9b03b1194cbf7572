"""A build: the tasks of a campaign's graph, what is fresh left alone; and what of them is stale."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.building.build_records import CATALOGUE, BuildRecords, Key, key_of
from levkas.building.camera_pages import prints_of_charts, prints_of_page
from levkas.building.catalogue import setups_of, spectra_of, write_catalogue_of
from levkas.building.claiming import check_apart, claim, places_of
from levkas.building.graph import BuildReport, Graph, Step, Task, page_key, summarise
from levkas.building.hashes import HASHES, session_folder
from levkas.building.inputs import digest, of_report, written
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
    alone: bool = False,
    again: bool = True,
) -> Iterator[Step]:
    """Build the database of a campaign, given by its folder or campaign.toml; yield each stage as it begins and as it ends.

    It goes to `output` instead of the campaign's own. A refused capture ends its own stages; the other cameras and objects are
    built. To `verify`, every file is read anew, whatever its size, times and inode say. `alone`: only what the objects do not share,
    no page of a camera, no page that reads one, no catalogue and manifest. Not `again`: what was refused when it was made of the
    same is not tried once more.

    Yields
    ------
    step : Step

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
    from levkas.core.files import sweep

    campaign = load_campaign(path)
    places = places_of(campaign, output)
    whole = plan_of(campaign)
    plan = whole.of(objects) if objects else whole
    spectra_of(campaign, setups_of(campaign))  # refused before any work
    claim(campaign, places, whole.captures, whole.names)
    for folder in (places.output, places.kept):
        sweep(folder)
    sweep_corrections(campaign.root)
    session = session_folder(campaign.root) / HASHES
    records = BuildRecords(places.kept, places.output, verify=verify, session=session)
    one = _Build(plan, places, records, whole.names, objects, again=again)
    yield from one.numbered(one.steps(alone=alone))
    if not objects:
        keys = (key for key in records.recorded() if key.stage == "calibrate")
        used = {name for key in keys for name in records.notes(key).get("templates", ())}
        one.templates.remove_all_but(used)
    records.hashes.save()


def status(
    path: str | Path,
    *,
    output: str | Path | None = None,
    verify: bool = False,
) -> BuildReport:
    """Return of every stage whether it is fresh or stale, and why; no pixel is read. Parameters as of `build`.

    Returns
    -------
    report : BuildReport

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
    one = _Build(plan, places, records, plan.names, dry=True, unread=not verify)
    return summarise(one.steps(), places.output)


class _Build:
    """One build of a plan, or of some `objects` of it, or a `dry` one; `names` are all objects of the campaign."""

    def __init__(
        self,
        plan: Plan,
        places: Places,
        records: BuildRecords,
        names: Sequence[str],
        objects: list[str] | None = None,
        **how: bool,
    ) -> None:
        self.plan = plan.with_missing(records, objects)
        self.places, self.records, self.objects = places, records, objects
        self.removed = no_longer_named(plan.campaign, records, objects)
        digests = records.hashes.of_frame if len(names) > 1 else None
        self.templates = TemplateCache(places.kept / "templates", digests)
        self.outcomes = Outcomes(plan.campaign, places, records, plan.graph, self.templates, **how)
        self.lost = self.plan.lost()

    def numbered(self, steps: Iterator[Step]) -> Iterator[Step]:
        """Report of every step how many tasks are behind it; later ones of a refused capture are, in the end."""
        graph: Graph = self.plan.graph
        total = len(graph) + sum(map(len, self.lost.values())) + (CATALOGUE not in graph)
        total += bool(describe(self.removed, self.records))
        numbers = {key: number for number, key in enumerate(graph, 1)}
        place = done = 0
        for step in steps:
            done += step.finished
            place = numbers.get(step.key, place)
            behind = total if step.key == CATALOGUE else min(done, total)
            yield replace(step, done=behind, total=total, place=place)

    def steps(self, *, alone: bool = False) -> Iterator[Step]:
        """Yield the steps of a build; of a dry one, what they would be. `alone` as of `build`."""
        plan, outcomes, graph = self.plan, self.outcomes, self.plan.graph
        for step in (step for steps in self.lost.values() for step in steps):
            refused = plan.refusals.get((step.key.object, step.key.camera, step.key.setup))
            yield outcomes.lose(step, refused)
        for name in plan.names:
            page = Task(Key(name, stage="report"))
            if page.key not in graph and any(layer.object == name for layer in outcomes.earlier):
                yield from self._page(page)
            elif page.key not in graph and not outcomes.dry:
                put_away_stage(page.key, self.records)
        stale = False
        shared = {key for key in graph if not key.object}
        for task in (task for task in graph.values() if task.key != CATALOGUE):
            if alone and (task.key in shared or shared & {*task.uses}):
                continue
            for step in outcomes.run(task) if task.capture else self._page(task):
                stale |= step.state == "stale"
                yield step
        if alone:
            return
        if not outcomes.dry:
            yield from removal(self.removed, self.records)
        elif why := describe(self.removed, self.records):
            stale = True
            yield Step(REMOVED, "stale", why)
        step = self._catalogue(stale=stale)
        warnings = (*plan.campaign.without_effect, *step.warnings)
        yield replace(step, output=self.places.output, warnings=warnings)

    def _catalogue(self, *, stale: bool) -> Step:
        """Write what lists all layers where it is stale; of a dry build, report whether it is."""
        if self.outcomes.dry and stale:
            return Step(CATALOGUE, "stale", "it lists stale files")
        try:
            return write_catalogue_of(self.outcomes, self.plan.names, whole=not self.objects)
        except Refused:
            raise
        except Exception as error:
            refused = as_refusal(error, "catalogue")
            if not self.outcomes.dry:
                refused = self.records.with_report(CATALOGUE, refused)
            return refused_step(CATALOGUE, refused)

    def _page(self, task: Task) -> Iterator[Step]:
        """Write the page of an object or of a camera where it is stale; whatever is raised refuses this page, and nothing else."""
        key, records, dry = task.key, self.records, self.outcomes.dry
        prints: dict[str, Any] = {}
        try:
            prints = self._prints(key)
            why = records.why_stale(key, prints)
            if dry or not why:
                yield self.outcomes.state(Due(task, prints, why))
                return
            yield Step(key, "running", why)
            made = self._written(key)
            records.keep(key, prints, made.files, **made.notes)
        except Exception as error:
            what = " ".join(part for part in (key.object, key.camera, "page") if part)
            refused = as_refusal(error, what)
            if dry:
                yield Step(key, "stale", refused.problems[0].message)
                return
            refused = records.with_report(key, refused)
            if not is_of_the_disk(refused.problems):
                records.refuse(key, prints, within(self.plan.campaign, refused.problems))
            yield refused_step(key, refused)
            return
        yield Step(key, "done", why, warnings=made.warnings)

    def _written(self, key: Key) -> Written:
        if key.stage == "camera":
            from levkas.building.camera_reports import write_camera_page  # heavy

            return write_camera_page(self.plan.pages[key], self.outcomes, self.templates)
        from levkas.building.layer_verdicts import confirm_layers
        from levkas.building.report_pages import write_report  # heavy

        campaign, captures = self.plan.campaign, self._captures(key)
        confirm_layers(captures, campaign.edits, self.places, self.records)
        return Written(write_report(self.outcomes, key.object, captures, self._ended(key)), {})

    def _captures(self, key: Key) -> list[Capture]:
        return [capture for capture in self.plan.captures if capture.object == key.object]

    def _ended(self, key: Key) -> list[Step]:
        """Return how the captures of an object ended, in the order of the graph."""
        ended = self.outcomes.ended
        return [*self.lost[key.object], *(ended[k] for k in self.plan.graph if k in ended and k.object == key.object)]  # fmt: skip

    def _prints(self, key: Key) -> dict[str, Any]:
        """Return the fingerprint of a page: of an object's how its captures ended, and the charts of their cameras."""
        plan, outcomes = self.plan, self.outcomes
        if key.stage == "camera":
            return prints_of_page(plan.pages[key], outcomes)
        inputs, earlier, steps = outcomes.inputs, outcomes.earlier, self._ended(key)
        lost = [s for s in steps if s.state == "refused"]
        unbegun = {s.key for s in lost if s.key.stage == "calibrate"}
        made = [s.key for s in steps if s.key not in unbegun and s.key in inputs.digests]
        layers = {f"{key.layer} {key.stage}": inputs.digests[key] for key in made}
        for step in lost:
            texts = (written(plan.campaign, p) for p in step.problems)
            layers[f"{step.key.layer} refused"] = "\n".join(texts)
            if step.key.of in earlier:
                layers[f"{step.key.layer} of an earlier build"] = earlier[step.key.of]
        captures = self._captures(key)
        prints = of_report(plan.campaign, key.object, layers, captures, self.records.hashes)
        for camera in dict.fromkeys(c.camera for c in captures):
            if (page := plan.pages.get(page_key(camera))) is not None:
                charts = prints_of_charts(page, plan.campaign, self.records)
                prints |= {f"{camera}: {chart}": made for chart, made in charts.items()}
        return prints


def calibrate_aside(capture: Capture, campaign: Campaign, places: Places) -> Path:
    """Return a folder beside the database with a capture's native pixels; calibrate it where they are not there yet."""
    from levkas.stages.calibrate import load_calibrated, write_shown

    records = BuildRecords(places.kept, places.output)
    version = digest(records.fingerprint(key_of(capture, "calibrate")))
    folder = places.kept_native(capture.object, capture.layer, version)
    if not folder.is_dir():
        templates = TemplateCache(places.kept / "templates", records.hashes.of_frame)
        notes = records.notes(key_of(capture, "calibrate"))
        made = load_calibrated(capture, campaign, places, notes, templates)
        write_shown(made, capture, campaign, places, folder)
    return folder
