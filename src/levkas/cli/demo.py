"""The demonstration: simulate a small campaign, build it, compare it with the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from levkas.core.ownership import stands_in
from levkas.core.problems import Problem, Refused


class DemonstrationRefused(Refused):
    """The folder is in use for something else."""


@dataclass(frozen=True)
class Demonstration:
    """What came of it."""

    ok: bool
    results: list[dict[str, Any]]
    problems: list[Problem]
    text: str


def demonstrate(
    folder: str | Path, *, seed: int = 1, draw: Callable[[Iterator[Any]], Iterable[Any]] = list
) -> Demonstration:
    """Simulate, build and evaluate a small five-camera campaign.

    Parameters
    ----------
    folder : path
        A new folder, or the folder of an earlier demonstration, which is built anew where stale.
    seed : int
        Seed of the simulation.
    draw : callable
        Consumes the steps of long work; the command line draws progress here.

    Raises
    ------
    DemonstrationRefused
        Where the folder holds something else.
    """
    from levkas.building import build, summarise
    from levkas.quality.evaluation.layer_report import assess
    from levkas.simulation import simulate_campaign

    folder = Path(folder)
    if not (folder / "campaign.toml").is_file():
        if stands_in(folder):
            raise DemonstrationRefused(
                Problem(
                    "E_VALUE",
                    "the folder is not empty and holds no campaign",
                    file=str(folder),
                    fix="Give a new folder.",
                )
            )
        list(draw(simulate_campaign(folder, preset="small", seed=seed)))
    report = summarise(draw(build(folder)))
    evaluation = assess(folder)
    page = sorted((folder / "database" / "objects").glob("*/report.html"))
    text = "\n".join(
        [
            report.text,
            "",
            "Errors of every band against the exact truth, in pixels of the reference band:",
            evaluation.text,
            "",
            f"Look at it: open {page[0] if page else folder / 'database'} in a browser.",
            f"Use it:     python -c \"import levkas; print(levkas.open('{folder / 'database'}'))\"",
        ]
    )
    return Demonstration(report.ok, evaluation.results, report.problems, text)
