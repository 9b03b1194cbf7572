"""What is gathered of one sensor, and how its stacks are reduced to blocks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from levkas.calibration.blocks import Blocks, block_statistics
from levkas.calibration.code_spacing import Levels
from levkas.calibration.linearity import Linearity
from levkas.calibration.sensor_context import SensorContext, exposure_of
from levkas.calibration.templates import Template
from levkas.quality.emva1288.drift import Drift
from levkas.quality.emva1288.photon_transfer import Dark

if TYPE_CHECKING:
    from levkas.campaign.discovery.captures import FrameRef

Key = tuple[str | None, float | None]
"""Band and exposure, s."""


@dataclass
class Sensor:
    """What was gathered of one sensor.

    Parameters
    ----------
    darks : dict of list of Dark
        By channel.
    whites, scenes : dict of list of Blocks
        By channel.
    light : list of (name, Drift)
        Of every stack of two shots or more.
    linearity : list of (name, Linearity)
        Of objects that were taken at several exposures.
    reached : bool
        Whether any shot saturates.
    """

    camera: str
    name: str
    bench: SensorContext
    levels: Levels = field(default_factory=lambda: Levels(0, 0, 0))
    darks: dict[str, list[Dark]] = field(default_factory=dict)
    whites: dict[str, list[Blocks]] = field(default_factory=dict)
    scenes: dict[str, list[Blocks]] = field(default_factory=dict)
    light: list[tuple[str, Drift]] = field(default_factory=list)
    linearity: list[tuple[str, Linearity]] = field(default_factory=list)
    reached: bool = False
    notes: list[str] = field(default_factory=list)


def by_exposure(frames: Iterable[FrameRef]) -> dict[Key, list[FrameRef]]:
    """Group shots of one band and exposure; a dark without a band serves all."""
    found: dict[Key, list[FrameRef]] = {}
    for frame in frames:
        found.setdefault((frame.band, exposure_of(frame)), []).append(frame)
    return dict(sorted(found.items(), key=lambda item: (item[0][0] or "", item[0][1] or 0.0)))


def reduce_stack(
    stack: Template, bench: SensorContext, drift: Drift | None = None, *, dark: bool = False
) -> dict[str, Blocks]:
    """Reduce a stack by the camera's channels; a tunable filter has one, whatever the mosaic.

    Some zeros do not spoil a dark: the share of them was looked at before.
    """
    pattern = bench.sensor.pattern
    if stack.mean.ndim == 3:
        stack = _flat_bands(stack)
    level = bench.black or 0.0
    found = block_statistics(stack, pattern, drift=drift, dark=level, clipped=dark)
    if pattern is not None and bench.camera.kind == "bands":
        parts = list(found.values())
        mean, temporal, spatial = (
            np.concatenate([getattr(b, n) for b in parts]) for n in ("mean", "temporal", "spatial")
        )
        return {"": Blocks(mean, temporal, spatial, stack.count, stack.exposure_s)}
    return found


def _flat_bands(stack: Template) -> Template:
    """Lay the samples of a pixel side by side: each is a sensel of its own."""
    high = stack.mean.shape[0]

    def flat(array: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(array.transpose(0, 2, 1)).reshape(high, -1)

    variance = None if stack.variance is None else flat(stack.variance)
    marks = flat(stack.saturated), flat(stack.black)
    return Template(flat(stack.mean), variance, stack.count, *marks, stack.exposure_s)
