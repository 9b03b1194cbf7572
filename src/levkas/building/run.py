"""A build: the stages of every capture of a campaign, what is fresh left alone."""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.building import fingerprints
from levkas.building.ledger import Key, Ledger
from levkas.building.places import Places
from levkas.building.steps import BuildReport, Step, summarise
from levkas.problems import Problem, Refused

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from levkas.campaign import Campaign
    from levkas.discovery import Capture

STAGES = ("calibrate", "register", "resample")


class BuildRefused(Refused):
    """The build cannot begin, or a stage's neighbour is missing."""


@dataclass
class Work:
    """What one build knows while it runs."""

    campaign: Campaign
    places: Places
    ledger: Ledger
    total: int = 0
    done: int = 0
    digests: dict[Key, str] = field(default_factory=dict)
    ended: dict[Key, Step] = field(default_factory=dict)


def build(
    path: str | Path, *, output: str | Path | None = None, objects: list[str] | None = None
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

    Yields
    ------
    step : Step
        A refused capture ends its own stages; the other cameras and objects are built.

    Raises
    ------
    Refused
        Where the campaign itself cannot be read, or the output cannot be written.
    """
    from levkas.files import make_folder, sweep

    campaign, captures, refusals = _plan(path, objects)
    places = Places(Path(output).resolve() if output else campaign.output)
    for folder in (places.output, places.kept):
        make_folder(folder)
        sweep(folder)
    work = Work(campaign, places, Ledger(places.kept, places.output))
    yield from _run(work, captures, refusals)


def status(path: str | Path, *, output: str | Path | None = None) -> BuildReport:
    """Say of every stage whether it is fresh or stale, and why; nothing is read but file facts.

    Raises as `build`.
    """
    campaign, captures, refusals = _plan(path, None)
    places = Places(Path(output).resolve() if output else campaign.output)
    work = Work(campaign, places, Ledger(places.kept, places.output))
    steps = [_refusal(work, key, refused) for key, refused in _refusal_keys(refusals)]
    for capture in captures:
        for key, prints in fingerprints.of_capture(work, capture):
            why = work.ledger.why_stale(key, prints)
            steps.append(Step(key, "stale" if why else "fresh", why))
            work.digests[key] = digest(prints)
    return summarise(steps, places.output)


def digest(prints: dict[str, Any]) -> str:
    """Hash a fingerprint, so that what depends on it can name it."""
    text = json.dumps(prints, sort_keys=True, ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
