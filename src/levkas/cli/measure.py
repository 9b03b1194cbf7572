"""Commands that measure cameras and charts: chart, radiometry."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from levkas.cli.output import Cameras, Json, Overwrite, finish, print_report, refusing


@refusing("chart")
def chart(
    subject: Annotated[
        Path,
        typer.Argument(help="A campaign that declares charts, a database, or a calibrated cube."),
    ],
    kind: Annotated[
        str | None,
        typer.Option(
            help="Type of the chart in a cube: ColorChecker24 (the default), ColorCheckerSG, or edges (without colours)."
        ),
    ] = None,
    cameras: Cameras = None,
    objects: Annotated[
        list[str] | None,
        typer.Option("--object", help="Object of a database that is a chart; may be repeated."),
    ] = None,
    corners: Annotated[
        str | None,
        typer.Option(
            help="Centres of the corner patches, x,y,x,y,x,y,x,y, clockwise from the first patch."
        ),
    ] = None,
    edges: Annotated[
        list[str] | None,
        typer.Option(
            "--edge",
            help="Slanted edge in a cube: x,y,width,height of a rectangle; may be repeated.",
        ),
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(help="CSV of the chart's spectra: wavelength and one column per patch."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Report page to write, HTML.")
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Find colour charts; measure signal-to-noise, colour, tone, spatial frequency response, misregistration."""
    from levkas.core.ownership import require_free
    from levkas.quality.targets.charts import parse_corners
    from levkas.quality.targets.edges import parse_edges
    from levkas.stages.charts import measure_charts

    if output is not None:
        require_free(output, overwrite=overwrite)
    report = measure_charts(
        subject,
        kind=kind,
        cameras=cameras or (),
        corners=parse_corners(corners) if corners else None,
        reference=reference,
        objects=objects or (),
        edges=parse_edges(edges or ()),
    )
    if output is not None:
        from levkas.core.files import write_text

        write_text(output, report.page(subject.name))
    finish("chart", report, as_json)


@refusing("radiometry")
def radiometry(
    path: Annotated[
        Path,
        typer.Argument(help="Campaign: its folder, or campaign.toml."),
    ],
    cameras: Cameras = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="HTML page to write.")
    ] = None,
    overwrite: Overwrite = False,
    seed: Annotated[int, typer.Option(help="Seed of the intervals' bootstrap.", min=0)] = 1,
    as_json: Json = False,
) -> None:
    """Characterise the cameras: bits, codes, gain, noise, PRNU, full well, linearity, stability of the light.

    The command writes only the page of --output.
    """
    from levkas.core.ownership import require_free
    from levkas.quality.emva1288 import examine_with_seed

    if output is not None:
        require_free(output, overwrite=overwrite)
    found = examine_with_seed(path, cameras=cameras, seed=seed)
    written = None
    if output is not None:
        from levkas.pages.emva1288 import write_page

        written = str(write_page(found, output))
    if not as_json:
        typer.echo(found.text)
    print_report("radiometry", as_json, found.ok, found.problems, page=written, **found.to_dict())
    raise typer.Exit(0 if found.ok else 1)
