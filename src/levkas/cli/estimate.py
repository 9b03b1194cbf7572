"""The command that estimates spectra from the channels of registered cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from levkas.cli.output import Json, Overwrite, draw_steps, finish, print_report, refusing


@refusing("estimate")
def estimate(
    database: Annotated[Path, typer.Argument(help="Database folder.")],
    sources: Annotated[
        list[str] | None,
        typer.Option(
            "--from",
            help="Layer to estimate from, or several joined: d80,msbs; may be repeated. Default: each "
            "camera with broad channels.",
        ),
    ] = None,
    target: Annotated[
        str, typer.Option("--to", help="Layer with the spectra to estimate; default the reference.")
    ] = "",
    methods: Annotated[
        list[str] | None,
        typer.Option("--method", help="Only this method; may be repeated. Default: all."),
    ] = None,
    split: Annotated[
        str, typer.Option(help="painting, chart, camera, lighting, or random (optimistic).")
    ] = "painting",
    train: Annotated[
        list[str] | None, typer.Option("--train", help="Train on this painting; may be repeated.")
    ] = None,
    test: Annotated[
        list[str] | None, typer.Option("--test", help="Test on this painting; may be repeated.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Folder for page, JSON, CSV, error maps and models; with --apply: name of the layer.",
        ),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            "--apply", help="Write an estimated layer with this model (.npz of an earlier -o)."
        ),
    ] = None,
    objects: Annotated[
        list[str] | None,
        typer.Option("--object", help="With --apply: only this object; may be repeated."),
    ] = None,
    predictions: Annotated[
        Path | None,
        typer.Option(
            "--score", help="Score predictions from other software, one cube per test painting."
        ),
    ] = None,
    no_budget: Annotated[bool, typer.Option("--no-budget", help="Skip the error budget.")] = False,
    choose_by: Annotated[
        str,
        typer.Option(
            help="Error by which methods choose their parameters: rmse, or delta-e of colours under D65."
        ),
    ] = "rmse",
    seed: Annotated[int, typer.Option(help="Random seed.", min=0)] = 1,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Estimate the spectra of held-out paintings from few channels, and report how well."""
    from levkas.estimation.plan import ExperimentPlan

    if model is not None and output is not None:
        _apply(database, model, output, objects or (), as_json)
        return
    plan = ExperimentPlan(
        database, sources or (), target, methods or (), split, train or (), test or (),
        budget=not no_budget, models=output is not None, choose_by=choose_by, seed=seed,
    )  # fmt: skip
    if predictions is None:
        from levkas.estimation.experiment import run_experiment

        steps = run_experiment(plan)
    else:
        from levkas.estimation.scoring import score_predictions

        steps = score_predictions(plan, predictions)
    report = draw_steps(steps, as_json)[-1].report
    if output is not None:
        from levkas.pages.estimation import write_page

        write_page(report, output, overwrite=overwrite)
    finish("estimate", report, as_json)


def _apply(database: Path, model: Path, layer: Path, objects: Sequence[str], as_json: bool) -> None:
    from levkas.estimation.applying import apply_model

    steps = draw_steps(apply_model(database, model, str(layer), objects=objects), as_json)
    files = [str(path) for step in steps for path in step.files]
    print_report("estimate", as_json, True, [], layer=str(layer), estimated=True, files=files)
    if not as_json:
        typer.echo(f"{len(steps)} layers {layer} estimated, not measured")
