"""A build: the stages of every object of a campaign, what is fresh left alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from levkas.building import fingerprints, sources
from levkas.building.build_records import BuildRecords, Key
from levkas.building.camera_pages import CameraPages, page_key
from levkas.building.catalogue import (
    by_others,
    foreign_files,
    prints_of_catalogue,
    setups_of,
    spectra_of,
    write_catalogue_of,
)
from levkas.building.claiming import check_apart, claim
from levkas.building.fingerprints import digest
from levkas.building.joint_round import JointRound
from levkas.building.objects import ObjectBuild, Round
from levkas.building.progress import BuildReport, Step, summarise
from levkas.building.removal import (
    CATALOGUE,
    REMOVED,
    NoReference,
    describe,
    no_longer_there,
    put_away,
    put_away_stage,
    removal,
)
from levkas.building.rig_mates import RigMates, joint_keys
from levkas.building.template_cache import TemplateCache
from levkas.campaign.campaign import Campaign, CampaignInvalid, load_campaign
from levkas.campaign.discovery.captures import Capture, Refusals
from levkas.campaign.discovery.find_captures import check_edits, find_captures
from levkas.campaign.edits import FILE_NAME, Edits
from levkas.core.problems import Problem, Refused
from levkas.database.layout import Places

CODE = "code.json"
"""Among what is kept: the hashes of each stage's code, so that it is not read at every start."""


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

    campaign, captures, refusals = _plan(path, objects)
    _, every, lost = _plan(path, None) if objects else (campaign, captures, refusals)
    spectra_of(campaign, setups_of(campaign))  # refused before any work
    places = Places(Path(output).resolve() if output else campaign.output)
    claim(campaign, places, every, [*(c.object for c in every), *(key[0] for key in lost)])
    for folder in (places.output, places.kept):
        sweep(folder)
    sources.remember(places.kept / CODE)
    ledger = BuildRecords(places.kept, places.output, keep_removed=keep_removed, verify=verify)
    names = _names(captures, refusals)
    shelf = TemplateCache(places.kept / "templates", ledger.hashes, shared=len(names) > 1)
    # What cameras told is gathered from all objects: a build of some leaves their pages alone.
    cameras = None if objects else CameraPages(campaign, places, ledger, captures)
    pages = len(cameras.cameras) if cameras else 0
    joint = any(map(campaign.is_joint, campaign.cameras))
    mates = RigMates(campaign, places, ledger, every if joint else captures)
    first = JointRound(campaign, places, ledger, shelf, mates)
    gone = no_longer_there(campaign, ledger, captures, refusals, _pages(cameras), objects)
    more = len(refusals) + len(names) + pages + 1 + bool(describe(gone, ledger))
    counting = _Counting(campaign, captures, first, more)
    for step in first.run():
        yield counting(step)
    by_object, lost_of = _by_object(captures), _by_object_refused(refusals)
    for name in names:
        mine, theirs = by_object.get(name, []), lost_of.get(name, {})
        for step in _object(campaign, places, ledger, shelf, name, mine, theirs, first):
            yield counting(step, refused=_is_refusal(step, theirs))
    for step in cameras.run(shelf) if cameras else ():
        yield counting(step)
    for step in removal(gone, ledger):
        yield counting(step)
    catalogue = write_catalogue_of(campaign, places, ledger, captures, names, whole=not objects)
    yield replace(
        catalogue,
        done=counting.total,
        total=counting.total,
        output=places.output,
        warnings=(*campaign.without_effect, *catalogue.warnings),
    )
    ledger.hashes.save()
    sources.keep(places.kept / CODE)


class _Counting:
    """Says of every step how many stages are behind it; a lost capture takes its later ones along."""

    def __init__(
        self, campaign: Campaign, captures: list[Capture], first: JointRound, more: int
    ) -> None:
        self._stages: dict[tuple[str, str], list[str]] = {}
        for capture in first.captures():
            stages = list(joint_keys(campaign, capture))
            until = (
                "register" if first.mates.leads(capture) or "measure" not in stages else "measure"
            )
            self._stages[capture.object, capture.layer] = stages[: stages.index(until) + 1]
        for capture in captures:
            self._stages[capture.object, capture.layer] = list(joint_keys(campaign, capture))
        self.total = sum(map(len, self._stages.values())) + more
        self._done = 0

    def __call__(self, step: Step, *, refused: bool = False) -> Step:
        if step.finished:
            stages = self._stages.get((step.key.object, step.key.layer), [])
            lost = step.state in ("refused", "failed") and step.key.stage in stages and not refused
            self._done += 1 + (len(stages) - 1 - stages.index(step.key.stage) if lost else 0)
        return replace(step, done=self._done, total=self.total)


