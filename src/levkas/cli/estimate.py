"""Commands that make layers from registered ones: estimate, estimate apply."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from levkas.cli.output import Json, Objects, Overwrite, draw_steps, finish, print_report, refusing

Database = Annotated[Path, typer.Argument(help="Database folder.")]
Sources = Annotated[
    list[str] | None,
    typer.Option(
        "--from",
        help="Layer to estimate from, or several joined: d80,msbs; may be repeated. Default: each "
        "camera with broad channels.",
    ),
]
Target = Annotated[
    str, typer.Option("--to", help="Layer with the spectra to estimate; default the reference.")
]
Train = Annotated[
    list[str] | None, typer.Option("--train", help="Train on this painting; may be repeated.")
]
Test = Annotated[
    list[str] | None, typer.Option("--test", help="Test on this painting; may be repeated.")
]
Seed = Annotated[int, typer.Option(help="Random seed.", min=0)]


@refusing("estimate")
def estimate(
    database: Database,
    sources: Sources = None,
    target: Target = "",
    methods: Annotated[
        list[str] | None,
        typer.Option("--method", help="Only this method; may be repeated. Default: all."),
    ] = None,
    train: Train = None,
    test: Test = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder for page, JSON and models."),
    ] = None,
    seed: Seed = 1,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Estimate the spectra of held-out paintings from few channels, and report how well."""
    from levkas.estimation.experiment import run_experiment
    from levkas.estimation.plan import ExperimentPlan

    plan = ExperimentPlan(
        database, sources or (), target, methods or (), train or (), test or (),
        models=output is not None, seed=seed,
    )  # fmt: skip
    _report("estimate", run_experiment(plan), output, overwrite, as_json)


@refusing("estimate apply")
def apply(
    database: Database,
    model: Annotated[Path, typer.Argument(help="Model, .npz of an earlier `levkas estimate -o`.")],
    layer: Annotated[str, typer.Argument(help="Name of the new layer.")],
    objects: Objects = None,
    as_json: Json = False,
) -> None:
    """Write a layer that is estimated with a model; it is never called a measurement."""
    from levkas.estimation.applying import apply_model

    steps = draw_steps(apply_model(database, model, layer, objects=objects or ()), as_json)
    files = [str(path) for step in steps for path in step.files]
    print_report("estimate apply", as_json, True, [], layer=layer, estimated=True, files=files)
    if not as_json:
        typer.echo(f"{len(steps)} layers {layer} estimated, not measured")


def _report(
    command: str, steps: Iterable[Any], output: Path | None, overwrite: bool, as_json: bool
) -> None:
    """Show the steps of an experiment, write its page where one is wanted, and print its report."""
    report = draw_steps(steps, as_json)[-1].report
    if output is not None:
        from levkas.pages.estimation import write_page

        write_page(report, output, overwrite=overwrite)
    finish(command, report, as_json)
