"""One sensor to be refined: its bands, what predicts them, and how they look through a map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.threads import each
from levkas.geometry.transforms import Composed, Transform
from levkas.registration.initial import Start
from levkas.registration.local_shifts import Windows
from levkas.registration.manual_points import Given
from levkas.registration.predictors import Scene, compared, sampled

if TYPE_CHECKING:
    from levkas.registration.images import BandImage

#: A grid shows most of a picture that is seen twice as finely as it is; it is judged where it is not.
FINE, PLAIN = 0.45, 0.9


@dataclass(frozen=True)
class Task:
    """One sensor to be refined.

    Parameters
    ----------
    bands : sequence of BandImage
        In the order of their wavelengths.
    images : mapping of label to ndarray
        As `images_of` gives them.
    scene : Scene
    within : ndarray of bool, reference px
        Where the object lies.
    found : Start
    given : Given
        Pairs by hand.
    """

    bands: Sequence[BandImage]
    images: Mapping[str, np.ndarray]
    scene: Scene
    within: np.ndarray
    found: Start
    given: Given

    @cached_property
    def scale(self) -> float:
        """Native px per reference px."""
        return _scale(self.found.transform, self.scene.shape)

    @property
    def finest(self) -> int:
        """Reference px per px of the finest grid on which to compare."""
        return max(1, round(FINE / self.scale))

    @property
    def plain(self) -> int:
        """Reference px per px of a grid that is about as fine as the picture."""
        return max(1, round(PLAIN / self.scale))

    def sampled(self, band: BandImage, transform: Transform, step: int) -> np.ndarray:
        """Return a band on the grid of `step` reference px; blocks of about one reference px."""
        size = (self.scene.shape[0] // step, self.scene.shape[1] // step)
        block = max(1, round(self.scale / 1.2))
        return sampled(self.images[band.label], transform, size, step, block=block)

    def look(
        self, bands: Sequence[BandImage], own: Sequence[Transform], base: Transform, step: int
    ) -> list[Windows]:
        """Return what windows of each band see."""
        predictor = self.scene.predictor(step)

        def seen(band: BandImage, before: Transform) -> Windows:
            return compared(predictor, self.sampled(band, Composed(before, base), step))

        return each(seen, bands, own)


def _scale(base: Transform, shape: tuple[int, int]) -> float:
    x, y = np.meshgrid(np.linspace(0.1, 0.9, 5) * shape[1], np.linspace(0.1, 0.9, 5) * shape[0])
    jacobian = base.jacobian(np.stack([x, y], -1).reshape(-1, 2))
    return float(np.sqrt(np.median(np.abs(np.linalg.det(jacobian)))))
