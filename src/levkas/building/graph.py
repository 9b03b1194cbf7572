"""The graph of a campaign: tasks, what each of them reads, and their order; and the steps that a build reports.

Made without reading a pixel.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from levkas.building.build_records import CATALOGUE, STAGES, Key, key_of

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.core.problems import Problem


@dataclass(frozen=True)
class Task:
    """One stage of one capture, or the page of an object or a camera, or the catalogue.

    It reads the products of tasks that it `needs`, and is refused, or left out, where one of them is refused, and of those
    that it `uses` where they are not. Pages and the catalogue have no capture; `reference` is the capture that those of an
    object are registered to.
    """

    key: Key
    needs: tuple[Key, ...] = ()
    uses: tuple[Key, ...] = ()
    capture: Capture | None = None
    reference: Capture | None = None

    @property
    def leads(self) -> bool:
        """Whether it is of the capture that the others of its object are registered to."""
        return self.capture is self.reference


Graph = Mapping[Key, Task]
"""Tasks by their keys, each behind what it reads."""


def graph_of(
    campaign: Campaign, captures: Sequence[Capture], charts: Sequence[Capture] = ()
) -> Graph:
    """Return the tasks of a campaign in the order in which a build does them.

    Captures without a reference are left out. `charts` are measured for the page of their camera.
    """
    tasks: dict[Key, Task] = {}
    for name in dict.fromkeys(c.object for c in captures):
        mine = [c for c in captures if c.object == name]
        if not is_reference(campaign, mine[0]):
            continue
        # Most bands first, so that little is left at the end; the default lighting, which others are compared with, before them.
        order = [mine[0], *sorted(mine[1:], key=lambda c: (bool(c.setup), -len(c.bands)))]
        here = [task for capture in order for task in _tasks_of(capture, mine)]
        tasks |= {task.key: task for task in here}
        report = Key(name, stage="report")
        layers = tuple(task.key for task in here if task.key.stage == "resample")
        # Budgets hold the stray light that charts show on the pages of cameras.
        pages = tuple(dict.fromkeys(page_key(c.camera) for c in mine)) if charts else ()
        tasks[report] = Task(report, uses=(*layers, *pages))
    for camera in cameras_with_pages(campaign, captures, charts):
        calibrations = (key_of(c, "calibrate") for c in captures if c.camera == camera)
        key = page_key(camera)
        tasks[key] = Task(key, uses=tuple(k for k in calibrations if k in tasks))
    pages = tuple(key for key in tasks if key.stage in ("report", "camera"))
    tasks[CATALOGUE] = Task(CATALOGUE, uses=pages)
    # Pages of cameras wait for all captures: what reads them comes last, each capture stays in one go.
    first = [key for key in tasks if key.stage != "report" and key != CATALOGUE] if charts else []
    return {task.key: task for task in ordered(tasks, [*first, *tasks])}


def _tasks_of(capture: Capture, mine: Sequence[Capture]) -> Iterator[Task]:
    """Yield the tasks of one capture; `mine` are all of its object, the reference first."""
    (lead, *_), of = mine, (capture, mine[0])
    calibrated, registered, resampled = (key_of(capture, stage) for stage in STAGES)
    frame = () if capture is lead else (key_of(lead, "calibrate"), key_of(lead, "register"))
    yield Task(calibrated, (), (), *of)
    yield Task(registered, (calibrated, *frame), (), *of)
    drawn = () if capture is lead else (key_of(lead, "resample"),)
    alike = (c for c in mine[1:] if c.camera == capture.camera and not c.setup and capture.setup)
    compared = tuple(key_of(default, "resample") for default in alike)
    yield Task(resampled, (calibrated, registered, *frame, *drawn), compared, *of)


def ordered(tasks: Graph, wanted: Iterable[Key]) -> list[Task]:
    """Return tasks and all that they read, each once and behind what it reads."""
    done: dict[Key, Task] = {}
    waiting = [*wanted][::-1]
    while waiting:
        task = tasks.get(waiting[-1])
        ahead = (*task.needs, *task.uses)[::-1] if task and task.key not in done else ()
        if left := [before for before in ahead if before in tasks and before not in done]:
            waiting += left
            continue
        waiting.pop()
        if task:
            done[task.key] = task
    return list(done.values())


def captures_of(task: Task) -> tuple[Capture, Capture]:
    """Return what a task is done with, and what that is registered to; ValueError for pages."""
    if task.capture is None or task.reference is None:
        raise ValueError(f"{task.key} is not a task of a capture")
    return task.capture, task.reference


def page_key(camera: str) -> Key:
    """Return the key of the task that writes a camera's page."""
    return Key("", camera, stage="camera")


