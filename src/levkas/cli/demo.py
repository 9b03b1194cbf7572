"""Commands that make campaigns: simulate, and demo, which builds one and compares it with its truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from levkas.cli.output import Json, draw_steps, print_report, refusing
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

    `folder` is new, or that of an earlier demonstration, which is built anew where stale; `draw` consumes the steps of long
    work.

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
                    "the folder is not empty and has no campaign",
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
            f"View it:    open {page[0] if page else folder / 'database'} in a browser.",
            f"Use it:     python -c \"import levkas; print(levkas.open('{folder / 'database'}'))\"",
        ]
    )
    return Demonstration(report.ok, evaluation.results, report.problems, text)


@refusing("simulate")
def simulate(
    folder: Annotated[Path, typer.Argument(help="New folder for the simulated campaign.")],
    preset: Annotated[str, typer.Option(help="small, default, hard or full.")] = "default",
    scale: Annotated[
        float | None, typer.Option(help="Scale of the frames; 1 is the paper's size.")
    ] = None,
    objects: Annotated[
        int,
        typer.Option(help="Number of painted panels, each with its own pigments.", min=1),
    ] = 1,
    seed: Annotated[int, typer.Option(help="Random seed.", min=0)] = 1,
    setups: Annotated[bool, typer.Option(help="Add the 45-degree lighting.")] = False,
    setup: Annotated[
        list[str] | None,
        typer.Option(
            "--setup",
            help="Add the colour camera under this lighting: 45-degree, crossed (polarisers), soft or "
            "d65; may be repeated.",
        ),
    ] = None,
    unevenness: Annotated[
        float | None,
        typer.Option(
            help="Tilt of ground and leaf against the panel, in degrees; default 5 with other lightings, else 0."
        ),
    ] = None,
    tiles: Annotated[
        list[str] | None,
        typer.Option(
            help="Capture in tiles, ROWSxCOLUMNS, or CAMERA=ROWSxCOLUMNS for one camera; may be repeated."
        ),
    ] = None,
    overlap: Annotated[
        float | None, typer.Option(help="Share of a tile that its neighbour sees too.")
    ] = None,
    camera: Annotated[
        list[str] | None,
        typer.Option(
            "--camera", help="Simulate this camera and the reference only; may be repeated."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Simulate a five-camera campaign with known truth."""
    from levkas.simulation import simulate_campaign
    from levkas.simulation.presets import choose_preset

    chosen = choose_preset(preset, scale=scale, objects=objects)
    chosen = chosen if overlap is None else replace(chosen, overlap=overlap)
    steps = simulate_campaign(
        folder,
        preset=replace(chosen, own_pigments=objects > 1, unevenness_deg=unevenness),
        scale=scale,
        objects=objects,
        seed=seed,
        setups=setup or setups,
        cameras=camera,
        tiles=tiles,
    )
    draw_steps(steps, as_json)
    print_report("simulate", as_json, True, [], campaign=str(folder))
    if not as_json:
        typer.echo(f"Simulated {folder}. Build it: levkas build {folder}")


@refusing("demo")
def demo(
    folder: Annotated[Path, typer.Argument(help="Folder for the demonstration.")] = Path("demo"),
    seed: Annotated[int, typer.Option(help="Random seed.", min=0)] = 1,
    as_json: Json = False,
) -> None:
    """Simulate a small campaign, build it, compare it with the truth, and print where to view it."""
    report = demonstrate(folder, seed=seed, draw=lambda steps: draw_steps(steps, as_json))
    print_report("demo", as_json, report.ok, report.problems, results=report.results)
    if not as_json:
        typer.echo(report.text)
    raise typer.Exit(0 if report.ok else 1)
