"""Tasks of a graph that wait for others, and which of those that wait for none a worker is given."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from levkas.building.graph import Graph, Task, captures_of

if TYPE_CHECKING:
    from levkas.building.build_records import Key


def hash_key(key: Key) -> Key:
    """Return the key under which a calibration waits for its frames to be hashed."""
    return replace(key, stage="hash")


class TaskQueue:
    """Tasks by what they wait for.

    Parameters
    ----------
    graph : Graph
    """

    def __init__(self, graph: Graph) -> None:
        self.open: set[Key] = set()
        """Tasks that have not ended."""
        self._places = {key: place for place, key in enumerate(graph)}
        self._ahead: dict[Key, set[Key]] = {}
        self._behind: dict[Key, list[Key]] = {}
        self._ready: dict[str, set[Key]] = {}
        """Of captures, by object."""
        self._last: dict[str, tuple[str, str]] = {}
        """The object and the layer that each worker has worked on last, and may hold."""

    @property
    def is_ready(self) -> bool:
        """Whether some task waits for a worker only."""
        return bool(self._ready)

    def lay(self, tasks: Sequence[Task]) -> Iterator[Key]:
        """Note what each task waits for; yield those that wait for none.

        That is what it reads, what comes before it of its capture and of its object's reference, and of a
        calibration `hash_key`. Where the reference is lost nothing else of its object is begun, as in
        one process.
        """
        self.open = {task.key for task in tasks}
        of_layer: dict[tuple[str, str], list[Key]] = {}
        for task in tasks:
            of_layer.setdefault((task.key.object, task.key.layer), []).append(task.key)
        for task in tasks:
            ahead = {key for key in (*task.needs, *task.uses) if key in self.open}
            for capture in captures_of(task) if task.capture is not None else ():
                mine = of_layer.get((capture.object, capture.layer), ())
                ahead |= {key for key in mine if self._places[key] < self._places[task.key]}
            if task.key.stage == "calibrate":
                ahead.add(hash_key(task.key))
            self._ahead[task.key] = set()
            for key in ahead:
                self.wait(task.key, key)
            if not ahead:
                yield task.key

    def wait(self, key: Key, before: Key) -> None:
        """Have a task wait for another."""
        self._ahead[key].add(before)
        self._behind.setdefault(before, []).append(key)

    def release(self, key: Key) -> list[Key]:
        """Note that a task has ended; return those that wait for none now."""
        self.open.discard(key)
        behind = self._behind.pop(key, ())
        for other in behind:
            self._ahead[other].discard(key)
        return [other for other in dict.fromkeys(behind) if not self._ahead[other]]

    def put(self, key: Key) -> None:
        """Have a task of a capture wait for a worker."""
        self._ready.setdefault(key.object, set()).add(key)

    def note(self, worker: str, key: Key) -> None:
        """Note what a worker works on."""
        self._last[worker] = key.object, key.layer

    def take(self, idle: Sequence[str], there: Sequence[str]) -> tuple[str, Key]:
        """Take out a task; return it behind the idle worker, "" for any, that holds most of what it reads.

        A worker goes on with the capture whose cubes it holds, then with the object whose reference it
        holds, then with an object that no worker `there` holds; after that it helps the others.
        """
        held = {self._last[worker][0] for worker in there if worker in self._last}
        free = next((name for name in self._ready if name not in held), None)
        found = []
        for worker in idle or [""]:
            name, layer = self._last.get(worker, ("", ""))
            mine = self._ready.get(name, set())
            if same := [key for key in mine if key.layer == layer]:
                found.append((0, worker, self._first(same)))
            elif mine:
                found.append((1, worker, self._first(mine)))
            elif free is not None:
                found.append((2, worker, self._first(self._ready[free])))
            else:
                found.append((3, worker, self._first(next(iter(self._ready.values())))))
        _, worker, key = min(found, key=lambda one: one[:2])
        self._ready[key.object].discard(key)
        if not self._ready[key.object]:
            del self._ready[key.object]
        return worker, key

    def _first(self, keys: set[Key] | list[Key]) -> Key:
        return min(keys, key=self._places.__getitem__)
