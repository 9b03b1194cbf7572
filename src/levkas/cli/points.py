"""`levkas points`: parse, one library call, print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

points_app = typer.Typer(
    help="Control points of other programs.", no_args_is_help=True, rich_markup_mode=None
)

from levkas.cli import Json, Overwrite, _refusing, _report  # noqa: E402  (either may be imported first)


@points_app.callback()
def _points() -> None:
    pass


@points_app.command("convert")
@_refusing("points convert")
def convert(
    source: Annotated[
        Path,
        typer.Argument(metavar="IN", help="File; that of the reference where there are two."),
    ],
    output: Annotated[Path, typer.Argument(metavar="OUT", help="File to write.")],
    to: Annotated[
        str,
        typer.Option(help="levkas, bigwarp, qgis, hugin, elastix, napari, butterfly or cpselect."),
    ] = "levkas",
    target: Annotated[
        Path | None, typer.Option(help="File of the target, where IN is of the reference alone.")
    ] = None,
    dialect: Annotated[
        str | None, typer.Option("--from", help="Dialect of IN; told from its content without.")
    ] = None,
    reference_size: Annotated[
        str | None, typer.Option(help="width,height of the reference picture.")
    ] = None,
    target_size: Annotated[
        str | None, typer.Option(help="width,height of the target picture.")
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Read control points of one program and write them as another's, pixel origins and all."""
    from levkas.registration.control_points import losses, parse_size, read_points, write_points

    points = read_points(
        source,
        target,
        dialect=dialect,
        reference_size=parse_size(reference_size),
        target_size=parse_size(target_size),
    )
    paths = write_points(points, output, to, overwrite=overwrite)
    lost = losses(points, to)
    _report(
        "points convert", as_json, True, [],
        points=len(points), written=[str(p) for p in paths], losses=lost,
    )  # fmt: skip
    if not as_json:
        said = "".join(f"; {loss}" for loss in lost)
        typer.echo(f"{len(points)} points: {', '.join(str(p) for p in paths)}{said}")