def status(
    path: str | Path, *, output: str | Path | None = None, verify: bool = False
) -> BuildReport:
    """Say of every stage whether it is fresh or stale, and why; no pixel is read.

    Parameters are those of `build`, and it raises as `build`.
    """
    campaign, captures, refusals = _plan(path, None)
    places = Places(Path(output).resolve() if output else campaign.output)
    check_apart(campaign, places.output, captures)
    sources.remember(places.kept / CODE)
    ledger = BuildRecords(places.kept, places.output, verify=verify)
    steps = [_refusal(key, refused) for key, refused in refusals.items()]
    shelf = TemplateCache(places.kept / "templates", ledger.hashes, shared=True)
    mates = RigMates(campaign, places, ledger, captures)
    by_object = _by_object(captures)
    lost = _by_object_refused(refusals)
    objects = [
        ObjectBuild(campaign, places, ledger, shelf, name, mine, mates)
        for name, mine in by_object.items()
        if _has_reference(campaign, mine)
    ]
    rounds: list[Round] = ["references", "others"]
    for of in rounds:
        for mine in objects:
            mine.note(of)
    for mine in objects:
        ended = mine.states()
        steps += ended
        before = [_refusal(*item) for item in lost.get(mine.name, {}).items()]
        key = Key(mine.name, stage="report")
        prints = _page_prints(campaign, mine, [*before, *ended])
        why = ledger.why_stale(key, prints)
        steps.append(Step(key, "stale" if why else "fresh", why))
    begun = {mine.name for mine in objects}
    for capture in captures:
        if capture.object not in begun:
            steps.append(_without_reference(campaign, capture, refusals))
    cameras = CameraPages(campaign, places, ledger, captures)
    steps += cameras.states()
    gone = no_longer_there(campaign, ledger, captures, refusals, _pages(cameras), None)
    if why := describe(gone, ledger):
        steps.append(Step(REMOVED, "stale", why))
    steps.append(_state_of_catalogue(campaign, places, ledger, captures, refusals, steps))
    report = summarise(steps, places.output)
    return replace(report, warnings=(*campaign.without_effect, *report.warnings))


def _state_of_catalogue(
    campaign: Campaign,
    places: Places,
    ledger: BuildRecords,
    captures: list[Capture],
    refusals: Refusals,
    steps: list[Step],
) -> Step:
    """Whether catalogue and manifest are stale, because what they list is, or by themselves."""
    if any(step.state == "stale" for step in steps):
        return Step(CATALOGUE, "stale", "what it lists is stale")
    prints = prints_of_catalogue(campaign, places, ledger, captures, _names(captures, refusals))
    why = ledger.why_stale(CATALOGUE, prints)
    warnings = foreign_files(by_others(places, ledger))
    return Step(CATALOGUE, "stale" if why else "fresh", why, warnings=warnings)


def _names(captures: list[Capture], refusals: Refusals) -> list[str]:
    """Every object of a campaign, also those of which nothing can be built."""
    return list(dict.fromkeys([c.object for c in captures] + [key[0] for key in refusals]))


def _by_object(captures: list[Capture]) -> dict[str, list[Capture]]:
    found: dict[str, list[Capture]] = {}
    for capture in captures:
        found.setdefault(capture.object, []).append(capture)
    return found


def _by_object_refused(refusals: Refusals) -> dict[str, Refusals]:
    found: dict[str, Refusals] = {}
    for key, refused in refusals.items():
        found.setdefault(key[0], {})[key] = refused
    return found


def _pages(cameras: CameraPages | None) -> list[Key]:
    return [page_key(name) for name in cameras.cameras] if cameras else []


def _plan(path: str | Path, objects: list[str] | None) -> tuple[Campaign, list[Capture], Refusals]:
    """Read the campaign and find its captures, those of some objects only where asked."""
    campaign = load_campaign(path)
    check_detectors(campaign)
    captures, refusals = find_captures(campaign)
    _check_edits(campaign, captures, refusals)
    if objects:
        known = sorted({c.object for c in captures} | {key[0] for key in refusals})
        if missing := [name for name in objects if name not in known]:
            raise CampaignInvalid(
                Problem(
                    "E_VALUE",
                    "there is no such object",
                    str(campaign.path),
                    "--object",
                    ", ".join(missing),
                    ", ".join(known),
                )
            )
        captures = [c for c in captures if c.object in objects]
        refusals = {key: r for key, r in refusals.items() if key[0] in objects}
    return campaign, captures, refusals


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


