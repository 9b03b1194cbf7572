"""Darks and whites of one capture: its object's own before those of all, and of several the nearest in time."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.campaign.discovery.captures import CaptureRefused, FrameRef
from levkas.campaign.discovery.file_index import in_natural_order, patterns_of
from levkas.campaign.discovery.patterns import natural
from levkas.core.problems import Problem, Refused, closest_match
from levkas.core.text import counted

if TYPE_CHECKING:
    from levkas.campaign.campaign import Camera
    from levkas.campaign.discovery.file_index import FileIndex, FoundFile
    from levkas.core.cube import Band

STACK_S = 120.0
"""Frames of a dark or white taken within this time are shots of one, whatever was captured between them. Of half a
minute or of ten nothing changes but for lamps that are not warm yet."""
_DATE = re.compile(r"(?<!\d)((?:19|20)\d\d)[-_.]?([01]\d)[-_.]?([0-3]\d)(?![\d.])")
_TIME = re.compile(
    _DATE.pattern.removesuffix(r"(?![\d.])")
    + r"[-_.T ]?([0-2]\d)[-_.:h]?([0-5]\d)[-_.:m]?([0-5]\d)(?!\d)"
)


class Templates:
    """Darks, whites and chart frames of one object by one sensor of a camera under a setup.

    Parameters
    ----------
    index : FileIndex
    camera : Camera
    sensor, setup : str
    shown : list of FoundFile
        The object's own frames.

    Attributes
    ----------
    remarks : list of str
        Why these frames were taken, where others could have been.
    """

    def __init__(
        self, index: FileIndex, camera: Camera, sensor: str, setup: str, shown: list[FoundFile]
    ) -> None:
        self.index, self.camera, self.sensor, self.setup = index, camera, sensor, setup
        self.shown, self.name = shown, shown[0].target
        self.remarks: list[str] = []

    def of(self, kind: str, names: Sequence[str], setups: Sequence[str]) -> list[FoundFile]:
        """Return the frames of a dark, white or chart by its names: of the first setup that has any."""
        for setup in setups:
            for serving in (self.name, ""):
                if groups := self._by_band(kind, names, setup, serving):
                    if not serving and (others := self._served(names, setup)):
                        self.remarks.append(
                            f"no {kind} of {self.name} alone was found, as there is of "
                            f"{', '.join(others)}: the {kind} that serves all is used"
                        )
                    return self._nearest(kind, groups)
        return []

    def missing(self, kind: str, names: Sequence[str]) -> Problem:
        """Return the problem of a declared dark or white that is not there."""
        index, camera = self.index, self.camera
        own = getattr(camera, kind) is not None
        frames = [f for f in index.frames[camera.name, self.setup] if f.sensor == self.sensor]
        known = sorted({f.target for f in frames}, key=natural)
        served = self._served(names, self.setup)
        lost = [name for name in served if not index.of(name, camera.name, self.setup)]
        patterns = dict.fromkeys(
            p.with_value("object", self.name).text
            for p in patterns_of(index, camera.name, self.setup)
        )
        under = f" under {self.setup}" if self.setup else ""
        return Problem(
            "E_TEMPLATE_MISSING",
            f"{' '.join(filter(None, (camera.name, self.sensor)))}{under}: the declared {kind} was not found",
            str(index.campaign.path),
            f"cameras.{camera.name}.{kind}" if own else f"targets.{kind}",
            f"{kind} of {', '.join(served)}" if served else ", ".join(known) or "no file",
            f"{{target}} = {' or '.join(names)} in {' or '.join(patterns)}",
            (closest_match(self.name, lost) if served else near_names(names, known))
            or "Add the frames.",
        )

    def _by_band(
        self, kind: str, names: Sequence[str], setup: str, serving: str
    ) -> list[list[FoundFile]]:
        """Return the frames of each band, of darks also of each exposure: the same for all whom they serve."""
        key = kind, tuple(names), self.camera.name, self.sensor, setup, serving
        if key not in self.index.templates:
            groups: dict[object, list[FoundFile]] = {}
            for file in self._frames(names, setup, serving):
                time = self._exposure(file) if kind == "dark" else None
                groups.setdefault((file.wavelength, file.band, time), []).append(file)
            self.index.templates[key] = list(groups.values())
        return self.index.templates[key]

    def _frames(self, names: Iterable[str], setup: str, serving: str) -> list[FoundFile]:
        files = [
            f
            for name in dict.fromkeys(names)
            for f in self.index.of(name, self.camera.name, setup, serving=serving)
        ]
        return [f for f in in_natural_order(files) if f.sensor == self.sensor]

    def _served(self, names: Sequence[str], setup: str) -> list[str]:
        """Return the objects that have a dark or white of their own."""
        return self.index.served(names, self.camera.name, setup)

    # --- the nearest in time ------------------------------------------------------------------

    def _nearest(self, kind: str, groups: Sequence[list[FoundFile]]) -> list[FoundFile]:
        """Return of each band's frames those that were captured nearest to the object, before and after it."""
        if all(len(group) == 1 for group in groups):
            return [file for (file,) in groups]
        chosen = [self._nearest_stacks(kind, group) for group in groups]
        if remarks := [remark for _, remark in chosen if remark]:
            self.remarks.append(remarks[0])  # of the other bands it is much the same
        return in_natural_order(file for files, _ in chosen for file in files)

    def _exposure(self, file: FoundFile) -> float | tuple[float, ...] | None:
        if file.exposure_s is not None:
            return file.exposure_s
        try:
            facts = self.index.facts(file.path)
        except Refused:  # calibration names it, with all others that cannot be read
            return None
        return facts.band_times_s or facts.exposure_s

    def _nearest_stacks(self, kind: str, group: list[FoundFile]) -> tuple[list[FoundFile], str]:
        """Return the frames of the nearest stacks, and in words which these are where there are others."""
        if len(group) < 2:
            return group, ""
        same = [f for f in self.shown if _band(f) == _band(group[0])] or self.shown
        ends = [same[0], same[-1]]
        for moments_of, apart, words in (
            (self._times, STACK_S, _in_time),
            (_times_in_their_names, STACK_S, _in_time),
            (_running_numbers, 0.0, _in_number),
        ):
            known = moments_of(group)
            if len(known) < len(group) or max(known.values()) - min(known.values()) <= apart:
                continue
            known = moments_of([*group, *ends, *self._others(group[0])])
            own = sorted(known[file.path] for file in ends if file.path in known)
            if not own:
                continue
            stacks = _stacks(group, known, apart)
            away = [_distance([known[file.path] for file in stack], own) for stack in stacks]
            near = _choose(away, both=kind != "chart" and moments_of == self._times)
            if len(near) < len(stacks):
                where = " and ".join(words(away[i]) for i in near)
                remark = f"of {len(stacks)} {kind}s those nearest to the object are used: {where}"
                return [file for i in near for file in stacks[i]], remark
        return group, ""

    def _others(self, like: FoundFile) -> list[FoundFile]:
        """Return the first and the last frame of every other object, of the band of a template where it has one."""
        ends: list[FoundFile] = []
        for name in self.index.objects:
            if name != self.name:
                frames = self.index.of(name, self.camera.name, self.setup)
                frames = [f for f in frames if f.sensor == self.sensor]
                frames = [f for f in frames if _band(f) == _band(like)] or frames
                ends += frames[:1] + frames[-1:]
        return ends

    def _times(self, files: Iterable[FoundFile]) -> dict[Path, float]:
        """Return when files were captured, s; those that do not state it, or cannot be read, are left out."""
        found: dict[Path, float] = {}
        for path in dict.fromkeys(file.path for file in files):
            try:
                moment = datetime.fromisoformat(str(self.index.facts(path).captured))
            except (Refused, ValueError):
                continue
            zone = moment.tzinfo or UTC  # of one camera all files state it, or none
            found[path] = moment.replace(tzinfo=zone).timestamp()
        return found


