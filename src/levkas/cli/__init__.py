"""The command line: parse, one library call, print."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable, Iterable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer

from levkas import __version__
from levkas.core.problems import Problem, Refused

app = typer.Typer(
    name="levkas",
    help="Raw captures of a painting to one calibrated, registered spectral image database.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Json = Annotated[bool, typer.Option("--json", help="Report as one JSON object.")]
Overwrite = Annotated[
    bool,
    typer.Option("--overwrite", help="Replace a file that stands where this is to be written."),
]
CampaignPath = Annotated[Path, typer.Argument(help="Folder of a campaign, or its campaign.toml.")]


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"levkas {__version__}")
        raise typer.Exit


@app.callback()
def _levkas(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Say the version.")
    ] = False,
) -> None:
    # Names of files need not be text; a report in JSON stays one, where "\\udcff" is an escape.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _report(command: str, as_json: bool, ok: bool, problems: list[Problem], **more: Any) -> None:
    """Print one report: an object for programs, else the problems for people."""
    if as_json:
        record = {
            "levkas": __version__,
            "command": command,
            "ok": ok,
            "problems": [p.to_dict() for p in problems],
            **more,
        }
        typer.echo(json.dumps(_finite(record), ensure_ascii=False, indent=2, allow_nan=False))
        return
    for problem in problems:
        typer.secho(f"{problem.code}: {problem}", err=True, fg=typer.colors.RED)


def _finite(value: Any) -> Any:
    """Replace what JSON has no word for by null."""
    if isinstance(value, dict):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float) and value - value != 0:
        return None
    return value


def _refusing(command: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Turn a refusal into a report and exit status 1."""

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        @wraps(function)
        def wrapped(*args: Any, **options: Any) -> None:
            try:
                function(*args, **options)
            except Refused as refused:
                _report(command, bool(options.get("as_json")), False, list(refused.problems))
                raise typer.Exit(1) from None
            except MemoryError:
                _report(command, bool(options.get("as_json")), False, [_memory_ran_out()])
                raise typer.Exit(1) from None
            except KeyboardInterrupt:
                typer.secho("interrupted; run the same command to go on", err=True)
                raise typer.Exit(130) from None

        return wrapped

    return decorate


def _memory_ran_out() -> Problem:
    from levkas.core.machine import MEMORY, memory_bound

    bound = memory_bound()
    return Problem(
        "E_MEMORY",
        "memory ran out",
        found=None if bound is None else f"{bound / 1e9:.1f} GB now free, or as {MEMORY} sets it",
        fix="Close other programs, use a machine with more memory, or cut or bin the frames.",
    )


def _drawn(steps: Iterable[Any], quiet: bool) -> list[Any]:
    """Consume the steps of long work; draw them on a terminal, tell them in lines elsewhere."""
    if quiet or not sys.stderr.isatty():
        done = []
        for step in steps:
            done.append(step)
            if not quiet and step.finished:
                typer.echo(step.line, err=True)
        return done
    from levkas.cli.progress_bar import draw

    return draw(steps)