def _object(
    campaign: Campaign,
    places: Places,
    ledger: BuildRecords,
    shelf: TemplateCache,
    name: str,
    captures: list[Capture],
    refusals: Refusals,
    first: JointRound,
) -> Iterator[Step]:
    """All stages of one object, then its page; what the first round has told is not told again."""
    steps: list[Step] = []
    for key, refused in refusals.items():
        put_away(*key, ledger)
        steps.append(_refusal(key, refused))
        yield steps[-1]
    if not _has_reference(campaign, captures):
        for capture in captures:
            put_away(name, capture.camera, capture.setup, ledger)
            yield _without_reference(campaign, capture, refusals)
        put_away_stage(Key(name, stage="report"), ledger)
        return
    steps += first.steps(name)
    left = first.left(captures)
    mine = ObjectBuild(campaign, places, ledger, shelf, name, left or captures, first.mates)
    if left:
        for step in mine.run():
            if not first.told(step):
                steps.append(step)
                yield step
    else:
        for step in mine.without_reference(steps):
            steps.append(step)
            yield step
    yield from _page(campaign, places, ledger, name, mine, steps)


def _has_reference(campaign: Campaign, captures: list[Capture]) -> bool:
    """Tell whether the captures of an object begin with the reference camera's own."""
    reference = campaign.reference.camera
    return bool(captures) and captures[0].camera == reference and not captures[0].setup


def _without_reference(campaign: Campaign, capture: Capture, refusals: Refusals) -> Step:
    """The step of a capture that there is nothing to register to."""
    name, reference = capture.object, campaign.reference.camera
    lost = refusals.get((name, reference, ""))
    problem = Problem(
        "E_NO_REFERENCE",
        f"{name}: there is no image by the reference camera {reference}, so nothing can be registered",
        field="campaign.reference",
        found="; ".join(str(p) for p in lost.problems) if lost else "no capture",
        fix="Mend the reference camera's frames first.",
    )
    return _refusal((name, capture.camera, capture.setup), NoReference(problem))


def _page_prints(campaign: Campaign, mine: ObjectBuild, steps: list[Step]) -> dict[str, Any]:
    """The fingerprint of an object's page."""
    layers = {k.layer + " " + k.stage: v for k, v in mine.digests.items()}
    refused = {
        f"{s.key.layer} refused": "\n".join(fingerprints.written(campaign, p) for p in s.problems)
        for s in steps
        if s.state in ("refused", "failed")
    }
    return fingerprints.of_report(campaign, mine.name, {**layers, **refused})


def _page(
    campaign: Campaign,
    places: Places,
    ledger: BuildRecords,
    name: str,
    mine: ObjectBuild,
    steps: list[Step],
) -> Iterator[Step]:
    from levkas.building import provenance
    from levkas.building.report_pages import report_of
    from levkas.core.files import make_folder, together, write_json, write_text

    key = Key(name, stage="report")
    prints = _page_prints(campaign, mine, steps)
    why = ledger.why_stale(key, prints)
    if not why:
        yield Step(key, "fresh")
        return
    yield Step(key, "running", why)
    page = places.folder(name) / "report.html"
    facts = places.folder(name) / "object.toml"
    made_of = places.folder(name) / provenance.NAME
    try:
        make_folder(page.parent)
        with together(lambda: ledger.forget(key)):
            write_text(page, report_of(campaign, places, ledger, name, mine.captures, steps))
            write_text(facts, _object_toml(campaign, name))
            write_json(made_of, provenance.provenance_of(campaign, ledger, name, mine.captures))
    except Refused as error:
        yield Step(key, "refused", error.problems[0].message, problems=error.problems)
        return
    ledger.keep(key, prints, [page, facts, made_of])
    yield Step(key, "done", why)


def _object_toml(campaign: Campaign, name: str) -> str:
    """Museum facts of an object."""
    from levkas.campaign.schema.toml import to_toml

    facts = campaign.objects.get(name)
    return to_toml({"name": name, **(facts.model_dump() if facts else {})})


def _refusal(where: tuple[str, str, str], refused: Refused) -> Step:
    name, camera, setup = where
    message = refused.problems[0].message if refused.problems else str(refused)
    return Step(
        Key(name, camera, setup, "calibrate"), "refused", message, problems=tuple(refused.problems)
    )


def _is_refusal(step: Step, refusals: Refusals) -> bool:
    return (step.key.object, step.key.camera, step.key.setup) in refusals


__all__ = ["build", "digest", "status", "summarise"]
