"""Whether the files of one sensor agree in what they state, with one another and with campaign.toml.

What is compared, and how, is the table of `levkas.readers.compared_facts`; a fact is compared where both files state it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas.calibration.codes import Alignment
from levkas.calibration.findings import CalibrationRefused
from levkas.core.problems import Problem
from levkas.readers.black_levels import BlackLevels
from levkas.readers.compared_facts import (
    FACTS,
    FACTS_BY_NAME,
    NEAREST_NM,
    SCALE,
    ComparedFact,
    Severity,
    compare_black,
    compare_ratio,
    describe_value,
    full_scale,
    read_fact,
)
from levkas.readers.facts import facts_of_bands
from levkas.readers.frames import read_facts, read_headers

if TYPE_CHECKING:
    from levkas.campaign.campaign import Camera
    from levkas.campaign.discovery.captures import FrameRef, SensorFrames
    from levkas.readers.facts import Facts

ROLES = ("object", "white", "chart", "dark")
OF_ONE_NOISE = ("iso", "gain", "make", "model", "serial")
"""May differ from band to band, and then one model of the noise is not that of every band."""
DECLARED, IN_NAME = "campaign.toml", "its name or the manifest"
EXPOSURE = ComparedFact("exposure", "exposure, s", ("exposure_s",), ROLES, compare_ratio(1.1))
"""Declared against stated alone: EXIF has the nominal 1/60 s for 1/64."""
SAME_FULL = 0.01
"""Relative: a declared full scale that differs by less from the file's is the same."""


class Aligned(NamedTuple):
    """Where the codes of a frame stand in their words, the frame's role and file."""

    role: str
    path: Path
    alignment: Alignment


class Stated(NamedTuple):
    """A frame, its role, and what its file states."""

    role: str
    frame: FrameRef
    facts: Facts


Valued = tuple[Stated, Any]


@dataclass(frozen=True)
class Contradiction:
    """What a file, of a role, states, and what another file, campaign.toml or its name (`by`) states instead.

    `aside` is what follows; `more` are files that contradict in the same fact and role.
    """

    fact: ComparedFact
    severity: Severity
    role: str
    path: Path
    found: str
    expected: str
    by: Path | str
    aside: str = ""
    more: int = 0

    @property
    def names(self) -> tuple[str, str]:
        """The file and the other, with as many folders as distinguish them."""
        if isinstance(self.by, str):
            return self.path.name, self.by
        parts = 1
        while self.path.parts[-parts:] == self.by.parts[-parts:] and self.path != self.by:
            parts += 1
        return "/".join(self.path.parts[-parts:]), "/".join(self.by.parts[-parts:])

    def describe(self) -> str:
        """Return one line with both files and both values."""
        own, other = self.names
        others = f" and {self.more} more" if self.more else ""
        ends = f"{self.found} in {own}{others} ({self.role}), {self.expected} in {other}"
        return f"{self.fact.title}: {ends}{self.aside}"

    def problem(self, camera: str) -> Problem:
        """Return the refusal, with what to do."""
        other, title = self.names[1], self.fact.title
        found = self.found + (f", and {self.more} more differ" if self.more else "")
        expected = f"{self.expected}, as {other} states"
        message, file = f"{self.role} and {other} differ in {title}", str(self.path)
        return Problem("E_FACTS", message, file, title, found, expected, self.fact.advice(camera))


def facts_of(frame: FrameRef) -> Facts:
    """Return what the headers of a frame's file state of its bands, in their order; of a camera raw its EXIF alone."""
    facts = read_headers(frame.path)
    if frame.page is not None:
        return facts_of_bands(facts, (frame.page,))
    return facts_of_bands(facts, frame.order) if frame.order else facts


