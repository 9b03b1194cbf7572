"""Registered previews of a session: its objects are built while it lasts, by the build itself, in a process of its own.

There is no second pipeline: what is shown are the layers of the database, and a later `levkas build` finds them done.
"""

from __future__ import annotations

import threading
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from typing import TYPE_CHECKING, Any

from levkas.building.claiming import places_of
from levkas.campaign.campaign import load_campaign
from levkas.core.problems import Refused

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.workbench.watching.session import SessionState, WatchedSession

QUIET_S = 3.0
"""How long no frame of an object may have come before it is built: frames of a stack come faster."""
LOOK_S = 0.5


def build_objects(folder: str, names: list[str]) -> tuple[list[dict[str, Any]], list[str]]:
    """Build some objects of a campaign; return its layers, and the problems as sentences."""
    from levkas.building import build, summarise
    from levkas.building.layer_verdicts import layer_verdicts

    try:
        output = places_of(load_campaign(folder)).output
        report = summarise(build(folder, objects=names, workers=0), output)
    except Refused as refused:
        return [], [str(problem) for problem in refused.problems]
    return layer_verdicts(report), [str(problem) for problem in report.problems]


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
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
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
                layers, self.problems = pool.submit(
                    build_objects, str(self.session.watch.root), due
                ).result()
                for layer in layers:
                    key = layer["object"], layer["camera"], layer.get("setup") or ""
                    self.layers[key] = {**layer, "built": self.version}
                self._built |= {name: ready[name] for name in due}
                self.version += 1
