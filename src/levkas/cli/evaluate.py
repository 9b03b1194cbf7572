"""Commands about positions and agreement: evaluate, agree, map."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from levkas.cli.output import (
    Json,
    Objects,
    Overwrite,
    path_or_address,
    print_report,
    refusing,
)

Database = Annotated[
    Path,
    typer.Argument(
        help="Database folder or its address (s3://…, https://…), or the campaign it was built from.",
        parser=path_or_address,
    ),
]
Truth = Annotated[
    Path | None,
    typer.Option(
        help="Folder `truth` of a simulated campaign; the default is beside the campaign."
    ),
]
Points = Annotated[
    Path | None,
    typer.Option(
        help="Check points: CSV with object, camera, band, reference_x, reference_y, x, y, or a file of BigWarp or QGIS"
    ),
]
Frame = Annotated[
    str | None,
    typer.Option(help="OBJECT/CAMERA[@SETUP][:BAND] of the points in a file of another program."),
]


@refusing("evaluate")
def evaluate(
    database: Database,
    truth: Truth = None,
    points: Points = None,
    frame: Frame = None,
    as_json: Json = False,
) -> None:
    """Report SSIM, and the error of every band at truth or check points."""
    from levkas.quality.evaluation.layer_report import assess

    report = assess(database, truth=truth, points=points, frame=frame)
    print_report("evaluate", as_json, True, report.problems, results=report.results)
    if not as_json:
        typer.echo(report.text)


@refusing("agree")
def agree(
    database: Database,
    other: Annotated[
        Path,
        typer.Argument(
            help="Another database of the same object: another laboratory, session or date.",
            parser=path_or_address,
        ),
    ],
    objects: Objects = None,
    rate: Annotated[
        float,
        typer.Option(
            "--false-alarms",
            help="Share of unchanged pixels that are marked as changed.",
            min=1e-6,
            max=1.0,
        ),
    ] = 0.01,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for the page and JSON.")
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Compare two databases of one object within their uncertainties; exit status 1 where they contradict each other, or nothing was compared."""
    from levkas.pages.agreement import agreement_text, write_agreement
    from levkas.quality.evaluation.database_agreement import compare_databases

    found = compare_databases(database, other, objects or (), rate=rate)
    if output is not None:
        write_agreement(str(database), str(other), found, output, overwrite=overwrite)
    ok = all(one.agrees for one in found)
    problems = [problem for one in found for problem in one.problems]
    print_report("agree", as_json, ok, problems, objects=[one.to_dict() for one in found])
    if not as_json:
        typer.echo(agreement_text(found))
    raise typer.Exit(0 if ok else 1)


@refusing("map")
def map_points(
    database: Annotated[
        Path,
        typer.Argument(
            help="Database folder or its address (s3://…, https://…).", parser=path_or_address
        ),
    ],
    name: Annotated[str, typer.Argument(metavar="OBJECT", help="Object in the database.")],
    points: Annotated[
        Path | None, typer.Argument(help="CSV with header x,y; default standard input.")
    ] = None,
    source: Annotated[
        str, typer.Option("--from", help="Frame: grid, CAMERA, CAMERA@SETUP:BAND …")
    ] = "grid",
    target: Annotated[str, typer.Option("--to", help="Frame of the result.")] = "grid",
    output: Annotated[Path | None, typer.Option("-o", "--output", help="CSV to write.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Map points between any two pixel frames of an object."""
    from levkas.core.ownership import require_free
    from levkas.core.text import read_stream, read_text
    from levkas.database.pixel_frames import find_map, map_table, warn_of_turns

    if output is not None:
        require_free(output, overwrite=overwrite)
    find_map(database, name, source, target)  # before a person types points in vain
    wanted = "a CSV in UTF-8 with the header x,y"
    text = (
        read_text(points, wanted)
        if points
        else read_stream(sys.stdin.buffer, "standard input", wanted)
    )
    file = str(points) if points else None
    mapped = map_table(database, name, text, source=source, target=target, file=file)
    for turned in warn_of_turns(database, name, (source, target)):
        typer.secho(f"warning: {turned}", err=True, fg=typer.colors.YELLOW)
    if outside := mapped.count("\nnan,nan"):
        typer.secho(
            f"warning: {outside} of {mapped.count(chr(10)) - 1} points lie outside the overlap of " f"{source} and {target}; their rows are nan,nan",
            err=True, fg=typer.colors.YELLOW,
        )  # fmt: skip
    if output is None:
        typer.echo(mapped, nl=False)
        return
    from levkas.core.files import write_text

    write_text(output, mapped)
