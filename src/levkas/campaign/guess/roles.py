"""Darks and whites among targets whose names do not say them, by their histograms."""

from __future__ import annotations

from levkas.campaign.guess.grouping import Frame, Group, sensor_of
from levkas.campaign.guess.pixels import Statistics
from levkas.campaign.guess.samples import Samples, spread

DARK_SHARE = 0.08
"""A dark's 99th percentile is below this share of the brightest level that any target reaches."""
EVEN, SMOOTH = 0.6, 0.04
"""A white's illumination may fall off by this share; from sensel to sensel it hardly differs."""
MOST_TARGETS = 200
"""Of a camera, over all, of which a frame is decoded; more would take minutes."""
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
