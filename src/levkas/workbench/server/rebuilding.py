"""Rebuilding from the screen: one build at a time, in a thread."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from levkas.workbench.library import Library


class Busy(Refused):
    """Another build runs."""


@dataclass
class Rebuild:
    """The build that runs, or the last one that ran.

    Parameters
    ----------
    library : Library
    """

    library: Library
    state: str = "idle"
    line: str = ""
    problems: list[dict[str, Any]] = field(default_factory=list)
    done: int = 0
    total: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def start(self, key: str) -> None:
        """Build the object of a camera.

        Raises
        ------
        Busy
            While another build runs.
        FrameMissing
            Where there is no such camera.
        """
        frame = self.library.open(key)
        with self._lock:
            if self.state == "running":
                raise Busy(Problem("E_BUSY", "a build is running", found=self.line))
            self.state, self.line, self.problems = "running", "starting", []
        name = frame.capture.object
        threading.Thread(target=self._run, args=(key, name), daemon=True).start()

    def _run(self, key: str, name: str) -> None:
        from levkas.building import build, summarise

        steps = []
        try:
            library = self.library
            for step in build(library.path, output=library.output, objects=[name]):
                steps.append(step)
                self.line, self.done, self.total = step.label, step.done, step.total
            report = summarise(steps)
            self.problems = [p.to_dict() for p in report.problems]
            library.reopen(key)
            self.state = "done"
        except Refused as refused:
            self.problems = [p.to_dict() for p in refused.problems]
            self.state = "failed"
        except Exception as error:
            # A thread that dies in silence would leave the screen waiting for ever.
            self.problems = [Problem("E_FAILED", f"the build failed: {error}").to_dict()]
            self.state = "failed"
            raise

    def to_dict(self) -> dict[str, Any]:
        """Return what the screen shows, JSON-ready."""
        return {
            "state": self.state,
            "line": self.line,
            "done": self.done,
            "total": self.total,
            "problems": self.problems,
        }