def _times_in_their_names(files: Iterable[FoundFile]) -> dict[Path, float]:
    return times_in_names(file.path for file in files)


def times_in_names(paths: Iterable[Path]) -> dict[Path, float]:
    """Return when files were captured by date and time in their names, else by the date of the nearest folder's, s."""
    found: dict[Path, float] = {}
    for path in dict.fromkeys(paths):
        timed = _TIME.search(path.stem)
        dated = next(filter(None, map(_DATE.search, (path.stem, *path.parts[-2::-1]))), None)
        if not (timed or dated):
            continue
        parts = [*timed.groups()] if timed else [*dated.groups(), "00", "00", "00"]  # type: ignore[union-attr]
        day, clock = "-".join(parts[:3]), ":".join(parts[3:])
        try:
            found[path] = datetime.fromisoformat(f"{day}T{clock}+00:00").timestamp()
        except ValueError:  # digits that are no time
            continue
    return found


def _running_numbers(files: Iterable[FoundFile]) -> dict[Path, float]:
    """Return the last number in each file's name; nothing where one has none, or two have the same."""
    paths = list(dict.fromkeys(file.path for file in files))
    found = [re.findall(r"\d+", path.stem) for path in paths]
    if not all(found):
        return {}
    numbers = [float(digits[-1]) for digits in found]
    return dict(zip(paths, numbers, strict=True)) if len(set(numbers)) == len(paths) else {}


