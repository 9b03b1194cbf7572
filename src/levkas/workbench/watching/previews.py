"""Registered previews of a session: its objects are built while it lasts, by the build itself, in a process of its own.

There is no second pipeline: what is shown are the layers of the database, and a later `levkas build` finds them done.
"""

from __future__ import annotations

import threading
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from multiprocessing import get_context
from typing import TYPE_CHECKING, Any

from levkas.building.claiming import places_of
from levkas.campaign.campaign import load_campaign
from levkas.core.problems import Refused

if TYPE_CHECKING:
    from multiprocessing.queues import SimpleQueue

    from levkas.building.tasks import ReferenceMemory
    from levkas.campaign.campaign import Campaign
    from levkas.workbench.watching.session import SessionState, WatchedSession

QUIET_S, INCOMPLETE_S = 2.0, 20.0
"""How long no frame of an object may have come before it is built; and one that lacks declared bands, sensors or shots."""
LOOK_S, NEWS_S = 0.25, 0.1
SHOWN = ("register", "resample")
"""Stages after which a layer is shown."""


def build_objects(
    folder: str, names: list[str], news: SimpleQueue[dict[str, Any]] | None = None
) -> tuple[list[dict[str, Any]], list[str]]:
    """Build the layers of some objects of a campaign; return them, and the problems as sentences.

    A layer is put into `news` when it is registered, with its picture on a coarse grid, and again when it is written. Pages and catalogue are left to `levkas build`: they take
    longer than a layer, and the next one would wait for them.
    """
    from levkas.building import summarise
    from levkas.building.layer_verdicts import layer_verdicts
    from levkas.building.run import build_layers

    news, layers, problems = news or _news, list[dict[str, Any]](), list[str]()
    for name in names:
        steps = []
        try:
            output = places_of(load_campaign(folder)).output
            for step in build_layers(folder, [name], _memory()):
                steps.append(step)
                if news is not None and step.finished and step.key.stage in SHOWN:
                    own = [s for s in steps if s.key.layer == step.key.layer]
                    picture = _memory().pictures.pop(step.key, None)
                    for layer in layer_verdicts(summarise(own, output)):
                        news.put({**layer, "picture": picture})
            report = summarise(steps, output)
        except Refused as refused:
            problems += [str(problem) for problem in refused.problems]
        else:
            layers += [one for one in layer_verdicts(report) if one["object"] == name]
            problems += [str(problem) for problem in report.problems]
    return layers, list(dict.fromkeys(problems))


@cache
def _memory() -> ReferenceMemory:
    """Return what this process holds from one build to the next."""
    from levkas.building.tasks import ReferenceMemory

    return ReferenceMemory()


_news: SimpleQueue[dict[str, Any]] | None = None
"""Of the process that builds: where its layers go."""


def _begin(news: SimpleQueue[dict[str, Any]]) -> None:
    """Load what a build needs before there is one: it takes longer than a small layer."""
    global _news
    _news = news
    for name in ("executor", "tasks"):
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
        self._coarse: dict[tuple[str, str, str], bytes] = {}
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
        if (coarse := self._coarse.get((name, camera, setup))) is not None:
            return coarse
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
                lacking = {item.object for item in state.missing}
                due = [n for n in due if quiet >= (INCOMPLETE_S if n in lacking else QUIET_S)]
                if not due:
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
            picture = layer.pop("picture", None)
            if picture is not None:
                self._coarse[key] = picture
            else:
                self._coarse.pop(key, None)
            self.layers[key] = {**layer, "built": self.version}
        self.version += 1
