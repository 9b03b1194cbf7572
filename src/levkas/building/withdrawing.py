"""What becomes of a layer whose stage was refused: its files go, and its step says why."""

from __future__ import annotations

from typing import TYPE_CHECKING

from levkas.building import fingerprints
from levkas.building.ledger import STAGES, Key, Ledger
from levkas.building.standing import is_of_the_disk
from levkas.building.steps import Step
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from levkas.campaign.discovery.captures import Capture
    from levkas.database.layout import Places

CATALOGUE = Key("", stage="catalogue")


def withdraw(capture: Capture, places: Places, ledger: Ledger, stage: str = "resample") -> None:
    """Take away what an earlier build made of a layer from the stage on that is refused now."""
    from levkas.core.files import remove

    keys = [Key(capture.object, capture.camera, capture.setup, s) for s in STAGES]
    for key in keys[STAGES.index(stage) : -1]:
        if key.stage == stage and ledger.told(key).get("refused"):
            continue  # a registration that is refused has a record
        for name in sorted(ledger.made_by(key)):
            remove(places.output / name)
        ledger.drop(key)
    # By name, not by record: an interrupted build has dropped the record and left the files.
    ledger.forget(CATALOGUE)
    ledger.forget(fingerprints.keys_of(capture)["resample"])
    files = [
        places.layer(capture.object, capture.camera, capture.setup, kind=kind)
        for kind in (".tif", ".flags.tif", ".sigma.tif", ".png")
    ]
    for path in (*files, places.store(capture.object) / capture.layer):
        if path.exists():
            remove(path)


def put_away(name: str, camera: str, setup: str, ledger: Ledger) -> None:
    """Move out what was made of a capture that cannot even be begun."""
    for stage in STAGES:
        put_away_stage(Key(name, camera, setup, stage), ledger)


def put_away_stage(key: Key, ledger: Ledger) -> None:
    """Move out what a stage made, and forget it."""
    if made := ledger.made_by(key):
        ledger.forget(CATALOGUE)
        ledger.put_away(made)
        ledger.drop(key)


class NoReference(Refused):
    """Nothing can be registered to a reference that is not there."""

    of_the_disk = False
    """Whether nothing but the disk refused the reference."""


def no_reference(name: str, layer: str, failed: Step) -> NoReference:
    """Return the refusal of all that would be registered to a reference that was lost."""
    refused = NoReference(
        Problem(
            "E_NO_REFERENCE",
            f"{name}: the reference camera could not be built, so nothing can be registered to it",
            field="campaign.reference",
            found=f"{layer}: {failed.why}",
            fix="Mend the reference camera's frames first.",
        )
    )
    refused.of_the_disk = is_of_the_disk(failed.problems)
    return refused


def refused_step(key: Key, refused: Refused) -> Step:
    """Return the step of a stage that was refused."""
    why = refused.problems[0].message if refused.problems else str(refused)
    return Step(key, "refused", why, problems=tuple(refused.problems))
