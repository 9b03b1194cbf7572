"""Mosaics found in a few frames of a camera: how large the tile is, and what its phases see."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from levkas.campaign.guess.grouping import Frame, Group
from levkas.campaign.guess.mosaics import Mosaic, name_mosaic
from levkas.campaign.guess.pixels import Statistics, find_mosaic
from levkas.campaign.guess.samples import CLIPPED, MOST_SAMPLED, Samples


def _levels(frames: Sequence[Frame], samples: Samples) -> tuple[Statistics | None, float]:
    """Return a bright frame, a white or else an object, and the level without light."""
    dark = samples.of_some([f.named.seen for f in frames if f.role == "dark"], 1)
    for role in ("white", "object"):
        found = samples.of_some([f.named.seen for f in frames if f.role == role], 3)
        usable = [s for s in found if s.high < 0.98 * s.top or s.top_count < CLIPPED] or found
        if usable:
            return max(usable, key=lambda s: s.mean), dark[0].mean if dark else 0.0
    return None, 0.0


def tile_side(frames: Sequence[Frame], samples: Samples) -> int:
    """Return the side of the mosaic's tile; 0 where no mosaic is seen."""
    bright, dark = _levels(frames, samples)
    return find_mosaic(bright.phases, dark=dark) if bright is not None else 0


def mosaic_of(
    frames: Sequence[Frame], samples: Samples, warmth: Mapping[str, float]
) -> Mosaic | None:
    """Return the mosaic that frames of one sensor show, its channels named; None for none."""
    bright, dark = _levels(frames, samples)
    if bright is None or not (side := find_mosaic(bright.phases, dark=dark)):
        return None
    shown: dict[str, np.ndarray] = {}
    if any(f.role == "white" for f in frames):
        for frame in (f for f in frames if f.role == "object"):
            if frame.target not in shown and len(shown) < MOST_SAMPLED:
                told = samples.of(frame.named.seen)
                shown |= {frame.target: told.phases[side]} if told else {}
    return name_mosaic(side, bright.phases[side], dark=dark, shown=shown, warmth=warmth)


MOST_BANDS = 64
"""Of a tunable filter, over its range, whose frames are decoded to see the mosaic behind it."""


def mosaic_behind_filters(group: Group, samples: Samples) -> Mosaic | None:
    """Return the mosaic behind narrow filters, whose phases differ in other ways in every band; None for none."""
    by_band: dict[float, list[Frame]] = {}
    for frame in group.of_role("white") or group.of_role("object"):
        if (number := frame.number("wavelength")) is not None:
            by_band.setdefault(float(number), []).append(frame)
    narrow: dict[float, Statistics] = {}
    places = np.linspace(0, len(by_band) - 1, min(MOST_BANDS, len(by_band))).round()
    for wavelength in np.array(list(by_band))[np.unique(places).astype(int)].tolist():
        frames = by_band[wavelength]
        found = samples.of_some([f.named.seen for f in frames], MOST_SAMPLED)
        usable = [s for s in found if s.high < 0.98 * s.top] or found
        if usable:
            narrow[wavelength] = max(usable, key=lambda s: s.mean)
    _, dark = _levels(group.frames, samples)
    sides = Counter(find_mosaic(s.phases, dark=dark) for s in narrow.values())
    side, times = sides.most_common(1)[0] if sides else (0, 0)
    if not side or (times < 2 and len(narrow) > 1):
        return None
    brightest = max(narrow.values(), key=lambda s: s.mean)
    phases = {nm: s.phases[side] for nm, s in narrow.items()}
    return name_mosaic(side, brightest.phases[side], dark=dark, narrow=phases)
