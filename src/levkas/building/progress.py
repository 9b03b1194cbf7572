"""What a build tells while it runs and when it has ended."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from levkas.building.build_records import Key
    from levkas.core.problems import Problem

FINISHED = ("fresh", "done", "refused", "failed", "stale")


@dataclass(frozen=True)
class Step:
    """One stage of one capture, as it begins (``state = "running"``) or as it has ended.

    `done` of `total` stages are behind us, this one counted where it has ended. The last step of a build
    has the database's folder as its `output`.
    """

    key: Key
    state: str
    why: str = ""
    done: int = 0
    total: int = 0
    problems: tuple[Problem, ...] = ()
    warnings: tuple[str, ...] = ()
    output: Path | None = None

    @property
    def finished(self) -> bool:
        """Whether the stage has ended, well or not."""
        return self.state in FINISHED

    @property
    def label(self) -> str:
        """The stage in a few words."""
        where = "/".join(part for part in (self.key.object, self.key.layer) if part)
        return f"{where} {self.key.stage}".strip()

    @property
    def line(self) -> str:
        """The stage and its state as one line of text."""
        told = f"{self.label}: {self.state}"
        return f"{told} ({self.why})" if self.why and self.state != "done" else told

    def to_dict(self) -> dict[str, str]:
        """Return the record of `build --json`."""
        return {**self.key.to_dict(), "state": self.state, "why": self.why}


@dataclass(frozen=True)
class BuildReport:
    """The end of a build: every stage with its state, and every problem."""

    output: Path | None
    stages: tuple[Step, ...]
    problems: list[Problem] = field(default_factory=list)
    warnings: tuple[str, ...] = ()
    graph: str = ""
    """Of `status`: the campaign's graph as a Mermaid flow chart."""

    @property
    def ok(self) -> bool:
        """Whether nothing was refused and nothing failed."""
        return not any(step.state in ("refused", "failed") for step in self.stages)

    @property
    def text(self) -> str:
        """What a person wants to know at the end."""
        states = [step.state for step in self.stages]
        told = [f"{states.count(s)} {s}" for s in FINISHED if s in states]
        lines = [f"warning: {warning}" for warning in _gathered(self.warnings)]
        lines += [step.line for step in self.stages if step.state in ("refused", "failed", "stale")]
        where = f": {self.output}" if self.output else ""
        lines.append(f"{', '.join(told) or 'nothing to do'}{where}")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields of `build --json` and `status --json`."""
        return {
            "output": str(self.output) if self.output else None,
            "stages": [step.to_dict() for step in self.stages],
            "warnings": list(self.warnings),
        }


def _gathered(warnings: Iterable[str]) -> list[str]:
    """Say once what several layers are warned of alike.

    >>> _gathered(["a/x: too dark", "a/y: too dark", "a/x: too soft"])
    ['a/x and 1 more: too dark', 'a/x: too soft']
    """
    layers: dict[str, list[str]] = {}
    for warning in warnings:
        layer, _, text = warning.partition(": ")
        layers.setdefault(text, []).append(layer)
    return [
        f"{names[0]}{f' and {len(names) - 1} more' if len(names) > 1 else ''}{': ' if text else ''}{text}"
        for text, names in layers.items()
    ]


def summarise(steps: Iterable[Step], output: Path | None = None) -> BuildReport:
    """Return the report of a build from its steps, problems and warnings each once."""
    ended = tuple(step for step in steps if step.finished)
    problems = list(dict.fromkeys(p for step in ended for p in step.problems))
    warnings = tuple(dict.fromkeys(w for step in ended for w in step.warnings))
    output = output or next((step.output for step in ended if step.output), None)
    return BuildReport(output, ended, problems, warnings)
