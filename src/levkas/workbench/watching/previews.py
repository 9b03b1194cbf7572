"""Registered previews of a session: its objects are built while it lasts, by the build itself, in a process of its own.

There is no second pipeline: what is shown are the layers of the database, and a later `levkas build` finds them done.
"""

from __future__ import annotations

import threading
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from importlib import import_module
from multiprocessing import get_context
from typing import TYPE_CHECKING, Any

from levkas.building.claiming import places_of
from levkas.campaign.campaign import load_campaign
from levkas.core.problems import Refused

if TYPE_CHECKING:
    from multiprocessing.queues import SimpleQueue

    from levkas.campaign.campaign import Campaign
    from levkas.workbench.watching.session import SessionState, WatchedSession

QUIET_S = 3.0
"""How long no frame of an object may have come before it is built: frames of a stack come faster."""
LOOK_S, NEWS_S = 0.5, 0.1


def build_objects(
    folder: str, names: list[str], news: SimpleQueue[dict[str, Any]] | None = None
) -> tuple[list[dict[str, Any]], list[str]]:
    """Build some objects of a campaign; return its layers, and the problems as sentences.

    A layer is put into `news` as soon as it is written: pages and catalogue come after it.
    """
    from levkas.building import build, summarise
    from levkas.building.layer_verdicts import layer_verdicts

    news, steps = news or _news, []
    try:
        output = places_of(load_campaign(folder)).output
        for step in build(folder, objects=names, workers=0):
            steps.append(step)
            if news is not None and step.finished and step.key.stage == "resample":
                own = [s for s in steps if s.key.layer == step.key.layer]
                own = [s for s in own if s.key.object == step.key.object]
                for layer in layer_verdicts(summarise(own, output)):
                    news.put(layer)
        report = summarise(steps, output)
    except Refused as refused:
        return [], [str(problem) for problem in refused.problems]
    return layer_verdicts(report), [str(problem) for problem in report.problems]


_news: SimpleQueue[dict[str, Any]] | None = None
"""Of the process that builds: where its layers go."""


def _begin(news: SimpleQueue[dict[str, Any]]) -> None:
    """Load what a build needs before there is one: it takes longer than a small layer."""
    global _news
    _news = news
    for name in ("executor", "report_pages", "tasks"):
        import_module(f"levkas.building.{name}")
    for name in ("calibrate", "register", "resample"):
        import_module(f"levkas.stages.{name}")


def _wait() -> None:
    """Do nothing: what is asked first of a process starts it."""


def objects_to_build(campaign: Campaign, state: SessionState) -> dict[str, tuple[object, ...]]:
    """Return the objects that the reference camera has captured and of which no file is being written.

    Each has the files that it is built of: its own, and the darks and whites of all.
    """
    files: dict[str, list[object]] = {}
    shared: list[object] = []
    waiting = set()
    captured = set()
    for frame in state.frames:
        own = (frame.file.name, frame.at, frame.verdict)
        if frame.file.role != "object":
            shared.append(own)
            continue
        files.setdefault(frame.file.target, []).append(own)
        if frame.verdict == "waiting":
            waiting.add(frame.file.target)
        if frame.file.camera == campaign.reference.camera:
            captured.add(frame.file.target)
    ready = sorted((captured & files.keys()) - waiting)
    return {name: (tuple(files[name]), tuple(shared)) for name in ready}


@dataclass
class RegisteredPreviews:
    """Builds what is ready whenever the session pauses.

    Parameters
    ----------
    session : WatchedSession
        Of a campaign; what is only guessed is not built.
    """

    session: WatchedSession
    layers: dict[tuple[str, str, str], dict[str, Any]] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    version: int = 0
    state: SessionState | None = None

    def __post_init__(self) -> None:
        self._ended = threading.Event()
        self._built: dict[str, tuple[object, ...]] = {}
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Begin to build, in the background."""
        self._thread.start()

    def stop(self) -> None:
        """End after the build that runs."""
        self._ended.set()
        self._thread.join(timeout=60)

    def picture_of(self, name: str, camera: str, setup: str) -> bytes | None:
        """Return the preview of a layer, PNG on the grid; None where there is none."""
        campaign = self.session.campaign
        if campaign is None or (name, camera, setup) not in self.layers:
            return None
        path = places_of(campaign).layer(name, camera, setup, kind=".png")
        return path.read_bytes() if path.is_file() else None

    def to_dict(self) -> dict[str, Any]:
        """Return the layers, JSON-ready."""
        return {"layers": list(self.layers.values()), "build_problems": self.problems}

    def _run(self) -> None:
        known: object = None
        quiet = 0.0
        context = get_context("spawn")
        news: SimpleQueue[dict[str, Any]] = context.SimpleQueue()
        with ProcessPoolExecutor(1, context, initializer=_begin, initargs=(news,)) as pool:
            pool.submit(_wait)
            while not self._ended.wait(LOOK_S):
                campaign, state = self.session.campaign, self.state
                if campaign is None or state is None or state.guessed or state.away:
                    continue
                ready = objects_to_build(campaign, state)
                quiet = quiet + LOOK_S if ready == known else 0.0
                known = ready
                due = [name for name, files in ready.items() if self._built.get(name) != files]
                if not due or quiet < QUIET_S:
                    continue
                built = pool.submit(build_objects, str(self.session.watch.root), due)
                while not built.done() or not news.empty():
                    if news.empty():
                        time.sleep(NEWS_S)
                    else:
                        self._show(news.get())
                layers, self.problems = built.result()
                self._show(*layers)
                self._built |= {name: ready[name] for name in due}

    def _show(self, *layers: dict[str, Any]) -> None:
        for layer in layers:
            key = layer["object"], layer["camera"], layer.get("setup") or ""
            self.layers[key] = {**layer, "built": self.version}
        self.version += 1
