"""Infer darks and whites, mosaics and the colour of objects from a few decoded frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from levkas.campaign.guess.groups import Frame, Group, sensor_of
from levkas.campaign.guess.pixels import (
    CLIPPED,
    MOST_SAMPLED,
    Mosaic,
    Samples,
    Statistics,
    find_mosaic,
    name_mosaic,
    spread,
)

DARK_SHARE = 0.08
"""A dark's 99th percentile is below this share of the brightest level that any target reaches."""
EVEN, SMOOTH = 0.6, 0.04
"""A white's illumination may fall off by this share; from sensel to sensel it hardly differs."""
MOST_TARGETS = 200
"""Targets of a camera, spread over all, of which a frame is decoded; more would take minutes."""
STRUCTURED = 3.0
"""The others must have this many times its texture."""


def tell_roles(group: Group, samples: Samples) -> list[str]:
    """Give targets of a camera the roles that their frames show, where no name says any.

    Parameters
    ----------
    group : Group
        Its frames are replaced.
    samples : Samples

    Returns
    -------
    told : list of str
        Each guess with its reason.
    """
    frames = group.of_role("object")
    plain = all(f.named.seen.channels == 1 or f.named.seen.facts.kind == "envi" for f in frames)
    by_target: dict[str, list[Frame]] = {}
    for frame in frames:
        by_target.setdefault(frame.target, []).append(frame)
    targets = list(by_target)
    if group.of_role("dark", "white") or not plain or len(targets) < 2:
        return []
    found: dict[str, Statistics] = {}
    for target in spread(targets, MOST_TARGETS):
        mine = _comparable(by_target[target], frames[0])
        told = samples.of_some([f.named.seen for f in mine], 1)
        if told:
            found[target] = told[0]
    roles, reasons = _judged(found)
    group.frames = [f.with_role(roles.get(f.target, f.role)) for f in group.frames]
    if len(targets) > MOST_TARGETS:
        reasons.append(
            f"whether darks or whites are among {len(targets) - MOST_TARGETS} of {len(targets)} targets whose "
            "names do not say so: their frames were not looked at"
        )
    return reasons


def _comparable(mine: list[Frame], first: Frame) -> list[Frame]:
    """Frames of a target by the sensor and in the band of the first frame of all."""
    like = [
        f
        for f in mine
        if sensor_of(f) == sensor_of(first) and f.number("wavelength") == first.number("wavelength")
    ]
    return like or mine


def _judged(found: dict[str, Statistics]) -> tuple[dict[str, str], list[str]]:
    roles: dict[str, str] = {}
    reasons: list[str] = []
    brightest = max((s.high for s in found.values()), default=0.0)
    for target, s in found.items():
        if s.high < DARK_SHARE * brightest:
            roles[target] = "dark"
            reasons.append(
                f"{target} is taken for a dark: 99 % of it are below {s.high:.4g} counts"
            )
    rest = {t: s for t, s in found.items() if t not in roles}
    for target, s in rest.items():
        others = [o.texture for t, o in rest.items() if t != target]
        even = s.unevenness < EVEN and s.texture < SMOOTH and s.mean > 0.3 * brightest
        if even and others and max(others) > STRUCTURED * max(s.texture, 1e-6):
            roles[target] = "white"
            reasons.append(f"{target} is taken for a white: bright ({s.mean:.4g} counts) and even")
    if len([t for t in found if t not in roles]) == 0:
        return {}, []  # nothing would be left to be an object
    return roles, reasons


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


WARM_NM, COLD_NM = 620.0, 460.0
NEAR_NM = 25.0


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
        places = [_nearest(facts.wavelengths, nm) for nm in (WARM_NM, COLD_NM)]
        if spectrum is None or None in places:
            return None
        return np.array([spectrum[int(p)] for p in places if p is not None])
    by_band: Mapping[float, list[Frame]] = _by_band(frames)
    centres = sorted(by_band)
    levels = []
    for nm in (WARM_NM, COLD_NM):
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