def is_reference(campaign: Campaign, capture: Capture) -> bool:
    """Return whether the other captures of its object are registered to this one."""
    return capture.camera == campaign.reference.camera and not capture.setup


def cameras_with_pages(
    campaign: Campaign, captures: Sequence[Capture], charts: Sequence[Capture]
) -> list[str]:
    """Return the cameras that have a page: those that are calibrated, or saw a chart."""
    used = {c.camera for c in captures if campaign.cameras[c.camera].traits.is_calibrated}
    used |= {c.camera for c in charts}
    return [name for name in campaign.cameras if name in used]


# --- steps: how tasks begin and end -------------------------------------------------------------

FINISHED = ("fresh", "done", "refused", "stale")


@dataclass(frozen=True)
class Step:
    """One stage of one capture, as it begins (``state = "running"``) or as it has ended.

    `done` of `total` stages are behind us, this one counted where it has ended, and `place` is the stage's
    in the graph. The last step of a build has the database's folder as its `output`.
    """

    key: Key
    state: str
    why: str = ""
    done: int = 0
    total: int = 0
    problems: tuple[Problem, ...] = ()
    warnings: tuple[str, ...] = ()
    output: Path | None = None
    place: int = 0
    earlier: str = ""
    """Of a refused stage: why its layer stays, which an earlier build finished."""

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
        label = f"{self.label}: {self.state}"
        return f"{label} ({self.why})" if self.why and self.state != "done" else label

    def to_dict(self) -> dict[str, str]:
        """Return the record of `build --json`."""
        earlier = {"earlier": self.earlier} if self.earlier else {}
        return {**self.key.to_dict(), "state": self.state, "why": self.why, **earlier}


@dataclass(frozen=True)
class BuildReport:
    """The end of a build: every stage with its state, and every problem."""

    output: Path | None
    stages: tuple[Step, ...]
    problems: list[Problem] = field(default_factory=list)
    warnings: tuple[str, ...] = ()
    layers: tuple[dict[str, Any], ...] = ()
    """Of `build --json`: verdict, errors and reasons of every layer."""

    @property
    def ok(self) -> bool:
        """Whether nothing was refused."""
        return all(step.state != "refused" for step in self.stages)

    @property
    def text(self) -> str:
        """What a person wants to know at the end."""
        states = Counter(step.state for step in self.stages)
        counts = [f"{states[s]} {s}" for s in FINISHED if states[s]]
        lines = [f"warning: {warning}" for warning in _gathered(self.warnings)]
        # What was refused is among the problems, where it is reported once.
        lines += [
            s.line
            for s in self.stages
            if s.state == "stale" or (s.state == "refused" and not s.problems)
        ]
        where = f": {self.output}" if self.output else ""
        lines.append(f"{', '.join(counts) or 'nothing to do'}{where}")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields of `build --json` and `status --json`."""
        return {
            "output": str(self.output) if self.output else None,
            "stages": [step.to_dict() for step in self.stages],
            "warnings": list(self.warnings),
            **({"layers": list(self.layers)} if self.layers else {}),
        }


def _gathered(warnings: Iterable[str]) -> list[str]:
    """Report once what several layers are warned of alike.

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
    """Return the report of a build from its steps in the graph's order, problems and warnings each once."""
    last = {step.key: step for step in steps if step.finished}
    ended = tuple(sorted(last.values(), key=lambda step: step.place))
    problems = list(dict.fromkeys(p for step in ended for p in step.problems))
    warnings = tuple(dict.fromkeys(w for step in ended for w in step.warnings))
    output = output or next((step.output for step in ended if step.output), None)
    return BuildReport(output, ended, problems, warnings)