def compare_facts(
    camera: Camera, sensor: SensorFrames, alignments: Sequence[Aligned] | None = None
) -> list[str]:
    """Compare what all frames of a sensor state, and where their codes stand, where they were decoded.

    Notes are what `overrule` accepts, what differs without making a value wrong, what campaign.toml declares otherwise. Raises
    CalibrationRefused, E_FACTS, once for a fact and role, with both files, both values and what to do; a photograph, of which nothing
    is calibrated, has notes instead.
    """
    every = _stated(sensor, decoded=alignments is not None)
    between = [*_between_files(camera, sensor, every), *_between_alignments(alignments or ())]
    known = {(one.fact, one.path) for one in between}
    declared = _with_declaration(camera, sensor, every)
    found = _merged([*between, *(one for one in declared if (one.fact, one.path) not in known)])
    notes = [one.describe() for one in found if not _is_fatal(camera, one)]
    refused = [one for one in found if _is_fatal(camera, one)]
    accepted = {one.fact.name for one in refused} & set(camera.overrule)
    if any(one.facts.reflectance_scale for one in every):
        accepted.add(SCALE)
    if fatal := [one for one in refused if one.fact.name not in accepted]:
        raise CalibrationRefused(*(one.problem(camera.name) for one in fatal))
    notes += [f"{one.describe()}; `overrule` accepts it, no value is corrected" for one in refused]
    moved = dict.fromkeys(one.frame.path.name for one in every if _is_moved(sensor, one.frame))
    order = "stand in another order, matched by wavelength or name"
    notes += [f"the bands of {name} {order}" for name in moved]
    if idle := [name for name in camera.overrule if name not in accepted]:
        notes.append(f"`overrule` of {', '.join(idle)} has no effect: these files agree")
    return notes


def _is_moved(sensor: SensorFrames, frame: FrameRef) -> bool:
    """Whether the bands of a frame's file stand in another order than the object's; a page is that of its band."""
    if frame.page is None or frame.band is None:
        return bool(frame.order)
    return frame.page != [band.label for band in sensor.bands].index(frame.band)


def _is_fatal(camera: Camera, one: Contradiction) -> bool:
    return one.severity == "refused" and camera.traits.is_calibrated


def _merged(found: Iterable[Contradiction]) -> list[Contradiction]:
    """Return one contradiction for a fact, role and severity, with the number of other files."""
    groups: dict[tuple[str, str, str, bool], list[Contradiction]] = {}
    for one in found:
        key = one.fact.name, one.severity, one.role, isinstance(one.by, str)
        groups.setdefault(key, []).append(one)
    return [replace(some[0], more=len({one.path for one in some}) - 1) for some in groups.values()]


# --- file with file ------------------------------------------------------------------------------


def _stated(sensor: SensorFrames, *, decoded: bool) -> list[Stated]:
    """Return all frames of a sensor with their facts; of camera raws that were not decoded after a role's first the EXIF alone."""
    found = []
    for role in ROLES:
        for i, frame in enumerate(getattr(sensor, role)):
            facts = facts_of(frame)
            if facts.kind == "raw" and (i == 0 or decoded):
                facts = read_facts(frame.path)
            found.append(Stated(role, frame, facts))
    return found


def _between_files(
    camera: Camera, sensor: SensorFrames, every: list[Stated]
) -> Iterator[Contradiction]:
    """Yield the facts in which files contradict the first that states them; where bands may differ, that of each band."""
    labels = list(dict.fromkeys(one.frame.band for one in every if one.frame.band is not None))
    of_band = [[one for one in every if one.frame.band in (label, None)] for label in labels]
    for fact in FACTS:
        firsts: list[Valued] = []
        for group in of_band if fact.per_band and of_band else [every]:
            valued = _values(camera, sensor, fact, group)
            yield from _compared(fact, valued)
            firsts += valued[:1]
        if fact.name in OF_ONE_NOISE:
            for problem in _compared(fact, firsts):
                yield replace(problem, severity="noted", aside="; one noise model serves all bands")


def _values(
    camera: Camera, sensor: SensorFrames, fact: ComparedFact, group: Iterable[Stated]
) -> list[Valued]:
    """Return the frames of a group that state a fact, with its value."""
    return [
        (one, value)
        for one in group
        if fact.fields
        and one.role in fact.roles
        and (value := _value(camera, sensor, fact, one)) is not None
    ]


def _value(camera: Camera, sensor: SensorFrames, fact: ComparedFact, one: Stated) -> Any:
    """Return what a frame states; None where the fact says nothing about this frame."""
    value = read_fact(fact, one.facts)
    if value is None:
        return None
    if fact.name in ("wavelengths", "bands") and one.role == "dark" and len(value) == 1:
        return None  # no light came through the filter
    if fact.name == "region" and camera.traits.is_scanned:
        if one.role == "object" and one.frame != sensor.object[0]:
            return None  # of a strip it may be its place in the scan
        if camera.scan != "mirror":  # dark and white are other lines
            value = tuple(pair for pair in value if pair[0] != "y start")
    return value or None


def _compared(fact: ComparedFact, valued: list[Valued]) -> Iterator[Contradiction]:
    """Yield where frames contradict the first."""
    for one, value in valued[1:]:
        base, expected = valued[0]
        severity = fact.compare(expected, value)
        if severity != "same":
            texts = describe_value(fact, value), describe_value(fact, expected)
            path = one.frame.path
            yield Contradiction(fact, severity, one.role, path, *texts, base.frame.path)


