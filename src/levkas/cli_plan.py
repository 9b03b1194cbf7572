"""`levkas plan`: parse, one library call, print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

plan_app = typer.Typer(
    help="Plan the light before a lamp is hung.", no_args_is_help=True, rich_markup_mode=None
)

from levkas.cli import Json, _refusing, _report  # noqa: E402  (either may be imported first)

SetupPath = Annotated[Path, typer.Argument(help="Setup file, or a folder with one.")]
Lighting = Annotated[
    str | None, typer.Option("--setup-name", "-s", help="One of its setups; the first without.")
]


@plan_app.command("light")
@_refusing("plan light")
def light(
    setup: SetupPath,
    name: Lighting = None,
    optimise: Annotated[
        bool, typer.Option("--optimise", help="Search the best places for two lamps.")
    ] = False,
    report: Annotated[
        Path | None, typer.Option("--report", "-o", help="HTML page to write; prints on A4.")
    ] = None,
    render: Annotated[
        Path | None,
        typer.Option("--render", help="PNG of what a camera would see; needs levkas[render]."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the random starts.", min=0)] = 1,
    as_json: Json = False,
) -> None:
    """Evenness, glare, relief and bright field of a lighting, and what each lever would change."""
    from levkas.planning.saying import light_record, light_text

    record = light_record(setup, name, optimised=optimise, seed=seed)
    if report is not None:
        from levkas.planning.report import write_report

        record["report"] = str(write_report(report, record.setup, name, seed=seed))
    if render is not None:
        from levkas.planning.contact_sheet import render_sheet

        record["render"] = str(render_sheet(record.setup, render, seed=seed))
    _report("plan light", as_json, True, [], **record)
    if not as_json:
        typer.echo(light_text(record))


@plan_app.command("framing")
@_refusing("plan framing")
def framing(setup: SetupPath, as_json: Json = False) -> None:
    """Field, working distance, sampling, depth of field and diffraction of every camera."""
    from levkas.planning.framing import plan_framing
    from levkas.planning.saying import framing_text
    from levkas.planning.setup import load_setup

    found = plan_framing(load_setup(setup))
    _report("plan framing", as_json, True, [], cameras=[f.to_dict() for f in found])
    if not as_json:
        typer.echo(framing_text(found))


@plan_app.command("exposure")
@_refusing("plan exposure")
def exposure(
    setup: Annotated[Path, typer.Option("--setup", help="Setup file, or a folder with one.")],
    name: Lighting = None,
    as_json: Json = False,
) -> None:
    """Exposure, SNR and limiting channel of every camera, regulating filter, dose and flicker."""
    from levkas.planning.saying import exposure_record, exposure_text

    record = exposure_record(setup, name)
    _report("plan exposure", as_json, True, [], **record)
    if not as_json:
        typer.echo(exposure_text(record))
