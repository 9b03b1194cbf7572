"""The rounds of a build before its last: what captures that are adjusted together saw by themselves."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from levkas.building.objects import ObjectBuild, Round

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from levkas.building.build_records import BuildRecords, Key
    from levkas.building.progress import Step
    from levkas.building.rig_mates import RigMates
    from levkas.building.template_cache import TemplateCache
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.database.layout import Places


@dataclass
class JointRound:
    """Calibrates and registers, object by object, every capture that others wait for.

    Parameters
    ----------
    campaign, places, ledger, shelf, mates
        As of the build.
    """

    campaign: Campaign
    places: Places
    ledger: BuildRecords
    shelf: TemplateCache
    mates: RigMates
    _ended: dict[Key, Step] = field(default_factory=dict)

    def captures(self) -> list[Capture]:
        """Return the captures of this round: adjusted ones, and what they are registered to."""
        joint = [c for c in self.mates.captures if self.campaign.is_joint(c.camera)]
        names = {c.object for c in joint}
        return [
            c
            for c in self.mates.captures
            if c.object in names and (c in joint or self.mates.leads(c))
        ]

    def run(self) -> Iterator[Step]:
        """Yield the steps of all objects.

        The reference cameras of all objects are adjusted before anything is registered to them.
        """
        mine = self.captures()
        rounds: list[Round] = ["references", "others"]
        for of in rounds:
            for name in dict.fromkeys(c.object for c in mine):
                here = self.left([c for c in mine if c.object == name])
                if not here or not self.mates.leads(here[0]):
                    continue  # without its reference it is refused as ever
                build = ObjectBuild(
                    self.campaign, self.places, self.ledger, self.shelf, name, here, self.mates
                )
                for step in build.run(of):
                    if self.told(step):
                        continue
                    if step.finished:
                        self._ended[step.key] = step
                        self.mates.look_again((step.key.object, step.key.layer))
                    yield step

    def steps(self, name: str) -> list[Step]:
        """Return how the stages of an object ended in this round."""
        return [step for key, step in self._ended.items() if key.object == name]

    def left(self, captures: Sequence[Capture]) -> list[Capture]:
        """Return those captures for which nothing went wrong; none where their reference is lost."""
        lost = {
            (key.object, key.layer)
            for key, step in self._ended.items()
            if step.state in ("refused", "failed")
        }
        if any(self.mates.leads(c) and (c.object, c.layer) in lost for c in captures):
            return []
        return [c for c in captures if (c.object, c.layer) not in lost]

    def told(self, step: Step) -> bool:
        """Tell whether a step says only what this round has said already."""
        return step.key in self._ended and step.state == "fresh"
