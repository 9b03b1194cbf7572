"""Options, progress, reports and refusals shared by all commands."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Protocol, cast

import typer

from levkas import __version__
from levkas.core.json_safe import plain
from levkas.core.problems import Problem, Refused

Json = Annotated[bool, typer.Option("--json", help="Report as one JSON object.")]
Overwrite = Annotated[
    bool,
    typer.Option("--overwrite", help="Replace a file that stands where this is to be written."),
]
DatabasePath = Annotated[
    Path | None,
    typer.Option("--output", "-o", help="Database folder, instead of the campaign's own."),
]
CampaignPath = Annotated[Path, typer.Argument(help="Folder of a campaign, or its campaign.toml.")]


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
    for problem in problems:
        typer.secho(f"{problem.code}: {problem}", err=True, fg=typer.colors.RED)


def finish(command: str, report: Report, as_json: bool) -> None:
    """Print a report and end with exit status 0, or 1 where something was refused or failed."""
    print_report(command, as_json, report.ok, report.problems, **report.to_dict())
    if not as_json:
        typer.echo(report.text)
    raise typer.Exit(0 if report.ok else 1)


def refusing(command: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Turn a refusal, exhausted memory or an interrupt into a report and an exit status."""

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        @wraps(function)
        def wrapped(*args: Any, **options: Any) -> None:
            as_json = bool(options.get("as_json"))
            try:
                function(*args, **options)
            except Refused as refused:
                print_report(command, as_json, False, refused.problems)
                raise typer.Exit(1) from None
            except MemoryError:
                print_report(command, as_json, False, [_out_of_memory()])
                raise typer.Exit(1) from None
            except KeyboardInterrupt:
                typer.secho("interrupted; run the same command to go on", err=True)
                raise typer.Exit(130) from None

        return wrapped

    return decorate


def _out_of_memory() -> Problem:
    from levkas.core.machine import MEMORY, memory_bound

    return Problem(
        "E_MEMORY",
        "memory ran out",
        found=f"{memory_bound() / 1e9:.1f} GB now free, or as {MEMORY} sets it",
        fix="Close other programs, use a machine with more memory, or cut or bin the frames.",
    )


def draw_steps(steps: Iterable[Any], quiet: bool) -> list[Any]:
    """Consume the steps of long work and return them; draw a bar on a terminal, print lines elsewhere.

    A step has `label`, `done`, `total`, `finished` and `line`; refused and failed ones stay on the
    screen above the bar.
    """
    if not quiet and sys.stderr.isatty():
        return _draw_bar(steps)
    done = []
    for step in steps:
        done.append(step)
        if not quiet and step.finished:
            typer.echo(_with_where(step, step.line), err=True)
    return done


def _draw_bar(steps: Iterable[Any]) -> list[Any]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}", style="bold"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    done = []
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("starting", total=None)
        for step in steps:
            done.append(step)
            label = _with_where(step, step.label)
            progress.update(task, description=label, completed=step.done, total=step.total or None)
            if step.finished and getattr(step, "state", "") in ("refused", "failed"):
                console.print(step.line, style="red", markup=False)
    return done


def _with_where(step: Any, text: str) -> str:
    """Say behind a step on how many workers it was done, where there are any."""
    where = getattr(step, "where", "")
    return f"{text} ({where})" if where else text
