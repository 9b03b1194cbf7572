"""Options, progress, reports and refusals shared by all commands."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol, cast

import typer

from levkas import __version__
from levkas.core.internal_errors import InternalError
from levkas.core.json_safe import plain
from levkas.core.problems import Problem, Refused
from levkas.core.progress import COMPILING, FRAMES
from levkas.core.text import counted, unusable_name, unusable_text

if TYPE_CHECKING:
    from rich.console import Console

Json = Annotated[bool, typer.Option("--json", help="Report as one JSON object.")]
Overwrite = Annotated[
    bool,
    typer.Option("--overwrite", help="Replace an existing file."),
]
DatabasePath = Annotated[
    Path | None,
    typer.Option("--output", "-o", help="Database folder, instead of the campaign's own."),
]
CampaignPath = Annotated[Path, typer.Argument(help="Folder of a campaign, or its campaign.toml.")]


def _names_in(ctx: Any, place: int) -> list[str]:
    """Return names of objects (0) or cameras (1) in the database that a command line already names, for completion."""
    from levkas.database.catalogue import database_of, read_catalogue

    for given in (*ctx.params.values(), *ctx.args):
        if isinstance(given, str | Path) and Path(given).exists():
            with suppress(Refused, OSError):
                entries = read_catalogue(database_of(given))
                return sorted({(entry.object, entry.camera)[place] for entry in entries})
    return []


def _objects_in(ctx: typer.Context) -> list[str]:
    return _names_in(ctx, 0)


def _cameras_in(ctx: typer.Context) -> list[str]:
    return _names_in(ctx, 1)


Objects = Annotated[
    list[str] | None,
    typer.Option("--object", help="Only this object; may be repeated.", autocompletion=_objects_in),
]
Cameras = Annotated[
    list[str] | None,
    typer.Option("--camera", help="Only this camera; may be repeated.", autocompletion=_cameras_in),
]


def path_or_address(text: str) -> Path:
    """Return a path; the address of a database on a server stays text."""
    return cast(Path, text) if "://" in text else Path(text)


class Report(Protocol):
    """The result of a library call that a command prints."""

    @property
    def ok(self) -> bool:
        """Nothing was refused or failed."""

    @property
    def problems(self) -> Iterable[Problem]:
        """Every refusal."""

    @property
    def text(self) -> str:
        """The report for people."""

    def to_dict(self) -> dict[str, Any]:
        """Return the report for programs."""


def print_report(
    command: str, as_json: bool, ok: bool, problems: Iterable[Problem], **more: Any
) -> None:
    """Print an object for programs, else the problems for people on standard error."""
    if as_json:
        record = {
            "levkas": __version__,
            "command": command,
            "ok": ok,
            "problems": [p.to_dict() for p in problems],
            **more,
        }
        typer.echo(json.dumps(plain(record), ensure_ascii=False, indent=2, allow_nan=False))
        return
    listed = list(problems)
    causes = [problem for problem in listed if problem.code != CONSEQUENCE]
    print_problems(causes or listed)


_shown: set[Problem] = set()
"""Problems that this command has printed; each is printed once."""


def print_problems(problems: Iterable[Problem]) -> None:
    """Print problems on standard error, what, where and what to do in a line each, unless they were printed."""
    fresh = [p for p in dict.fromkeys(problems) if p not in _shown]
    _shown.update(fresh)
    for problem in fresh:
        head, *rest = problem.lines
        typer.secho(head, err=True, fg=typer.colors.RED)
        for line in rest:
            typer.echo(line, err=True)


def finish(command: str, report: Report, as_json: bool) -> None:
    """Print a report and end with exit status 0, or 1 where something was refused or failed."""
    print_report(command, as_json, report.ok, report.problems, **report.to_dict())
    if not as_json and report.text:
        typer.echo(report.text)
    raise typer.Exit(0 if report.ok else 1)


def refusing(command: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Turn a refusal, one of the system, exhausted memory or an interrupt into a report and an exit status."""

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        @wraps(function)
        def wrapped(*args: Any, **options: Any) -> None:
            as_json = bool(options.get("as_json"))
            _shown.clear()
            try:
                _check_names([*args, *options.values()])
                function(*args, **options)
            except Refused as refused:
                print_report(command, as_json, False, refused.problems)
                if isinstance(refused, InternalError):
                    typer.echo(refused.report, err=True)
                raise typer.Exit(1) from None
            except OSError as error:
                print_report(command, as_json, False, [_refused_by_system(error)])
                raise typer.Exit(1) from None
            except MemoryError:
                print_report(command, as_json, False, [_out_of_memory()])
                raise typer.Exit(1) from None
            except KeyboardInterrupt:
                typer.secho("interrupted; run the same command to continue", err=True)
                raise typer.Exit(130) from None

        return wrapped

    return decorate


