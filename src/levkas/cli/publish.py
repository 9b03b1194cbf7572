"""Commands that hand a database on: publish, export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from levkas.cli.output import (
    Cameras,
    Json,
    Objects,
    Overwrite,
    draw_steps,
    path_or_address,
    print_report,
    refusing,
)


@refusing("publish")
def publish(
    subject: Annotated[
        Path, typer.Argument(metavar="DATABASE", help="Database, or the folder of its campaign.")
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="New folder, or an earlier publication; default DATABASE.published beside it.",
        ),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Only list missing metadata and where to write them.")
    ] = False,
    url: Annotated[str, typer.Option(help="Web address of the published folder.")] = "",
    analyse: Annotated[
        list[str] | None,
        typer.Option(
            "--analyse",
            help="Also compute pictures from the layers: infrared-visible, "
            "ratio:700/1000, … separated by commas.",
        ),
    ] = None,
    without: Annotated[
        list[str] | None,
        typer.Option(
            "--without",
            metavar="CAMERA",
            help="Leave out the layers of this camera, or one as OBJECT/CAMERA; may be repeated. "
            "Needed where a layer is of an earlier build.",
        ),
    ] = None,
    no_iiif: Annotated[
        bool, typer.Option("--no-iiif", help="Skip tiles and IIIF manifests.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Make a folder that anyone can open, preview and cite."""
    from levkas.publish import run

    options: dict[str, Any] = {"output": output, "url": url, "analyse": analyse or ()}
    if check:
        missing = run.check(subject, **options, without=without or ())
        print_report("publish", as_json, missing.ok, list(missing.problems), **missing.to_dict())
        if not as_json:
            typer.echo(missing.text)
        raise typer.Exit(0 if missing.ok else 1)
    wanted = run.find_subject(subject, without=without or ())
    publication = run.publish(wanted, iiif=not no_iiif, **options)
    steps = draw_steps(publication, as_json)
    report = run.summarise(steps)
    print_report("publish", as_json, True, [], **report.to_dict())
    if not as_json:
        typer.echo(report.text)


@refusing("export")
def export(
    database: Annotated[
        Path,
        typer.Argument(
            help="Database, also a published one, or its address (s3://…, https://…).",
            parser=path_or_address,
        ),
    ],
    form: Annotated[
        Literal[
            "envi",
            "qgis",
            "netcdf",
            "photoshop",
            "ngff",
        ],
        typer.Option("--for", help="Program that will read the export."),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder; default DATABASE.FORMAT beside it."),
    ] = None,
    objects: Objects = None,
    cameras: Cameras = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Write layers in the format of another program, with unchanged values."""
    from os.path import commonpath

    from levkas.core.text import counted
    from levkas.publish.export import run

    chosen = {"objects": objects or (), "cameras": cameras or ()}
    exported = run.export(database, form, output=output, overwrite=overwrite, **chosen)
    steps = draw_steps(exported, as_json)
    files = [str(path) for step in steps for path in step.files]
    print_report("export", as_json, True, [], files=files)
    if not as_json:
        done = counted(len(files), "file"), counted(steps[-1].total if steps else 0, "layer")
        where = f": {commonpath([Path(name).parent for name in files])}" if files else ""
        typer.echo(f"{done[0]} of {done[1]} for {form}{where}")
