"""Progress on a terminal; the only drawing that the command line does."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any


def draw(steps: Iterable[Any]) -> list[Any]:
    """Consume `steps`, draw a bar with the time left, and return them.

    A step has `label`, `done`, `total`, `finished` and `line`; what was refused or failed stays on
    the screen above the bar.
    """
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
    seen = []
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("starting", total=None)
        for step in steps:
            seen.append(step)
            progress.update(
                task, description=step.label, completed=step.done, total=step.total or None
            )
            if step.finished and getattr(step, "state", "") in ("refused", "failed"):
                console.print(step.line, style="red", markup=False)
    return seen