def _check_names(values: Iterable[Any]) -> None:
    """Refuse arguments that no file can bear as its path, and texts that no name or file can hold."""
    texts = [v for value in values for v in (value if isinstance(value, list) else [value])]
    wrong = {str(t): unusable_name(t) for t in texts if isinstance(t, Path)}
    wrong |= {t: unusable_text(t) for t in texts if isinstance(t, str)}
    fix = "Give another name."
    problems = [
        Problem("E_VALUE", f"the name is not usable: {why}", found=text, fix=fix)
        for text, why in wrong.items()
        if why
    ]
    if problems:
        raise Refused(*problems)


def _refused_by_system(error: OSError) -> Problem:
    """Return the problem of a file that the system does not give, and that nothing else has turned into a refusal."""
    names = [str(name) for name in (error.filename, error.filename2) if name is not None]
    why = error.strerror or str(error) or type(error).__name__
    fix = "Check the path, its permissions and its disk."
    return Problem("E_IO", f"the system refuses: {why}", " → ".join(names) or None, fix=fix)


def _out_of_memory() -> Problem:
    from levkas.core.machine import MEMORY, memory_bound

    return Problem(
        "E_MEMORY",
        "memory ran out",
        found=f"{memory_bound() / 1e9:.1f} GB now free, or as {MEMORY} sets it",
        fix="Close other programs, use a machine with more memory, or crop or bin the frames.",
    )


def draw_steps(steps: Iterable[Any], quiet: bool) -> list[Any]:
    """Consume the steps of long work and return them; draw a bar on a terminal, print lines elsewhere.

    A step has `label`, `done`, `total`, `finished` and `line`. Refusals are printed at once.
    """
    if not quiet and sys.stderr.isatty():
        from rich.console import Console

        return draw_bar(steps, Console(stderr=True))
    done = []
    for step in steps:
        done.append(step)
        if not quiet and step.finished:
            typer.echo(_plain_line(step), err=True)
            print_problems(_causes(step))
    return done


def _causes(step: Any) -> list[Problem]:
    """Return why a step was refused; what only follows from the refusal of its reference is no cause."""
    refused = getattr(step, "state", "") in ("refused", "failed")
    problems = step.problems if refused else ()
    return [problem for problem in problems if problem.code != CONSEQUENCE]


CONSEQUENCE = "E_NO_REFERENCE"


def _plain_line(step: Any) -> str:
    """Return the line of a step, without the reason that follows it."""
    return f"{step.label}: {step.state}" if _causes(step) else str(step.line)


def draw_bar(steps: Iterable[Any], console: Console) -> list[Any]:
    """Consume steps as `draw_steps` does and draw how far the work is on a terminal.

    What was fresh is no work: it is left out of both numbers. No time left is shown, for stages differ
    by a hundredfold; the time of the stage and of all, and the frames that were read, move meanwhile.
    Workers do several stages at a time: their frames are counted from the beginning.
    """
    from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
    from rich.table import Column
    from rich.text import Text

    class Within(ProgressColumn):
        """Time and frames of the stage, and time of all."""

        def render(self, task: Task) -> Text:
            frames = FRAMES.count - task.fields["frames"]
            since = task.fields["since"]
            within = [] if since is None else [_clock(time.monotonic() - since)]
            within += [counted(frames, "frame")] if frames else []
            within += ["compiling, once"] if COMPILING.count else []
            so_far = f"{_clock(task.elapsed or 0)} in all"
            return Text("; ".join([part for part in (", ".join(within), so_far) if part]))

    one_line = Column(no_wrap=True)
    count = TextColumn("{task.completed} of at most {task.fields[most]}", table_column=one_line)
    name = TextColumn("{task.description}", style="bold", table_column=one_line)
    columns = (name, BarColumn(10), count, Within(one_line))
    done, fresh = [], 0
    with Progress(*columns, console=console, transient=True) as progress:
        start: dict[str, Any] = {"since": time.monotonic(), "frames": FRAMES.count}
        task = progress.add_task("starting", total=None, most="?", **start)
        for step in steps:
            done.append(step)
            fresh += step.finished and getattr(step, "state", "") == "fresh"
            completed, total = step.done - fresh, max(step.total - fresh, 0)
            if not step.finished:
                start = {"since": time.monotonic(), "frames": FRAMES.count}
            progress.update(
                task,
                description=step.label,
                completed=completed,
                total=total or None,
                **start,
                most=total,
            )
            if causes := _causes(step):
                console.print(f"{step.label}: {step.state}", markup=False, highlight=False)
                for problem in causes:
                    print_above(console, problem)
    return done


def print_above(console: Console, problem: Problem) -> None:
    """Print a problem above the bar, once."""
    if problem not in _shown:
        _shown.add(problem)
        head, *rest = problem.lines
        console.print(head, style="red", markup=False, highlight=False, soft_wrap=True)
        for line in rest:
            console.print(line, markup=False, highlight=False, soft_wrap=True)


def _clock(seconds: float) -> str:
    """Return a duration as people read it.

    >>> _clock(7.4), _clock(3725)
    ('0:07', '1:02:05')
    """
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
