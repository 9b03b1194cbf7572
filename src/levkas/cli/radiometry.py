"""`levkas radiometry`: parse, one library call, print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from levkas.cli import Json, Overwrite, _refusing, _report, app


@app.command("radiometry")
@_refusing("radiometry")
def radiometry(
    path: Annotated[
        Path,
        typer.Argument(help="Campaign (folder or campaign.toml), a frame, or a folder of frames."),
    ],
    cameras: Annotated[
        list[str] | None, typer.Option("--camera", help="Only this camera; may be repeated.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="HTML page to write, for a campaign.")
    ] = None,
    overwrite: Overwrite = False,
    seed: Annotated[int, typer.Option(help="Seed of the intervals' bootstrap.", min=0)] = 1,
    as_json: Json = False,
) -> None:
    """Say what the cameras are: bits, codes, gain, noise, PRNU, full well, linearity, steady light.

    Nothing is written but the page that --output asks for.
    """
    from levkas.core.ownership import require_free
    from levkas.quality.emva1288 import examine_with_seed

    if output is not None:
        require_free(output, overwrite=overwrite)
    found = examine_with_seed(path, cameras=cameras, seed=seed)
    written = None
    if output is not None:
        from levkas.quality.emva1288.page import write_page

        written = str(write_page(found, output))
    if not as_json:
        typer.echo(found.text)
    _report("radiometry", as_json, found.ok, found.problems, page=written, **found.to_dict())
    raise typer.Exit(0 if found.ok else 1)
