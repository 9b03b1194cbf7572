"""What becomes of a layer whose stage was refused: its files go, and its step says why."""

from __future__ import annotations

from typing import TYPE_CHECKING

from levkas.building import fingerprints
from levkas.building.ledger import Key, Ledger
from levkas.building.steps import Step
from levkas.problems import Problem, Refused

if TYPE_CHECKING:
    from levkas.building.places import Places
    from levkas.discovery import Capture

CATALOGUE = Key("", stage="catalogue")


def withdraw(capture: Capture, places: Places, ledger: Ledger) -> None:
    """Take away what an earlier build published of a layer that is refused now."""
    from levkas.files import remove

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


class NoReference(Refused):
    """Nothing can be registered to a reference that is not there."""


def no_reference(name: str, layer: str, failed: Step) -> NoReference:
    """Return the refusal of all that would be registered to a reference that was lost."""
    return NoReference(
        Problem(
            "E_NO_REFERENCE",
            f"{name}: the reference camera could not be built, so nothing can be registered to it",
            field="campaign.reference",
            found=f"{layer}: {failed.why}",
            fix="Mend the reference camera's frames first.",
        )
    )


def refused_step(key: Key, refused: Refused) -> Step:
    """Return the step of a stage that was refused."""
    why = refused.problems[0].message if refused.problems else str(refused)
    return Step(key, "refused", why, problems=tuple(refused.problems))
