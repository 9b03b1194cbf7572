"""What is to be captured, or captured again, before the object leaves: by campaign.toml, and by what is there."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from levkas.campaign.discovery.patterns import natural
from levkas.campaign.schema.tables import Range
from levkas.core.text import counted
from levkas.quality.frame_checks.light_checks import SAME_TIME

if TYPE_CHECKING:
    from levkas.campaign.campaign import Camera, Campaign
    from levkas.workbench.watching.files import FrameState

MOST_NAMED = 6
NEAREST_NM = 0.5


@dataclass(frozen=True)
class Missing:
    """One thing to do.

    Parameters
    ----------
    kind : {"again", "capture", "dark", "white", "chart"}
    what : str
        What to capture, in a few words.
    why : str
    object : str
        That has frames, and lacks some of a camera.
    """

    kind: str
    what: str
    why: str
    object: str = ""


def find_missing(
    campaign: Campaign, frames: Sequence[FrameState], cameras: Sequence[str] = ()
) -> list[Missing]:
    """Return what is missing of a session, what is to be captured again first.

    Parameters
    ----------
    campaign : Campaign
    frames : sequence of FrameState
    cameras : sequence of str
        Of a setup file, which the session is to have as well.
    """
    again = [
        Missing("again", f.what, f"{f.file.name}: {f.findings[0].text}")
        for f in frames
        if f.verdict == "stop" and f.findings
    ]
    found = [
        Missing("capture", f"camera {c}", "the plan has it, no frame is there") for c in cameras
    ]
    by_layer: dict[tuple[str, str], list[FrameState]] = defaultdict(list)
    for frame in frames:
        by_layer[frame.file.camera, frame.file.setup].append(frame)
    for name, camera in campaign.cameras.items():
        setups = [
            "",
            *(
                s
                for s, keys in campaign.setups.items()
                if name in keys.cameras and s != campaign.campaign.setup
            ),
        ]
        for setup in setups:
            own = by_layer.get((name, setup), [])
            default = by_layer.get((name, ""), [])
            found += _of_layer(campaign, camera, setup, own, default)
    return [*again, *found]


def _of_layer(
    campaign: Campaign,
    camera: Camera,
    setup: str,
    frames: Sequence[FrameState],
    default: Sequence[FrameState],
) -> Iterator[Missing]:
    """Yield what one camera lacks under one setup."""
    who = camera.name + (f"@{setup}" if setup else "")
    objects = [f for f in frames if f.file.role == "object"]
    whites = [f for f in frames if f.file.role == "white"]
    darks = [f for f in (*frames, *default) if f.file.role == "dark"]
    yield from _captures(campaign, camera, who, setup, objects)
    if not camera.traits.is_calibrated:
        return
    if campaign.darks_of(camera) and not darks:
        yield Missing("dark", f"{who}: dark", "campaign.toml declares it, none is there")
    yield from _dark_times(who, [*objects, *whites], darks)
    if campaign.whites_of(camera):
        yield from _whites(who, objects, whites)
    charts = {f.file.target for f in frames if f.file.role == "chart"}
    for chart in campaign.targets.charts:
        if not setup and objects and chart not in charts:
            yield Missing("chart", f"{who}: {chart}", "campaign.toml declares this chart")


def _captures(
    campaign: Campaign, camera: Camera, who: str, setup: str, objects: Sequence[FrameState]
) -> Iterator[Missing]:
    """Yield objects without frames, bands that an object lacks, and shots that a band lacks."""
    by_object: dict[str, list[FrameState]] = defaultdict(list)
    for frame in objects:
        by_object[frame.file.target].append(frame)
    for name in campaign.targets.objects or ():
        if name not in by_object:
            yield Missing("capture", f"{who}: {name}", "no frame of it is there")
    if not objects and not campaign.targets.objects:
        yield Missing("capture", who, "campaign.toml declares it, no frame of an object is there")
    bands = {f.file.band for f in objects} - {""}
    if camera.traits.bands_in == "files" and camera.wavelengths is not None:
        bands = _declared(camera, bands)
    sensors = {s.name for s in camera.sensors}
    for name, frames in sorted(by_object.items(), key=lambda item: natural(item[0])):
        have = {f.file.band for f in frames}
        if lost := sorted(bands - have, key=natural):
            yield Missing(
                "capture", f"{who}: {name}, {_listed(lost)}", "other bands are there", name
            )
        if lost := sorted(sensors - {f.file.sensor for f in frames}, key=natural):
            yield Missing(
                "capture", f"{who}: {name}, {_listed(lost)}", "other sensors are there", name
            )
        yield from _shots(who, name, frames)


def _declared(camera: Camera, bands: set[str]) -> set[str]:
    """Return the bands of the declared wavelengths, by the labels that files have where they have them."""
    given = camera.wavelengths
    values = given.values() if isinstance(given, Range) else given or ()
    labels = {}
    for band in bands:
        number = band.removesuffix(" nm")
        try:
            labels[float(number)] = band
        except ValueError:
            continue
    found = set()
    for value in values:
        near = [band for at, band in labels.items() if abs(at - value) <= NEAREST_NM]
        found.add(near[0] if near else f"{value:g} nm")
    return found


def _shots(who: str, name: str, frames: Sequence[FrameState]) -> Iterator[Missing]:
    """Yield stacks that have fewer shots than most of this object have."""
    counts = Counter((f.file.tile, f.file.band, f.file.sensor, f.exposure_s) for f in frames)
    if len(counts) < 3:
        return
    usual = Counter(counts.values()).most_common(1)[0][0]
    for (tile, band, sensor, _), count in counts.items():
        if count < usual:
            where = " ".join(part for part in (name, tile, sensor, band) if part)
            why = f"{counted(count, 'shot')} of {usual}"
            yield Missing("capture", f"{who}: {where}", why, name)


def _dark_times(
    who: str, lit: Sequence[FrameState], darks: Sequence[FrameState]
) -> Iterator[Missing]:
    times = sorted({f.exposure_s for f in darks if f.exposure_s})
    wanted = sorted({f.exposure_s for f in lit if f.exposure_s})
    for seconds in wanted if times else ():
        if not any(max(seconds, t) <= SAME_TIME * min(seconds, t) for t in times):
            yield Missing(
                "dark", f"{who}: dark of {seconds:g} s", "frames of this exposure are there"
            )


def _whites(
    who: str, objects: Sequence[FrameState], whites: Sequence[FrameState]
) -> Iterator[Missing]:
    """Yield bands without a white, and whites before and after the object that are not there."""
    if not whites:
        yield Missing("white", f"{who}: white", "campaign.toml declares it, none is there")
        return
    have = {f.file.band for f in whites}
    lost = sorted({f.file.band for f in objects} - have - {""}, key=natural)
    if lost and "" not in have:
        yield Missing("white", f"{who}: white of {_listed(lost)}", "the object has these bands")
    if not objects:
        return
    if not any(f.at <= min(o.at for o in objects) for f in whites):
        yield Missing("white", f"{who}: white before the object", "drift of the lamp is unknown")
    if not any(f.at >= max(o.at for o in objects) for f in whites):
        yield Missing("white", f"{who}: white after the object", "drift of the lamp is unknown")


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return ", ".join(names[:MOST_NAMED]) + more