@app.command()
@_refusing("look")
def look(
    folder: Annotated[Path, typer.Argument(help="Folder of raw frames.")],
    write: Annotated[
        bool,
        typer.Option("--write", help="Write campaign.toml into the folder, unless there is one."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Guess a commented campaign.toml from a folder of captures; show it before anything is written."""
    from levkas.campaign.guess import look as look_at
    from levkas.campaign.guess import write_campaign

    proposal = look_at(folder)
    if not as_json:
        typer.echo(proposal.text, nl=False)
    written = str(write_campaign(proposal)) if write else None
    _report("look", as_json, True, [], written=written, **proposal.to_report())
    if not as_json:
        more = f"Written: {written}" if written else "Nothing was written; --write does."
        typer.echo(f"{more} {len(proposal.unknown)} things are unknown.", err=True)


VERIFY = "Read every file anew, whatever its size, times and inode say."


@app.command()
@_refusing("build")
def build(
    campaign: CampaignPath,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Database folder, instead of the campaign's own."),
    ] = None,
    objects: Annotated[
        list[str] | None, typer.Option("--object", help="Build only this object; may be repeated.")
    ] = None,
    keep_removed: Annotated[
        bool,
        typer.Option(
            "--keep-removed",
            help="Leave in the database what the campaign no longer has, instead of moving it to OUTPUT.removed.",
        ),
    ] = False,
    verify: Annotated[bool, typer.Option("--verify", help=VERIFY)] = False,
    as_json: Json = False,
) -> None:
    """Build the database of a campaign from its raw frames."""
    from levkas.building import build as build_campaign
    from levkas.building import summarise

    steps = build_campaign(
        campaign, output=output, objects=objects, keep_removed=keep_removed, verify=verify
    )
    report = summarise(_drawn(steps, as_json))
    _report("build", as_json, report.ok, report.problems, **report.to_dict())
    if not as_json:
        typer.echo(report.text)
    raise typer.Exit(0 if report.ok else 1)


@app.command()
@_refusing("status")
def status(
    campaign: CampaignPath,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Database folder, instead of the campaign's own."),
    ] = None,
    verify: Annotated[bool, typer.Option("--verify", help=VERIFY)] = False,
    as_json: Json = False,
) -> None:
    """Say what of a database is stale, and why."""
    from levkas.building import status as status_of

    report = status_of(campaign, output=output, verify=verify)
    _report("status", as_json, report.ok, report.problems, **report.to_dict())
    if not as_json:
        typer.echo(report.text)
    raise typer.Exit(0 if report.ok else 1)


@app.command()
@_refusing("evaluate")
def evaluate(
    database: Annotated[
        Path, typer.Argument(help="Database folder, or the campaign it was built from.")
    ],
    truth: Annotated[
        Path | None,
        typer.Option(help="Folder `truth` of a simulated campaign; found beside a campaign."),
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option(
            help="Check points: CSV with object, camera, band, reference_x, reference_y, x, y, or a file of BigWarp, QGIS, Hugin, napari …"
        ),
    ] = None,
    frame: Annotated[
        str | None,
        typer.Option(help="OBJECT/CAMERA[@SETUP][:BAND] that a file of another program is of."),
    ] = None,
    maps: Annotated[
        Path | None, typer.Option(help="Folder for SSIM maps as PNG, one a layer.")
    ] = None,
    loops: Annotated[
        bool, typer.Option(help="Also register every two cameras to each other, and close loops.")
    ] = False,
    compared: Annotated[
        bool,
        typer.Option("--compare", help="Register every layer anew by several methods, in a table."),
    ] = False,
    methods: Annotated[
        list[str] | None,
        typer.Option("--method", help="Of --compare: only this method; may be repeated."),
    ] = None,
    objects: Annotated[
        list[str] | None,
        typer.Option("--object", help="Of --compare: only this object; may be repeated."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Of --compare: folder for page, JSON and SSIM maps."),
    ] = None,
    time_limit_s: Annotated[
        float | None,
        typer.Option("--time-limit", help="Of --compare: seconds for one method and layer.", min=1),
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Report the error of every band where truth or check points are, and SSIM.

    --compare sets Levkas beside the paper's method, the paper's opponents and today's peers.
    """
    from levkas.quality.evaluation.layer_report import assess, locate

    if compared:
        from levkas.quality.comparison import compare

        table = compare(
            database, methods=methods or (), truth=truth, output=output, time_limit_s=time_limit_s,
            points=points, frame=frame, objects=objects or (), overwrite=overwrite,
            draw=lambda rows: _drawn(rows, as_json),
        )  # fmt: skip
        _report("evaluate", as_json, True, list(table.problems), **table.to_dict())
        if not as_json:
            typer.echo(table.text)
        return

    report = assess(
        database, truth=truth, points=points, frame=frame, maps=maps, overwrite=overwrite
    )
    more, text = {}, report.text
    if loops:
        from levkas.quality.evaluation.loop_closure import close_database, tell

        more["loops"] = close_database(locate(database)[0])
        text = f"{text}\n\n{tell(more['loops'])}"
    _report("evaluate", as_json, True, report.problems, results=report.results, **more)
    if not as_json:
        typer.echo(text)


@app.command()
@_refusing("validate")
def validate(
    database: Annotated[
        Path, typer.Argument(help="Database folder, or one of the same kind by others.")
    ],
    threads: Annotated[
        int | None,
        typer.Option(help="Files hashed at a time; else as many as threads may work.", min=1),
    ] = None,
    as_json: Json = False,
) -> None:
    """Find every damage of a database and name the file."""
    from levkas.database.validate import validate as validate_database

    quiet = as_json or not sys.stderr.isatty()
    report = validate_database(database, threads=threads, draw=lambda steps: _drawn(steps, quiet))
    _report("validate", as_json, report.ok, list(report.problems), **report.to_dict())
    if not as_json:
        typer.echo(report.text)
    raise typer.Exit(0 if report.ok else 1)


@app.command()
@_refusing("chart")
def chart(
    subject: Annotated[
        Path,
        typer.Argument(help="A campaign that declares charts, a database, or a calibrated cube."),
    ],
    kind: Annotated[
        str, typer.Option(help="Of the chart in a cube: ColorChecker24 or ColorCheckerSG.")
    ] = "ColorChecker24",
    cameras: Annotated[
        list[str] | None, typer.Option("--camera", help="Only this camera; may be repeated.")
    ] = None,
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
    reference: Annotated[
        Path | None, typer.Option(help="CSV of the chart's spectra: wavelength, a column a patch.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Report page to write, HTML.")
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Find colour charts and measure signal-to-noise, blur, colour, tone and white balance."""
    from levkas.building.charts import measure_charts
    from levkas.core.ownership import require_free
    from levkas.quality.targets.charts import parse_corners

    if output is not None:
        require_free(output, overwrite=overwrite)
    report = measure_charts(
        subject,
        kind=kind,
        cameras=cameras or (),
        corners=parse_corners(corners) if corners else None,
        reference=reference,
        objects=objects or (),
    )
    if output is not None:
        from levkas.core.files import write_text

        write_text(output, report.page(subject.name))
    _report("chart", as_json, report.ok, report.problems, **report.to_dict())
    if not as_json:
        typer.echo(report.text)
    raise typer.Exit(0 if report.ok else 1)


@app.command(name="map")
@_refusing("map")
def map_points(
    database: Annotated[Path, typer.Argument(help="Database folder.")],
    name: Annotated[str, typer.Argument(metavar="OBJECT", help="Object in the database.")],
    points: Annotated[
        Path | None, typer.Argument(help="CSV with header x,y; standard input without it.")
    ] = None,
    source: Annotated[
        str, typer.Option("--from", help="Frame: grid, CAMERA, CAMERA@SETUP:BAND …")
    ] = "grid",
    target: Annotated[str, typer.Option("--to", help="Frame the points are wanted in.")] = "grid",
    output: Annotated[Path | None, typer.Option("-o", "--output", help="CSV to write.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Map points between any two pixel frames of an object."""
    from levkas.core.ownership import require_free
    from levkas.geometry.pixel_frames import map_table
    from levkas.readers.texts import read_stream, read_text

    if output is not None:
        require_free(output, overwrite=overwrite)
    wanted = "a CSV in UTF-8 with the header x,y"
    text = (
        read_text(points, wanted)
        if points
        else read_stream(sys.stdin.buffer, "standard input", wanted)
    )
    file = str(points) if points else None
    mapped = map_table(database, name, text, source=source, target=target, file=file)
    if output is None:
        typer.echo(mapped, nl=False)
        return
    from levkas.core.files import write_text

    write_text(output, mapped)


@app.command()
@_refusing("simulate")
def simulate(
    folder: Annotated[Path, typer.Argument(help="New folder for the simulated campaign.")],
    preset: Annotated[str, typer.Option(help="small, default, hard or full.")] = "default",
    scale: Annotated[
        float | None, typer.Option(help="1 is the paper's size; less shrinks it.")
    ] = None,
    objects: Annotated[int, typer.Option(help="Number of painted panels.", min=1)] = 1,
    seed: Annotated[int, typer.Option(help="Seed of everything random.", min=0)] = 1,
    setups: Annotated[bool, typer.Option(help="Also the 45-degree lighting.")] = False,
    as_json: Json = False,
) -> None:
    """Simulate a five-camera campaign with known truth."""
    from levkas.simulation import simulate_campaign

    steps = simulate_campaign(
        folder, preset=preset, scale=scale, objects=objects, seed=seed, setups=setups
    )
    _drawn(steps, as_json)
    _report("simulate", as_json, True, [], campaign=str(folder))
    if not as_json:
        typer.echo(f"Simulated {folder}. Build it: levkas build {folder}")


@app.command()
@_refusing("demo")
def demo(
    folder: Annotated[Path, typer.Argument(help="Folder for the demonstration.")] = Path("demo"),
    seed: Annotated[int, typer.Option(help="Seed of everything random.", min=0)] = 1,
    as_json: Json = False,
) -> None:
    """Simulate a small campaign, build it, compare it with the truth, say where to look."""
    from levkas.cli.demo import demonstrate

    report = demonstrate(folder, seed=seed, draw=lambda steps: _drawn(steps, as_json))
    _report("demo", as_json, report.ok, report.problems, results=report.results)
    if not as_json:
        typer.echo(report.text)
    raise typer.Exit(0 if report.ok else 1)


@app.command()
@_refusing("doctor")
def doctor(
    folder: Annotated[
        Path, typer.Argument(help="Where databases will stand: its disk is looked at.")
    ] = Path(),
    as_json: Json = False,
) -> None:
    """Say what this machine has and lacks: versions, libraries, memory, disk, threads."""
    from levkas.cli.doctor import examine

    report = examine(folder)
    _report("doctor", as_json, report.ok, list(report.problems), **report.to_dict())
    if not as_json:
        typer.echo(report.text)
    raise typer.Exit(0 if report.ok else 1)


from levkas.cli import inspect, publish, radiometry  # noqa: E402, F401  (they add their commands)
from levkas.cli.plan import plan_app  # noqa: E402  (it takes its options and reports from here)
from levkas.cli.points import points_app  # noqa: E402

app.add_typer(plan_app, name="plan")
app.add_typer(points_app, name="points")


def main() -> None:
    """Run the command line."""
    app()
