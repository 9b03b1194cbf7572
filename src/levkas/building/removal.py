"""What a campaign no longer has: found by the records of earlier builds, and moved out of the database."""

from __future__ import annotations

from typing import TYPE_CHECKING

from levkas.building.ledger import Key
from levkas.building.rig_mates import joint_keys
from levkas.building.steps import Step
from levkas.building.withdrawing import CATALOGUE

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    from levkas.building.ledger import Ledger
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture, Refusals

REMOVED = Key("", stage="removed")


def no_longer_there(
    campaign: Campaign,
    ledger: Ledger,
    captures: Sequence[Capture],
    refusals: Refusals,
    pages: Iterable[Key],
    objects: Collection[str] | None,
) -> list[Key]:
    """Return the recorded stages of what the campaign does not have any more.

    A capture that is refused is still one of the campaign's. `objects` are those that are built; None
    for all, and for the pages of cameras.
    """
    known = {key for c in captures for key in joint_keys(campaign, c).values()} | {*pages}
    known |= {Key(name, stage="report") for name in _names(captures, refusals)}
    return [
        key
        for key in ledger.recorded()
        if key not in known
        and (key.object, key.camera, key.setup) not in refusals
        and (objects is None or key.object in objects)
    ]


def describe(keys: Iterable[Key], ledger: Ledger) -> str:
    """Say what is no longer in the campaign; empty where nothing of it is in the database."""
    there = [key for key in keys if ledger.made_by(key)]
    layers = {(key.object, key.layer) for key in there if key.object and key.camera}
    told = {
        "layer": len(layers),
        "object": sum(key.stage == "report" for key in there),
        "camera": sum(key.stage == "camera" for key in there),
    }
    parts = [f"{n} {what}{'s' if n > 1 else ''}" for what, n in told.items() if n]
    if not parts:
        return ""
    verb = "is" if sum(told.values()) == 1 else "are"
    return f"{' and '.join(parts)} {verb} no longer in the campaign"


def removal(keys: Sequence[Key], ledger: Ledger) -> list[Step]:
    """Move what is no longer in the campaign out of the database, unless it is to stay.

    Returns
    -------
    steps : list of Step
        One, or none where there was nothing.
    """
    told = describe(keys, ledger)
    if told and ledger.keep_removed:
        return [Step(REMOVED, "fresh", warnings=(f"{told}, and was kept",))]
    if keys and not ledger.keep_removed:
        ledger.forget(CATALOGUE)  # what it lists is about to change
    where = None
    for key in keys if not ledger.keep_removed else ():
        where = ledger.put_away(ledger.made_by(key)) or where
        ledger.drop(key)
    if where is None:
        return []
    return [Step(REMOVED, "done", told, warnings=(f"{told}: moved to {where}",))]


def _names(captures: Sequence[Capture], refusals: Refusals) -> set[str]:
    return {c.object for c in captures} | {name for name, _, _ in refusals}