def _stacks(
    group: Sequence[FoundFile], moments: Mapping[Path, float], apart: float
) -> list[list[FoundFile]]:
    """Part frames where another was captured between two of them that are more than `apart` from each other."""
    paths = {file.path for file in group}
    others = [moment for path, moment in moments.items() if path not in paths]
    ordered = sorted(group, key=lambda file: moments[file.path])
    stacks = [ordered[:1]]
    for one, next_one in pairwise(ordered):
        before, after = moments[one.path], moments[next_one.path]
        if after - before > apart and any(before <= other <= after for other in others):
            stacks.append([])
        stacks[-1].append(next_one)
    return stacks


def _distance(moments: Sequence[float], own: Sequence[float]) -> float:
    """Return how long before (< 0) or after an object a stack was captured; 0 where they overlap."""
    return min(max(moments) - own[0], 0.0) or max(min(moments) - own[-1], 0.0)


def _choose(away: Sequence[float], *, both: bool) -> list[int]:
    """Return which of some stacks to use by their distances: those that overlap with the object, else the nearest.

    `both`: the nearest before and the nearest after it, where there are both: calibration interpolates in time.

    >>> _choose([-50.0, -9.0, 40.0, 90.0], both=True), _choose([-50.0, -9.0, 40.0], both=False)
    ([1, 2], [1])
    """
    order = sorted(range(len(away)), key=lambda i: abs(away[i]))
    if not away[order[0]]:
        return [i for i in order if not away[i]]
    sides = [[i for i in order if (away[i] < 0) == before] for before in (True, False)]
    return [side[0] for side in sides] if both and all(sides) else order[:1]


def _band(file: FoundFile) -> object:
    return file.wavelength, file.band


def _in_time(seconds: float) -> str:
    """Return a difference in time in words.

    >>> _in_time(-720.0), _in_time(0.0)
    ('12 min before it', 'at the same time')
    """
    if not seconds:
        return "at the same time"
    span = abs(seconds)
    text = f"{span / 60:.0f} min" if span < 7200 else f"{span / 3600:.0f} h"
    return f"{text} {'before' if seconds < 0 else 'after'} it"


def _in_number(count: float) -> str:
    """Return a difference between running numbers of files in words; they do not state their time."""
    return f"{counted(round(abs(count)), 'file')} {'before' if count < 0 else 'after'} it by its number"


# --- what a capture must have -----------------------------------------------------------------


def check_every_band(
    camera: Camera, kind: str, templates: Sequence[FrameRef], bands: Sequence[Band]
) -> None:
    """Refuse templates that belong to bands and leave one of the object's without.

    Raises
    ------
    CaptureRefused
        ``E_TEMPLATE_MISSING`` with the bands.
    """
    if not templates or any(f.band is None for f in templates):
        return
    served = {f.band for f in templates}
    lacking = [b.label for b in bands if b.label not in served]
    if lacking:
        raise CaptureRefused(
            Problem(
                "E_TEMPLATE_MISSING",
                f"{camera.name}: no {kind} for {len(lacking)} of {len(bands)} bands",
                str(templates[0].path.parent),
                f"cameras.{camera.name}.files",
                f"none for {', '.join(lacking[:6])}{' …' if len(lacking) > 6 else ''}",
                f"a {kind} for every band, or one {kind} for all bands",
                f"Add the frames, or write `{kind} = []` under [cameras.{camera.name}].",
            )
        )


def near_names(names: Iterable[str], there: Sequence[str]) -> str | None:
    """Return which name that is there one of some may mean; None where none is near."""
    return next((fix for name in names if (fix := closest_match(name, there))), None)