def _between_alignments(alignments: Sequence[Aligned]) -> Iterator[Contradiction]:
    """Yield frames whose codes stand otherwise in their words than those of one before them, by the gravest contradiction."""
    fact, distinct = FACTS_BY_NAME["code_spacing"], dict[Alignment, Aligned]()
    for one in alignments:
        pairs = [(other.alignment.compare(one.alignment), other) for other in distinct.values()]
        graver = sorted((s != "refused", i) for i, (s, _) in enumerate(pairs) if s != "same")
        if graver:
            severity, other = pairs[graver[0][1]]
            texts = one.alignment.describe(), other.alignment.describe()
            yield Contradiction(fact, severity, one.role, one.path, *texts, other.path)
        distinct.setdefault(one.alignment, one)


# --- file with campaign.toml ----------------------------------------------------------------------


def _with_declaration(
    camera: Camera, sensor: SensorFrames, every: list[Stated]
) -> Iterator[Contradiction]:
    """Yield where a file states otherwise than campaign.toml, or its name, declares; what is declared is taken."""
    for one in every:
        for name, (declared, stated) in _pairs(camera, sensor, one).items():
            if declared is None or stated is None:
                continue
            severity = _severity(sensor, name, declared, stated)
            if severity != "same":
                fact = FACTS_BY_NAME.get(name, EXPOSURE)
                texts = describe_value(fact, stated), describe_value(fact, declared)
                by = IN_NAME if fact is EXPOSURE else DECLARED
                yield Contradiction(fact, severity, one.role, one.frame.path, *texts, by)


def _pairs(camera: Camera, sensor: SensorFrames, one: Stated) -> dict[str, tuple[Any, Any]]:
    """Return by name of a fact what is declared of a frame, and what its file states."""
    facts = one.facts
    bits, black, centres = (FACTS_BY_NAME[name] for name in ("bits", "black", "wavelengths"))
    stored = facts.kind != "raw" and facts.bits == 8 * np.dtype(facts.dtype).itemsize
    declared_black = None
    if camera.black is not None:
        declared_black = camera.black, full_scale(facts), BlackLevels(((camera.black,),))
    return {
        "bits": (camera.bits, None if stored else read_fact(bits, facts)),
        "saturation": (camera.saturation, facts.saturation),
        "black": (declared_black, read_fact(black, facts)),
        "pattern": (_letters(camera, sensor), facts.pattern),
        "exposure": (one.frame.exposure_s, facts.exposure_s),
        "wavelengths": (_centres(sensor, one), _value(camera, sensor, centres, one)),
    }


def _severity(sensor: SensorFrames, name: str, declared: Any, stated: Any) -> Severity:
    """Compare what is declared with what a file states: but for wavelengths what is declared is taken, and the other noted."""
    if name == "wavelengths":
        apart = max(abs(a - b) for a, b in zip(declared, stated, strict=True))
        steps = sorted(abs(b - a) for a, b in pairwise(b.wavelength for b in sensor.bands))
        allowed = max(NEAREST_NM, steps[len(steps) // 2] / 2 if steps else 0.0)
        return "same" if apart <= NEAREST_NM else "noted" if apart <= allowed else "refused"
    same = {
        "saturation": lambda: abs(declared / stated - 1) <= SAME_FULL,
        "black": lambda: compare_black(declared, stated) == "same",
        "exposure": lambda: EXPOSURE.compare(declared, stated) == "same",
    }.get(name, lambda: declared == stated)
    return "same" if same() else "noted"


def _letters(camera: Camera, sensor: SensorFrames) -> str | None:
    """Return a declared pattern of Bayer, or of X-Trans, as letters; None of others, whose names a file cannot contradict."""
    rows = camera.pattern
    if sensor.name:
        rows = next(s.pattern for s in camera.sensors if s.name == sensor.name)
    letters = "".join("".join(row) for row in rows or ())
    return letters if len(letters) in (4, 36) and set(letters) <= set("RGB") else None


def _centres(sensor: SensorFrames, one: Stated) -> tuple[float, ...] | None:
    """Return the wavelengths that the bands of a frame have by campaign.toml, their names or the object's header."""
    bands = [band for band in sensor.bands if one.frame.band in (None, band.label)]
    centres = tuple(band.wavelength for band in bands)
    as_many = len(centres) == len(one.facts.wavelengths or ())
    return centres if as_many and not any(map(isnan, centres)) else None
