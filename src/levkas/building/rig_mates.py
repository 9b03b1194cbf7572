"""Which captures are adjusted together, and what each of them was made of."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from zipfile import BadZipFile

from levkas.building import fingerprints
from levkas.building.build_records import Key
from levkas.building.fingerprints import digest
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from levkas.building.build_records import BuildRecords
    from levkas.building.register import Measured
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.database.layout import Places

NOT_THERE = "not registered"
#: On either side; more know no more of a lens, and every pair of captures is compared.
NEIGHBOURS = 6


@dataclass
class RigMates:
    """All captures of a campaign, by the cameras that `[registration] joint` is said of.

    Parameters
    ----------
    captures : sequence of Capture
        Of all objects.
    """

    campaign: Campaign
    places: Places
    ledger: BuildRecords
    captures: Sequence[Capture]
    _noted: dict[tuple[str, str], str] = field(default_factory=dict)
    _digests: dict[tuple[str, str], str] = field(default_factory=dict)
    _read: dict[tuple[str, str], Measured] = field(default_factory=dict)

    def of(self, capture: Capture) -> list[Capture]:
        """Return the other captures by the same camera, in the order of their names.

        The reference camera's own under its default setup are the frames of all others: they are
        adjusted with one another only, and other setups of that camera with other setups. Of many
        captures these are the nearest in that order, so that one more changes few of the others.
        """
        alike = [
            other
            for other in self.captures
            if other.camera == capture.camera and self.leads(other) == self.leads(capture)
        ]
        ring = sorted(alike, key=_name)
        place = [_name(other) for other in ring].index(_name(capture))
        if len(ring) > 2 * NEIGHBOURS + 1:
            steps = range(place - NEIGHBOURS, place + NEIGHBOURS + 1)
            ring = sorted((ring[step % len(ring)] for step in steps), key=_name)
        return [other for other in ring if _name(other) != _name(capture)]

    def path(self, capture: Capture) -> Path:
        """Return where a capture's own registration is kept."""
        return self.places.kept / capture.object / capture.layer / "measured.npz"

    def key(self, capture: Capture) -> Key:
        """Return the key of the stage that registers a capture by itself."""
        return Key(capture.object, capture.camera, capture.setup, "measure")

    def read(self, capture: Capture) -> Measured:
        """Return a capture's own registration; raises Refused where it is damaged."""
        from levkas.building.register import Measured

        where = capture.object, capture.layer
        if where not in self._read:
            path = self.path(capture)
            try:
                self._read[where] = Measured.read(path)
            except (OSError, KeyError, ValueError, EOFError, BadZipFile, zlib.error) as error:
                self.ledger.forget(self.key(capture))
                raise Refused(_damaged(path, error)) from error
        return self._read[where]

    def keep(self, capture: Capture, measured: Measured) -> Path:
        """Write a capture's own registration; raises WriteRefused."""
        from levkas.core.files import make_folder, write_bytes

        path = self.path(capture)
        make_folder(path.parent)
        write_bytes(path, measured.to_bytes())
        self._read[capture.object, capture.layer] = measured
        return path

    def note(self, capture: Capture, of: str) -> None:
        """Learn the digest of what a capture's own registration hangs on now."""
        where = capture.object, capture.layer
        if self._noted.get(where) != of:
            self._noted[where] = of
            self.look_again(where)

    def prints(self, capture: Capture) -> dict[str, str]:
        """Return what the mates of a capture were made of, by name; those that failed say so."""
        return {f"{m.object}/{m.layer}": self._digest(m) for m in self.of(capture)}

    def there(self, capture: Capture) -> dict[str, Measured]:
        """Return the mates' own registrations, by name, without those that failed."""
        return {
            f"{m.object}/{m.layer}": self.read(m)
            for m in self.of(capture)
            if self._digest(m) != NOT_THERE
        }

    def look_again(self, where: tuple[str, str]) -> None:
        """Forget what was made of a capture, (object, layer), whose stages have just ended."""
        self._digests.pop(where, None)

    def _digest(self, capture: Capture) -> str:
        where = capture.object, capture.layer
        if where not in self._digests:
            kept = self.ledger.fingerprint(self.key(capture))
            there = kept and self.path(capture).is_file()
            self._digests[where] = NOT_THERE
            if there:
                own = digest(kept, numbers_of="measure")
                self._digests[where] = self._noted.get(where) or own
        return self._digests[where]

    def leads(self, capture: Capture) -> bool:
        """Tell whether a capture is what others of its object are registered to."""
        return capture.camera == self.campaign.reference.camera and not capture.setup


def _name(capture: Capture) -> tuple[str, str]:
    return capture.object, capture.layer


def _damaged(path: Path, error: Exception) -> Problem:
    return Problem(
        "E_DAMAGED",
        "the registration that was kept of a capture cannot be read",
        str(path),
        found=str(error),
        fix="Build again: it is made anew.",
    )


def joint_keys(campaign: Campaign, capture: Capture) -> dict[str, Key]:
    """Return the keys of a capture's stages in their order, with `measure` where it is adjusted."""
    keys = fingerprints.keys_of(capture)
    if not campaign.is_joint(capture.camera):
        return keys
    measure = Key(capture.object, capture.camera, capture.setup, "measure")
    return {"calibrate": keys["calibrate"], "measure": measure, **keys}
