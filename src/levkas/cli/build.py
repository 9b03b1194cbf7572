"""Commands that make and check a database: look, build, status, validate."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from levkas.cli.output import (
    CampaignPath,
    DatabasePath,
    Json,
    Objects,
    draw_steps,
    finish,
    path_or_address,
    print_report,
    refusing,
)

VERIFY = "Read every file again, even if size, times and inode are unchanged."


@refusing("look")
def look(
    folder: Annotated[Path, typer.Argument(help="Folder of raw frames.")],
    write: Annotated[
        bool,
        typer.Option("--write", help="Write campaign.toml into the folder if it has none."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Propose a commented campaign.toml for a folder of captures; print it before writing."""
    from levkas.campaign.guess import look as look_at
    from levkas.campaign.guess import write_campaign
    from levkas.core.text import counted

    proposal = look_at(folder)
    if not as_json:
        typer.echo(proposal.text, nl=False)
    written = str(write_campaign(proposal)) if write else None
    print_report("look", as_json, True, [], written=written, **proposal.to_report())
    if not as_json:
        outcome = (
            f"Written: {written}" if written else "Nothing was written. Use --write to write it."
        )
        left = counted(len(proposal.unknown), "thing") if proposal.unknown else "nothing"
        count = len(proposal.left_out)
        out = f" Left out: {counted(count, 'thing')}, with reasons above." if count else ""
        typer.echo(f"{outcome}\nLeft unknown: {left}.{out}", err=True)


@refusing("build")
def build(
    campaign: CampaignPath,
    output: DatabasePath = None,
    objects: Objects = None,
    verify: Annotated[bool, typer.Option("--verify", help=VERIFY)] = False,
    workers: Annotated[
        str,
        typer.Option(
            help="Build objects side by side: in so many processes, or on the workers of a dask scheduler, given its address.",
            metavar="NUMBER|ADDRESS",
        ),
    ] = "",
    as_json: Json = False,
) -> None:
    """Build the database of a campaign from its raw frames."""
    from levkas.building import build as build_campaign
    from levkas.building import summarise

    if workers:
        from levkas.building.workers import build_on

        steps = build_on(workers, campaign, output=output, objects=objects, verify=verify)
    else:
        steps = build_campaign(campaign, output=output, objects=objects, verify=verify)
    report = summarise(draw_steps(steps, as_json))
    if as_json or any(step.state == "done" for step in report.stages):
        from levkas.building.layer_verdicts import layer_verdicts, report_line, verdict_lines

        if as_json:
            report = replace(report, layers=tuple(layer_verdicts(report)))
        else:
            lines = [*verdict_lines(report), report_line(report)]
            typer.echo("".join(f"{line}\n" for line in lines if line), nl=False)
    finish("build", report, as_json)


@refusing("status")
def status(
    campaign: CampaignPath,
    output: DatabasePath = None,
    verify: Annotated[bool, typer.Option("--verify", help=VERIFY)] = False,
    as_json: Json = False,
) -> None:
    """List the verdicts of a database, and its stale stages with the reasons."""
    from levkas.building import status as status_of
    from levkas.building.layer_verdicts import layer_verdicts, standing_lines

    report = status_of(campaign, output=output, verify=verify)
    if as_json:
        report = replace(report, layers=tuple(layer_verdicts(report)))
    else:
        typer.echo("".join(f"{line}\n" for line in standing_lines(report)), nl=False)
    finish("status", report, as_json)


@refusing("validate")
def validate(
    database: Annotated[
        Path,
        typer.Argument(
            help="Database folder or its address (s3://…, https://…), also of a database by other "
            "software in the same form.",
            parser=path_or_address,
        ),
    ],
    as_json: Json = False,
) -> None:
    """Check a database and list every damaged file."""
    from levkas.database.validation import validate as validate_database

    quiet = as_json or not sys.stderr.isatty()
    report = validate_database(database, draw=lambda steps: draw_steps(steps, quiet))
    finish("validate", report, as_json)
