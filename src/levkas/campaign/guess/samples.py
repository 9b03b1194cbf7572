"""A few frames of a campaign, read once, and what their numbers tell."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from levkas.campaign.guess.pixels import Statistics, describe_pixels, is_same_scene
from levkas.core.problems import Refused

if TYPE_CHECKING:
    from levkas.campaign.guess.listing import Seen

T = TypeVar("T")
MOST_SAMPLED = 6
"""Frames of one kind that are decoded."""
CLIPPED = 20
"""Samples at the highest code from which on it is taken for the sensor's end."""
LINES = 64
"""Of a cube: read from its middle, fewer where they would be more than `MOST_SEEN` values."""


def spread(things: Sequence[T], count: int) -> list[T]:
    """Return up to `count` of some things, evenly over all.

    >>> spread("abcdefg", 3)
    ['a', 'd', 'g']
    """
    places = np.linspace(0, len(things) - 1, min(count, len(things))).round()
    return [things[int(i)] for i in np.unique(places)] if things else []


class Samples:
    """Statistics of frames by path, decoded when they are first asked for."""

    def __init__(self) -> None:
        self._known: dict[Path, Statistics | None] = {}
        self.refused: dict[str, str] = {}

    def of(self, seen: Seen) -> Statistics | None:
        """Return the statistics of one frame; None where it cannot be decoded."""
        if seen.path not in self._known:
            try:
                self._known[seen.path] = describe_pixels(_plane(seen))
            except Refused as refused:
                self._known[seen.path] = None
                self.refused[seen.name] = str(refused.problems[0])
            except ValueError:
                self._known[seen.path] = None
        return self._known[seen.path]

    def of_some(self, frames: Sequence[Seen], count: int) -> list[Statistics]:
        """Return the statistics of up to `count` frames, spread over all."""
        found = [self.of(seen) for seen in spread(frames, count)]
        return [told for told in found if told is not None]

    def spectrum_of(self, seen: Seen) -> np.ndarray | None:
        """Return the mean level of each band of some lines of a cube, (bands,); None where it cannot be read."""
        try:
            block = _middle(seen)
        except (Refused, ValueError):
            return None
        return np.asarray(block.mean(axis=(0, 1), dtype=np.float64))

    def same_scene(self, one: Seen, other: Seen) -> bool | None:
        """Whether two frames show the same; None where that cannot be said."""
        a, b = self.of(one), self.of(other)
        return None if a is None or b is None else is_same_scene(a.thumbnail, b.thumbnail)


def _plane(seen: Seen) -> np.ndarray:
    """Read one plane: of a cube the brightest band of a few lines, of a photograph the mean."""
    if seen.facts.kind == "envi":
        block = _middle(seen)
        return np.asarray(block[:, :, int(block.mean(axis=(0, 1), dtype=np.float64).argmax())])
    from levkas.readers.frames import read_sample

    values = read_sample(seen.path)
    return values if values.ndim == 2 else values[..., :3].mean(axis=2, dtype=np.float32)


def _middle(seen: Seen) -> np.ndarray:
    """Read some lines of a cube, (lines, samples, bands)."""
    from levkas.readers.envi import open_envi
    from levkas.readers.facts import check_memory
    from levkas.readers.frames import MOST_SEEN

    cube = open_envi(seen.path)
    lines, samples, bands = cube.facts.shape
    count = max(1, min(LINES, MOST_SEEN // (samples * bands)))
    check_memory(seen.path, count * samples * bands, np.dtype(cube.layout).itemsize)
    start = max(0, lines // 2 - count // 2)
    return cube.read_lines(start, min(lines, start + count))
