"""A few frames of a campaign, read once, and what their numbers tell."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from levkas.looking.pixels import Statistics, describe_pixels, is_same_scene
from levkas.problems import Refused

if TYPE_CHECKING:
    from levkas.looking.listing import Seen

MOST_SAMPLED = 6
"""Frames of one kind that are decoded."""
CLIPPED = 20
"""Samples at the highest code from which on it is taken for the sensor's end."""
LINES = 64
"""Of a cube: read from its middle."""


class Samples:
    """Statistics of frames by path, decoded when they are first asked for."""

    def __init__(self) -> None:
        self._known: dict[Path, Statistics | None] = {}

    def of(self, seen: Seen) -> Statistics | None:
        """Return the statistics of one frame; None where it cannot be decoded."""
        if seen.path not in self._known:
            try:
                self._known[seen.path] = describe_pixels(_plane(seen))
            except (Refused, ValueError):
                self._known[seen.path] = None
        return self._known[seen.path]

    def of_some(self, frames: Sequence[Seen], count: int) -> list[Statistics]:
        """Return the statistics of up to `count` frames, spread over all."""
        places = np.unique(np.linspace(0, len(frames) - 1, min(count, len(frames))).round())
        found = [self.of(frames[int(i)]) for i in places] if frames else []
        return [told for told in found if told is not None]

    def spectrum_of(self, seen: Seen) -> np.ndarray | None:
        """Return the mean level of each band of some lines of a cube, (bands,); None where it cannot be read."""
        from levkas.readers.envi import open_envi

        try:
            cube, lines = open_envi(seen.path), seen.facts.shape[0]
            start = max(0, lines // 2 - LINES // 2)
            block = cube.read_lines(start, min(lines, start + LINES))
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
        from levkas.readers.envi import open_envi

        cube, lines = open_envi(seen.path), seen.facts.shape[0]
        start = max(0, lines // 2 - LINES // 2)
        block = cube.read_lines(start, min(lines, start + LINES))
        return np.asarray(block[:, :, int(block.mean(axis=(0, 1), dtype=np.float64).argmax())])
    from levkas.readers.frames import read_frame

    values = read_frame(seen.path)
    return values if values.ndim == 2 else values[..., :3].mean(axis=2)
