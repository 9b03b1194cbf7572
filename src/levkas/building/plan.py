"""A campaign, its captures and the graph of their tasks, read from its files without a pixel."""

from __future__ import annotations

import re
from collections.abc import Container, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from levkas.building.build_records import BuildRecords, Key, key_of
from levkas.building.camera_pages import CameraPage, camera_pages
from levkas.building.graph import Graph, Step, graph_of, ordered
from levkas.building.outcomes import is_named, no_reference, refused_step
from levkas.campaign.campaign import Campaign, CampaignInvalid, load_campaign
from levkas.campaign.discovery.captures import Capture, CaptureRefused, Refusals
from levkas.campaign.discovery.check_names import check_edits, check_names
from levkas.campaign.discovery.file_index import scan_folders
from levkas.campaign.discovery.find_captures import find_captures
from levkas.campaign.edits import FILE_NAME, Edits
from levkas.core.problems import Problem, closest_match


@dataclass(frozen=True)
class Plan:
    """A campaign, its captures and the graph of its tasks.

    `refusals` are of captures that cannot be begun. In the `listed` folders frames were looked for.
    """

    campaign: Campaign
    captures: list[Capture]
    refusals: Refusals
    graph: Graph
    pages: dict[Key, CameraPage]
    listed: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """Every object, also those of which nothing can be built."""
        found = (*(c.object for c in self.captures), *(key[0] for key in self.refusals))
        return list(dict.fromkeys(found))

    def lost(self) -> dict[str, list[Step]]:
        """Return how the captures end that are not in the graph, by object."""
        found: dict[str, list[Step]] = {name: [] for name in self.names}
        for (name, camera, setup), refused in self.refusals.items():
            found[name].append(refused_step(Key(name, camera, setup, "calibrate"), refused))
        for capture in self.captures:
            if key_of(capture, "calibrate") not in self.graph:
                camera = self.campaign.reference.camera
                lost = self.refusals.get((capture.object, camera, ""))
                why = lost.problems[0].message if lost else "no capture"
                found[capture.object].append(no_reference(capture, camera, why))
        return found

    def with_missing(self, records: BuildRecords, objects: Container[str] | None = None) -> Plan:
        """Return the plan with a refusal of every finished layer that campaign.toml names, and of which no frame was found."""
        known = {(c.object, c.camera, c.setup) for c in self.captures} | {*self.refusals}
        missing: Refusals = {
            (key.object, key.camera, key.setup): CaptureRefused(
                Problem(
                    "E_NO_FRAMES",
                    f"{key.layer}: no frame of {key.object} was found, of which the database has a layer",
                    str(self.campaign.path),
                    f"cameras.{key.camera}.files",
                    fix="Bring the frames back, or take what is to go out of campaign.toml: the camera, or the object out "
                    "of `targets.objects`. A single layer goes with its TIFF.",
                )
            )
            for key in records.layers()
            if (objects is None or key.object in objects)
            and (key.object, key.camera, key.setup) not in known
            if is_named(self.campaign, key) and records.finished(key)
        }
        return replace(self, refusals={**self.refusals, **missing})

    def of(self, objects: Sequence[str]) -> Plan:
        """Return the plan of some objects; raises CampaignInvalid where there is none of a name."""
        if missing := [name for name in objects if name not in self.names]:
            where = str(self.campaign.path), "--object", ", ".join(missing)
            known = ", ".join(sorted(self.names)), closest_match(missing[0], self.names)
            raise CampaignInvalid(Problem("E_VALUE", "unknown object", *where, *known))
        captures = [c for c in self.captures if c.object in objects]
        refusals = {key: r for key, r in self.refusals.items() if key[0] in objects}
        wanted = (key for key in self.graph if key.object in objects)
        graph = {task.key: task for task in ordered(self.graph, wanted)}
        return replace(self, captures=captures, refusals=refusals, graph=graph)


def read_plan(path: str | Path) -> Plan:
    """Read a campaign, find its captures and lay out its tasks."""
    return plan_of(load_campaign(path))


def plan_of(campaign: Campaign) -> Plan:
    """Find the captures of a campaign and lay out its tasks."""
    index = scan_folders(campaign)
    captures, refusals = find_captures(campaign, index)
    check_names(campaign, index, refusals)
    _check_edits(campaign, captures, refusals)
    pages = camera_pages(campaign, captures, index)
    charts = [chart for page in pages.values() for chart in page.charts]
    graph = graph_of(campaign, captures, charts)
    return Plan(campaign, captures, refusals, graph, pages, index.folders.listed)


def _check_edits(campaign: Campaign, captures: list[Capture], refusals: Refusals) -> None:
    """Refuse corrections by hand of what the campaign does not have; what is refused is had."""
    lost = {(c.object, c.layer) for c in (Capture(*key, ()) for key in refusals)}
    names, edits = {name for name, _ in lost}, campaign.edits
    left = Edits(
        {k: e for k, e in edits.frames.items() if (k[0], re.split("[:#]", k[1])[0]) not in lost},
        {name: corners for name, corners in edits.outlines.items() if name not in names},
        {key: word for key, word in edits.confirmed.items() if key not in lost},
    )
    if left != Edits():
        file = campaign.root / FILE_NAME
        check_edits(left, captures, file, campaign.reference.camera)
