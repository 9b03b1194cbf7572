"""`levkas plan`: parse, one library call, print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

plan_app = typer.Typer(
    help="Plan exposures before anything is taken in earnest.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

from levkas.cli import Json, _refusing, _report  # noqa: E402  (either may be imported first)


@plan_app.command("exposure")
@_refusing("plan exposure")
def exposure(
    frames: Annotated[
        list[Path], typer.Argument(help="Frames of a white, or folders of them; a file a band.")
    ],
    dark: Annotated[
        list[Path] | None, typer.Option("--dark", help="Dark frame or folder; may be repeated.")
    ] = None,
    pattern: Annotated[
        str | None, typer.Option(help="Of a mosaic, such as RGGB; default the file's own.")
    ] = None,
    black: Annotated[float | None, typer.Option(help="Counts; default the file's own.")] = None,
    saturation: Annotated[
        float | None, typer.Option(help="Counts; default the full scale.")
    ] = None,
    time: Annotated[
        float | None, typer.Option(help="Exposure in s, where names and headers do not tell.")
    ] = None,
    of_object: Annotated[
        bool,
        typer.Option("--object", help="The frames show the object: gold may outshine a white."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Which exposure to set, channel by channel or band by band, from frames; with SNR and ISO."""
    from levkas.coaching import advice_text, coach

    found = coach(
        frames,
        dark or (),
        pattern=pattern,
        black=black,
        saturation=saturation,
        exposure_s=time,
        is_white=not of_object,
    )
    _report("plan exposure", as_json, True, [], bands=[c.to_dict() for c in found])
    if not as_json:
        typer.echo(advice_text(found))
