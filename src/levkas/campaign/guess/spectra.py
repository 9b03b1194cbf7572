"""What cameras with known wavelengths tell of the colour of objects, to tell red from blue in others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from levkas.campaign.guess.grouping import Frame, Group
from levkas.campaign.guess.samples import Samples, spread

LONG_NM, SHORT_NM = 620.0, 460.0
NEAR_NM = 25.0
MOST_TARGETS = 200
"""Of a camera, over all, whose colour is looked at."""


def find_warmth(groups: Sequence[Group], samples: Samples) -> dict[str, float]:
    """Return the warmth of every object that a camera with known wavelengths saw.

    Parameters
    ----------
    groups : sequence of Group
    samples : Samples

    Returns
    -------
    warmth : dict
        Object → logarithm of its mean reflectance at 620 nm over that at 460 nm.
    """
    warmth: dict[str, float] = {}
    for group in groups:
        by_target: dict[str, list[Frame]] = {}
        for frame in group.frames:
            by_target.setdefault(frame.target, []).append(frame)
        templates = {f.target for f in group.of_role("dark", "white")}
        asked = {*templates, *spread(list(by_target), MOST_TARGETS)}
        levels = {
            target: found
            for target, frames in by_target.items()
            if target in asked and (found := _two_levels(frames, samples)) is not None
        }
        roles = {f.target: f.role for f in group.frames}
        whites = [v for t, v in levels.items() if roles[t] == "white"]
        darks = [v for t, v in levels.items() if roles[t] == "dark"]
        if not whites:
            continue
        dark = darks[0] if darks else np.zeros(2)
        for target, level in levels.items():
            share = (level - dark) / np.maximum(whites[0] - dark, 1e-9)
            if roles[target] == "object" and share.min() > 0:
                warmth.setdefault(target, float(np.log(share[0] / share[1])))
    return warmth


def _two_levels(frames: Sequence[Frame], samples: Samples) -> np.ndarray | None:
    """Mean levels of a target near 620 and near 460 nm, (2,), by its frames."""
    facts = frames[0].named.seen.facts
    if facts.kind == "envi" and facts.wavelengths:
        spectrum = samples.spectrum_of(frames[0].named.seen)
        places = [_nearest(facts.wavelengths, nm) for nm in (LONG_NM, SHORT_NM)]
        if spectrum is None or None in places:
            return None
        return np.array([spectrum[int(p)] for p in places if p is not None])
    by_band: Mapping[float, list[Frame]] = _by_band(frames)
    centres = sorted(by_band)
    levels = []
    for nm in (LONG_NM, SHORT_NM):
        place = _nearest(centres, nm)
        found = samples.of(by_band[centres[place]][0].named.seen) if place is not None else None
        if found is None:
            return None
        levels.append(found.mean)
    return np.array(levels)


def _by_band(frames: Sequence[Frame]) -> dict[float, list[Frame]]:
    bands: dict[float, list[Frame]] = {}
    for frame in frames:
        if (number := frame.number("wavelength")) is not None:
            bands.setdefault(float(number), []).append(frame)
    return bands


def _nearest(centres: Sequence[float], nm: float) -> int | None:
    place = min(range(len(centres)), key=lambda i: abs(centres[i] - nm), default=None)
    return place if place is not None and abs(centres[place] - nm) <= NEAR_NM else None
