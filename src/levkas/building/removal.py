"""What a campaign no longer has: found by the records of earlier builds, and moved out of the database."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from levkas.building.build_records import CATALOGUE, STAGES, BuildRecords, Key, key_of
from levkas.building.graph import Step, keys_of
from levkas.core.disk import DISK_CODES
from levkas.core.problems import Problem, Refused
from levkas.core.text import counted

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    from levkas.building.build_records import BuildRecords, Key
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture, Refusals
    from levkas.core.problems import Problem
    from levkas.database.layout import Places

REMOVED = Key("", stage="removed")


def no_longer_there(
    campaign: Campaign,
    records: BuildRecords,
    captures: Sequence[Capture],
    refusals: Refusals,
    pages: Iterable[Key],
    objects: Collection[str] | None,
) -> list[Key]:
    """Return the recorded stages of what the campaign does not have any more.

    A capture that is refused is still one of the campaign's. `objects` are those that are built; None
    for all, and for the pages of cameras.
    """
    known = {key for c in captures for key in keys_of(campaign, c).values()} | {*pages}
    known |= {Key(name, stage="report") for name in _names(captures, refusals)}
    return [
        key
        for key in records.recorded()
        if key not in known
        and (key.object, key.camera, key.setup) not in refusals
        and (objects is None or key.object in objects)
    ]


def describe(keys: Iterable[Key], records: BuildRecords) -> str:
    """Say what is no longer in the campaign; empty where nothing of it is in the database."""
    there = [key for key in keys if records.made_by(key)]
    layers = {(key.object, key.layer) for key in there if key.object and key.camera}
    told = {
        "layer": len(layers),
        "object": sum(key.stage == "report" for key in there),
        "camera": sum(key.stage == "camera" for key in there),
    }
    parts = [counted(n, what) for what, n in told.items() if n]
    if not parts:
        return ""
    verb = "is" if sum(told.values()) == 1 else "are"
    return f"{' and '.join(parts)} {verb} no longer in the campaign"


def removal(keys: Sequence[Key], records: BuildRecords) -> list[Step]:
    """Move what is no longer in the campaign out of the database, unless it is to stay.

    Returns
    -------
    steps : list of Step
        One, or none where there was nothing.
    """
    told = describe(keys, records)
    if told and records.keep_removed:
        return [Step(REMOVED, "fresh", warnings=(f"{told}, and was kept",))]
    if keys and not records.keep_removed:
        records.forget(CATALOGUE)  # what it lists is about to change
    where = None
    for key in keys if not records.keep_removed else ():
        where = records.put_away(records.made_by(key)) or where
        records.drop(key)
    if where is None:
        return []
    return [Step(REMOVED, "done", told, warnings=(f"{told}: moved to {where}",))]


def _names(captures: Sequence[Capture], refusals: Refusals) -> set[str]:
    return {c.object for c in captures} | {name for name, _, _ in refusals}


def is_of_the_disk(problems: Iterable[Problem]) -> bool:
    """Tell whether nothing but the disk refused: nothing is wrong with frames and parameters."""
    codes = {problem.code for problem in problems}
    return bool(codes) and codes <= DISK_CODES


def withdraw(
    capture: Capture, places: Places, records: BuildRecords, stage: str = "resample"
) -> None:
    """Take away what an earlier build made of a layer from the stage on that is refused now."""
    from levkas.core.files import remove

    keys = [Key(capture.object, capture.camera, capture.setup, s) for s in STAGES]
    for key in keys[STAGES.index(stage) : -1]:
        if key.stage == stage and records.notes(key).get("refused"):
            continue  # a registration that is refused has a record
        for name in sorted(records.made_by(key)):
            remove(places.output / name)
        records.drop(key)
    # By name, not by record: an interrupted build has dropped the record and left the files.
    records.forget(key_of(capture, "resample"))
    files = [
        places.layer(capture.object, capture.camera, capture.setup, kind=kind)
        for kind in (".tif", ".flags.tif", ".sigma.tif", ".png")
    ]
    paths = (*files, places.store(capture.object) / capture.layer)
    there = [path for path in paths if os.path.lexists(path)]
    if there:
        records.forget(CATALOGUE)
    for path in there:
        remove(path)


def put_away(name: str, camera: str, setup: str, records: BuildRecords) -> None:
    """Move out what was made of a capture that cannot even be begun."""
    for stage in STAGES:
        put_away_stage(Key(name, camera, setup, stage), records)


def put_away_stage(key: Key, records: BuildRecords) -> None:
    """Move out what a stage made, and forget it."""
    if made := records.made_by(key):
        records.forget(CATALOGUE)
        records.put_away(made)
        records.drop(key)


class NoReference(Refused):
    """Nothing can be registered to a reference that is not there."""

    of_the_disk = False
    """Whether nothing but the disk refused the reference."""


def no_reference(name: str, layer: str, failed: Step) -> NoReference:
    """Return the refusal of all that would be registered to a reference that was lost."""
    refused = NoReference(
        Problem(
            "E_NO_REFERENCE",
            f"{name}: the reference camera could not be built, so no camera can be registered",
            field="campaign.reference",
            found=f"{layer}: {failed.why}",
            fix="Correct the frames of the reference camera first.",
        )
    )
    refused.of_the_disk = is_of_the_disk(failed.problems)
    return refused


def refused_step(key: Key, refused: Refused) -> Step:
    """Return the step of a stage that was refused."""
    why = refused.problems[0].message if refused.problems else str(refused)
    return Step(key, "refused", why, problems=tuple(refused.problems))
