"""The frames of one sensor judged beside one another: which companions each is compared with, and what comes of it.

The result depends on the set of frames alone, not on the order in which they came: a late white, a dark that is replaced
or a frame that is deleted changes what its companions get, as if it had been so from the start.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from levkas.calibration.sight import SIZES, difference_between
from levkas.campaign.discovery.patterns import natural
from levkas.quality.frame_checks import light_checks as light
from levkas.quality.frame_checks import picture_checks as picture
from levkas.quality.frame_checks.light_checks import SAME_TIME, FrameFinding
from levkas.quality.frame_checks.measures import FrameMeasures
from levkas.readers.compared_facts import FACTS, ComparedFact, describe_value, read_fact
from levkas.readers.facts import Facts

LIT_ROLES = ("object", "white", "chart")
MOST_COMPANIONS = 8
"""Frames whose noise is compared."""


@dataclass(frozen=True, eq=False)
class FrameOfSet:
    """A frame as it is judged.

    Parameters
    ----------
    name : str
        Unique; frames of the same time are ordered by it, 9 before 10.
    role : {"object", "white", "dark", "chart"}
    target, band, shot, tile : str
        Band, shot and tile are empty where the name has none; a frame without a band serves all.
    at : float
        s, on the clock of the camera or of the files, which orders the frames of a sensor.
    names : tuple of str
        Of the channels.
    full : float, optional
        Stated full scale, counts.
    black : float, optional
        Stated black level, counts.
    """

    name: str
    role: str
    target: str
    facts: Facts
    measures: FrameMeasures
    band: str = ""
    shot: str = ""
    tile: str = ""
    at: float = 0.0
    exposure_s: float | None = None
    names: tuple[str, ...] = ("",)
    full: float | None = None
    black: float | None = None

    @cached_property
    def order(self) -> tuple[object, ...]:
        """What frames of a set are sorted by."""
        return self.at, natural(self.name), self.name

    @cached_property
    def shown(self) -> tuple[str, str]:
        """What it shows: each tile of an object is a scene of its own."""
        return self.target, self.tile

    @cached_property
    def stated(self) -> dict[str, tuple[object, str]]:
        """The facts that its file states, by name, and their text; also the white balance of a raw frame, which changes no code."""
        read = {
            f.name: read_fact(f, self.facts) for f in FACTS if f.fields and self.role in f.roles
        }
        if self.role in LIT_ROLES:
            read["white_balance"] = self.facts.white_balance
        return {k: (v, repr(v)) for k, v in read.items() if v is not None}

    @cached_property
    def fine(self) -> float:
        """Its detail, 0 where noise hides it."""
        return float(np.nan_to_num(self.measures.fine))

    @cached_property
    def blur_px(self) -> float:
        """The blur of its edges, infinite where it has none."""
        return float(np.nan_to_num(self.measures.blur_px, nan=np.inf))

    @cached_property
    def brightest(self) -> float:
        """Its brightest channel, counts."""
        return float(self.measures.high.max())

    @cached_property
    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        height, width = map(int, self.measures.shape)
        return width, height

    @cached_property
    def version(self) -> str:
        """Its name and what its picture is: another one where it was replaced."""
        return f"{self.name}/{self.measures.key}"


@dataclass(frozen=True)
class SetRules:
    """What of a camera decides which checks its frames get.

    Parameters
    ----------
    overrule : collection of str
        Facts that may differ.
    brackets : bool
        Whether several exposures are merged or chosen from: a single one may clip, or be dim.
    scanned : bool
        Whether lines are exposed one after another: no stacks, no pictures to compare.
    plain : bool
        Whether nothing is calibrated: a photograph or a radiograph, of which any size and exposure may be right.
    """

    overrule: Collection[str] = ()
    brackets: bool = False
    scanned: bool = False
    plain: bool = False


@dataclass
class FrameJudge:
    """The frames of one sensor under one setup; findings of a frame whose companions are the same are kept between calls."""

    rules: SetRules = SetRules()
    _kept: dict[tuple[object, ...], list[FrameFinding]] = field(default_factory=dict)

    def judge(self, frames: Iterable[FrameOfSet]) -> dict[str, list[FrameFinding]]:
        """Return the findings of every frame by its name, in the order of time."""
        companions = _Companions(sorted(frames, key=lambda f: f.order), self.rules)
        kept, judged = {}, {}
        for frame in companions.frames:
            beside = companions.of(frame)
            key = (frame.version, *beside.key)
            if (found := self._kept.get(key)) is None:
                found = _findings(frame, beside, self.rules)
            kept[key] = judged[frame.name] = found
        self._kept = kept
        return judged


def judge(
    frames: Iterable[FrameOfSet], rules: SetRules = SetRules()
) -> dict[str, list[FrameFinding]]:
    """Return the findings of the frames of one sensor under one setup, by name; `FrameJudge` does it again and again.

    Examples
    --------
    >>> from pathlib import Path
    >>> from levkas.quality.frame_checks import measure_frame
    >>> rng, facts = np.random.default_rng(1), Facts(Path("a.tif"), "tiff", (240, 320), "uint16", bits=12)
    >>> def white(name, level):
    ...     codes = rng.normal(level, 10, (240, 320)).astype(np.uint16)
    ...     return FrameOfSet(name, "white", "white", facts, measure_frame(codes), at=float(name), full=4095, black=0)
    >>> found = judge([white("1", 3000), white("2", 2880)])
    >>> found["1"], found["2"][0].text
    ([], 'the lamp gives 4 % less than at the white before')
    """
    return FrameJudge(rules).judge(frames)


@dataclass(frozen=True, eq=False)
class _Beside:
    """The companions of one frame, None or empty where there are none."""

    black: float
    stated_black: float | None = None
    white: FrameOfSet | None = None
    scene: FrameOfSet | None = None
    before: FrameOfSet | None = None
    first: FrameOfSet | None = None
    best: FrameOfSet | None = None
    twin: FrameOfSet | None = None
    like: tuple[FrameOfSet, ...] = ()
    dark_times: tuple[float, ...] = ()
    settings: tuple[_Differing, ...] = ()
    same_band: bool = True
    same_scene: bool = True
    scale: float | None = None
    size: tuple[int, ...] | None = None

    @cached_property
    def key(self) -> tuple[object, ...]:
        single = (self.white, self.scene, self.before, self.first, self.best, self.twin, *self.like)
        names = tuple(None if f is None else f.version for f in single)
        differing = tuple((d.fact.name, d.refused, d.usual.prevails) for d in self.settings)
        return (names, self.black, self.scale, self.dark_times, differing, self.size)


class _Companions:
    """Looks companions up; made once for a set, in time that grows as its size."""

    def __init__(self, frames: Sequence[FrameOfSet], rules: SetRules) -> None:
        self.frames, self.rules = frames, rules
        self.place = {frame.name: i for i, frame in enumerate(frames)}
        self._sound: dict[str, bool] = {}
        by: dict[tuple[object, ...], list[FrameOfSet]] = defaultdict(list)
        for frame in frames:
            by["role", frame.role].append(frame)
            by["band", frame.role, frame.band].append(frame)
            by["target", frame.role, frame.shown].append(frame)
            by["scene", frame.role, frame.shown, frame.band].append(frame)
            by["stack", frame.role, frame.shown, frame.band, frame.exposure_s].append(frame)
            by["twin", frame.measures.key].append(frame)
        self.by = by
        self.dark_times = tuple(
            sorted({f.exposure_s for f in by["role", "dark"] if f.exposure_s is not None})
        )
        darks = [float(np.median(f.measures.level)) for f in by["role", "dark"]]
        stated = next((f.black for f in frames if f.black is not None), None)
        self.black = float(np.median(darks)) if darks else stated if stated is not None else 0.0
        stated_full = next((f.full for f in frames if f.full is not None), None)
        lit = [f.brightest for role in LIT_ROLES for f in by["role", role]]
        self.scale = stated_full if stated_full is not None else max(lit, default=None)
        self.sharpest: dict[tuple[object, ...], FrameOfSet] = {}
        for frame in by["role", "object"]:
            stack, *wider = _scenes(frame)
            best = self.sharpest.setdefault(stack, frame)
            if frame.fine > best.fine:
                self.sharpest[stack] = frame
            for alike in wider if frame.blur_px < np.inf else ():
                best = self.sharpest.setdefault(alike, frame)
                if frame.blur_px < best.blur_px:
                    self.sharpest[alike] = frame
        self.usual = _usual_settings(frames)
        sizes = Counter(_size(f, rules) for f in frames)
        self.size = sizes.most_common(1)[0][0] if sizes else None

    def of(self, frame: FrameOfSet) -> _Beside:
        stack = self.by["stack", frame.role, frame.shown, frame.band, frame.exposure_s]
        like: tuple[FrameOfSet, ...]
        before, same_band = None, True
        if frame.role == "dark":
            of_time = [f for f in stack if f is not frame]
            like, before = tuple(of_time[:MOST_COMPANIONS]), self._before(frame, stack)
        elif frame.role == "white":
            same = self.by["band", "white", frame.band]
            like = tuple(f for f in same[: MOST_COMPANIONS + 1] if f is not frame)
            before = self._before(frame, same)
        else:
            like = tuple(f for f in stack[:2] if f is not frame)[:1]
            before = self._before(frame, self.by["scene", frame.role, frame.shown, frame.band])
            if before is None:
                same_band = False
                before = self._before(frame, self.by["target", frame.role, frame.shown])
        best, same_scene = self._sharpest(frame, stack)
        twins = self.by["twin", frame.measures.key]
        lit = frame.role != "dark"
        return _Beside(
            self.black,
            frame.black,
            white=self._nearest(frame, "white") if frame.role == "object" else None,
            scene=self._nearest(frame, "object") if frame.role == "white" else None,
            before=before,
            first=next((f for f in stack if f is frame or self._is_sound(f)), frame),
            best=best,
            twin=twins[0] if twins[0] is not frame else None,
            like=tuple(f for f in like if self._is_sound(f)),
            dark_times=self.dark_times if lit else (),
            settings=tuple(self._differing(frame)),
            same_band=same_band,
            same_scene=same_scene,
            scale=self.scale,
            size=self.size,
        )

    def _sharpest(
        self, frame: FrameOfSet, stack: Sequence[FrameOfSet]
    ) -> tuple[FrameOfSet | None, bool]:
        """Return the sharpest frame to compare with, and whether it is of the same scene: of a stack, of the band, of the object."""
        if frame.role != "object":
            return None, True
        scenes = _scenes(frame)
        if len(stack) > 1:
            return self.sharpest.get(scenes[0]), True
        found = (self.sharpest.get(scene) for scene in (() if self.rules.brackets else scenes[1:]))
        return next((one for one in found if one is not None and one is not frame), None), False

    def _before(self, frame: FrameOfSet, frames: Sequence[FrameOfSet]) -> FrameOfSet | None:
        """Return the last frame before it that is sound by itself: a clipped white shows no drift of the next."""
        at = bisect_left(frames, self.place[frame.name], key=lambda f: self.place[f.name])
        return next((f for f in reversed(frames[:at]) if self._is_sound(f)), None)

    def _is_sound(self, frame: FrameOfSet) -> bool:
        """Whether nothing that a frame shows by itself makes it one to capture again."""
        if frame.name not in self._sound:
            found = _findings_alone(frame, self)
            self._sound[frame.name] = all(one.severity != "stop" for one in found)
        return self._sound[frame.name]

    def _nearest(self, frame: FrameOfSet, role: str) -> FrameOfSet | None:
        """Return the sound frame of a role and the same band, or that serves all, that is nearest in time."""
        for band in dict.fromkeys((frame.band, "")):
            if ("sound", role, band) not in self.by:
                every = self.by["band", role, band]
                self.by["sound", role, band] = [f for f in every if self._is_sound(f)]
            frames = self.by["sound", role, band]
            at = bisect_left(frames, frame.at, key=lambda f: f.at)
            around = frames[max(0, at - 1) : at + 1]
            if around:
                return min(around, key=lambda f: abs(f.at - frame.at))
        return None

    def _differing(self, frame: FrameOfSet) -> Iterable[_Differing]:
        for fact, usual in self.usual.items():
            if fact.name in self.rules.overrule or frame.role not in fact.roles or not usual:
                continue
            expected = usual.get(frame.band if fact.per_band else "")
            value, text = frame.stated.get(fact.name, (None, ""))
            if expected is None or value is None or text == expected.text:
                continue
            if fact.compare(expected.value, value) == "refused":
                together = (
                    frame.role != "object" or expected.of_all or frame.target in expected.targets
                )
                read = read_fact(fact, frame.facts) is not None
                yield _Differing(fact, value, expected, read, read and together)


def _scenes(frame: FrameOfSet) -> list[tuple[object, ...]]:
    """Return what frames are compared in focus by: the same stack, the same band of any object, the same object in any band."""
    return [
        ("stack", frame.shown, frame.band, frame.exposure_s),
        ("band", frame.band),
        ("target", frame.shown),
    ]


@dataclass(frozen=True, eq=False)
class _Usual:
    """The value of a fact that most frames state: the first that does, the objects that do, whether most of all do.

    `of_all` is whether a dark, white or chart states it, with which a build compares every object.
    """

    first: FrameOfSet
    value: object
    text: str
    targets: Collection[str]
    of_all: bool
    prevails: bool


@dataclass(frozen=True, eq=False)
class _Differing:
    """A fact in which a frame differs from the usual, whether it changes codes, and whether a build refuses it for that."""

    fact: ComparedFact
    value: object
    usual: _Usual
    in_codes: bool
    refused: bool


def _usual_settings(frames: Sequence[FrameOfSet]) -> Mapping[ComparedFact, dict[str, _Usual]]:
    """Return the usual value of every fact, by band where bands may differ."""
    usual: dict[ComparedFact, dict[str, _Usual]] = {}
    for fact in FACTS:
        stating: dict[str, dict[str, list[FrameOfSet]]] = defaultdict(lambda: defaultdict(list))
        for frame in frames:
            if fact.name in frame.stated:
                band = frame.band if fact.per_band else ""
                stating[band][frame.stated[fact.name][1]].append(frame)
        usual[fact] = {}
        for band, by_text in stating.items():
            # Of equals the first in time counts: dictionaries keep the order of coming.
            text, some = max(by_text.items(), key=lambda item: len(item[1]))
            objects = {f.target for f in some if f.role == "object"}
            of_all = any(f.role != "object" for f in some)
            prevails = len(some) > max(1, sum(map(len, by_text.values())) / 2)
            value = some[0].stated[fact.name][0]
            usual[fact][band] = _Usual(some[0], value, text, objects, of_all, prevails)
    return usual


def _findings_alone(frame: FrameOfSet, companions: _Companions) -> list[FrameFinding]:
    """Return what is wrong with the light of a frame by itself."""
    own, black, rules = frame.measures, companions.black, companions.rules
    if rules.plain:
        return []
    if frame.role == "dark":
        return light.check_dark(own, black=frame.black, scale=companions.scale)
    found: list[FrameFinding] = []
    if not (rules.brackets and frame.role != "white"):
        found += light.check_exposure(
            own, frame.role, frame.names, black=black, full=frame.full, exposure_s=frame.exposure_s
        )
    return found + (light.check_white_frame(own, black=black) if frame.role == "white" else [])


def _findings(frame: FrameOfSet, beside: _Beside, rules: SetRules) -> list[FrameFinding]:
    """Return what is wrong with one frame, the gravest first."""
    found = [] if rules.plain else [*_settings(frame, beside, rules)]
    if beside.twin is not None and frame.measures.high.max() > frame.measures.low.min():
        text = f"the same picture as {beside.twin.name}"
        found.append(
            FrameFinding("twice", "look", text, "remove one, or capture the frame that is missing")
        )
    elif frame.role == "dark":
        before = beside.before.measures if beside.before else None
        found += light.check_dark(
            frame.measures, black=beside.stated_black, scale=beside.scale, before=before
        )
        found += light.check_noise(frame.measures, _measures(beside.like), np.inf)
    elif rules.plain:
        found += _unlike(frame, beside)
    elif not any(f.severity == "stop" for f in found):
        found += _lit_findings(frame, beside, rules)
    return sorted(found, key=lambda f: f.severity != "stop")


def _unlike(frame: FrameOfSet, beside: _Beside) -> list[FrameFinding]:
    """Return what a build refuses a shot for that is not the first of its stack."""
    first, own = beside.first, frame.measures.sight
    if first is None or first is frame:
        return []
    found = difference_between(first.measures.sight, own, beside.black, frame.full)
    if found is None:
        return []
    text = f"it differs from {first.name} in {found[0]}: {SIZES[found[0]].format(found[1])}"
    check = "moved" if found[0] in ("scene", "place") else "drift"
    return [
        FrameFinding(
            check, "stop", text, "repeat the stack from the first shot, with nothing changed"
        )
    ]


def _lit_findings(frame: FrameOfSet, beside: _Beside, rules: SetRules) -> list[FrameFinding]:
    black, own = beside.black, frame.measures
    found: list[FrameFinding] = []
    if not (rules.brackets and frame.role != "white"):
        found += light.check_exposure(
            own, frame.role, frame.names, black=black, full=frame.full, exposure_s=frame.exposure_s
        )
    found += light.check_dark_time(frame.exposure_s, beside.dark_times)
    if frame.role == "white":
        return _white_findings(frame, beside) + found
    if frame.role == "object" and beside.white and (ratio := _times(frame, beside.white)):
        found += picture.check_glare(own, beside.white.measures, black=black, ratio_of_times=ratio)
    if rules.scanned:
        return found
    unlike = _unlike(frame, beside)
    found += unlike
    if beside.first is not None and beside.first is not frame and not unlike:
        found += light.check_stack(own, beside.first.measures, black=black)
    if beside.before is not None and not unlike:
        found += picture.check_moved(
            own, beside.before.measures, same_band=beside.same_band, full=frame.full
        )
    found += light.check_noise(own, _measures(beside.like), black)
    if beside.best is not None and beside.best is not frame:
        before = beside.before.measures if beside.before and beside.same_band else None
        found += picture.check_focus(
            own, beside.best.measures, before, same_scene=beside.same_scene
        )
    return found


def _white_findings(frame: FrameOfSet, beside: _Beside) -> list[FrameFinding]:
    black, own = beside.black, frame.measures
    before = beside.before.measures if beside.before else None
    scene = beside.scene.measures if beside.scene else None
    found = light.check_white_frame(own, black=black, before=before, scene=scene)
    if beside.before is not None and not any(f.severity == "stop" for f in found):
        ratio = _times(frame, beside.before)
        if ratio:
            found += light.check_drift(
                own, beside.before.measures, black=black, ratio_of_times=ratio
            )
    return found + light.check_noise(own, _measures(beside.like), black)


def _settings(frame: FrameOfSet, beside: _Beside, rules: SetRules) -> Iterable[FrameFinding]:
    """Yield where a frame's file states otherwise than most of its set, or has another size."""
    size = _size(frame, rules)
    if beside.size is not None and size != beside.size:
        own, other = (" x ".join(map(str, one)) for one in (size, beside.size))
        text = f"the frame is {own} px, the others are {other} px"
        yield FrameFinding(
            "settings", "stop", text, "set the camera's size and format back, and repeat"
        )
    for one in beside.settings:
        own, other = (describe_value(one.fact, value) for value in (one.value, one.usual.value))
        others = " and most others" if one.usual.prevails else ""
        text = f"{one.fact.title}: {own}, but {other} in {one.usual.first.name}{others}"
        if one.refused:
            yield FrameFinding(
                "settings", "stop", text, "set the camera back, and repeat the frame"
            )
        else:
            advice = "if it is meant, capture darks and whites with it as well"
            if not one.in_codes:
                advice = (
                    "set it back, and check the other settings: it changes no value of a raw frame"
                )
            yield FrameFinding("settings", "look", text, advice)


def _size(frame: FrameOfSet, rules: SetRules) -> tuple[int, ...]:
    """Return width and height; of a scan, whose lines may be any number, the width alone."""
    return frame.size[:1] if rules.scanned else frame.size


def _measures(frames: Iterable[FrameOfSet]) -> list[FrameMeasures]:
    return [frame.measures for frame in frames]


def _times(frame: FrameOfSet, other: FrameOfSet) -> float | None:
    """Return the ratio of two exposures; 1 where neither is known, None where one is not."""
    if frame.exposure_s and other.exposure_s:
        ratio = frame.exposure_s / other.exposure_s
        return 1.0 if max(ratio, 1 / ratio) <= SAME_TIME else ratio
    return None if frame.exposure_s or other.exposure_s else 1.0
