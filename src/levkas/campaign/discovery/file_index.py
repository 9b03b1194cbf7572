"""Every frame of a campaign, camera by camera and setup by setup, before anything is made of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.campaign.discovery.captures import CaptureRefused
from levkas.campaign.discovery.files import Found, find
from levkas.campaign.discovery.folders import Folders
from levkas.campaign.discovery.manifest import read_manifest, with_exposures
from levkas.campaign.discovery.patterns import Pattern
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from levkas.campaign.campaign import Camera, Campaign
    from levkas.readers.frames import Facts


@dataclass
class Survey:
    """What is known while the captures of a campaign are looked for."""

    campaign: Campaign
    folders: Folders
    frames: dict[tuple[str, str], list[Found]] = field(default_factory=dict)
    broken: dict[tuple[str, str], Refused] = field(default_factory=dict)
    objects: list[str] = field(default_factory=list)
    _facts: dict[Path, Facts] = field(default_factory=dict)
    _by_target: dict[tuple[str, str], dict[str, list[Found]]] = field(default_factory=dict)
    _has_objects: dict[tuple[str, str], bool] = field(default_factory=dict)
    _bands: dict[tuple[str, str, str], set[float | str]] = field(default_factory=dict)

    def of(self, name: str, camera: str, setup: str) -> list[Found]:
        """Return the frames of one target by a camera under a setup, in natural order."""
        key = camera, setup
        if key not in self._by_target:
            self._by_target[key] = {}
            for found in self.frames[key]:
                self._by_target[key].setdefault(found.target, []).append(found)
        return self._by_target[key].get(name, [])

    def has_objects(self, camera: str, setup: str) -> bool:
        """Whether any object was taken by a camera under a setup."""
        key = camera, setup
        if key not in self._has_objects:
            self._has_objects[key] = any(self.of(name, *key) for name in self.objects)
        return self._has_objects[key]

    def bands(self, camera: Camera, sensor: str, setup: str) -> set[float | str]:
        """Return the bands that one sensor's frames of objects and whites show, whichever."""
        key = camera.name, setup, sensor
        if key not in self._bands:
            targets = {*self.objects, *self.campaign.whites_of(camera)}
            self._bands[key] = {
                f.band if f.wavelength is None else f.wavelength
                for f in self.frames[camera.name, setup]
                if f.sensor == sensor and f.target in targets
            } - {""}
        return self._bands[key]

    def facts(self, path: Path) -> Facts:
        """Return what a file's header says, read once."""
        from levkas.readers.frames import read_facts

        if path not in self._facts:
            self._facts[path] = read_facts(path)
        return self._facts[path]


def look(campaign: Campaign) -> Survey:
    """Find the frames of every camera under every setup, whatever their targets."""
    output = campaign.output
    beside = [output.with_name(f"{output.name}.{what}") for what in ("kept", "removed")]
    folders = Folders(never=(output, *beside))
    survey = Survey(campaign, folders)
    for name, camera in campaign.cameras.items():
        _look(survey, name, camera)
    return survey


def _look(survey: Survey, name: str, camera: Camera) -> None:
    """Find the frames of one camera under every setup."""
    campaign, default = survey.campaign, (name, "")
    survey.frames[default] = _find(survey, default, camera, None, "")
    by_setup: dict[str, list[Found]] = {}
    for found in survey.frames[default]:
        by_setup.setdefault(found.setup, []).append(found)
    for setup, keys in campaign.setups.items():
        if setup == campaign.campaign.setup:  # the default one, described and no more
            continue
        own = keys.cameras.get(name)
        if own is not None and own.files:
            survey.frames[name, setup] = _find(survey, (name, setup), camera, own.files, setup)
        elif own is not None or by_setup.get(setup):
            survey.frames[name, setup] = by_setup.get(setup, [])
        by_setup.pop(setup, None)
    survey.frames[default] = [f for found in by_setup.values() for f in found]
    unnamed = sorted(value for value in by_setup if value)
    if len(unnamed) > 1:
        survey.broken[default] = CaptureRefused(
            Problem(
                "E_VALUE",
                f"{name}: several setups, and which is the default one is not said",
                str(campaign.path),
                f"cameras.{name}.files",
                ", ".join(unnamed),
                "one value of {setup} that is not declared under [setups]",
                f"Declare the others: [setups.{unnamed[-1]}.cameras.{name}].",
            )
        )


def _find(
    survey: Survey, key: tuple[str, str], camera: Camera, files: Sequence[str] | None, setup: str
) -> list[Found]:
    """Find the frames of one camera, sensor by sensor; a folder that cannot be read is kept for later."""
    known = {
        "target": declared_targets(survey.campaign),
        "band": camera.bands or (),
        "setup": tuple(survey.campaign.setups),
    }
    frames: list[Found] = []
    try:
        for sensor in [s.name for s in camera.sensors] or [""]:
            patterns = _patterns_of_sensor(camera, sensor, files, setup)
            found = find(survey.campaign.root, patterns, known=known, folders=survey.folders)
            frames += [replace(f, sensor=sensor) for f in found]
        if camera.manifest:
            exposures = read_manifest(survey.campaign.root / camera.manifest)
            frames = with_exposures(frames, exposures, survey.campaign.root)
    except Refused as refused:
        survey.broken[key] = refused
    return frames


def _patterns_of_sensor(
    camera: Camera, sensor: str, files: Sequence[str] | None = None, setup: str = ""
) -> list[Pattern]:
    """Patterns of one sensor: a setup's `files`, else its own, else the camera's."""
    own = next((s.files for s in camera.sensors if s.name == sensor), ())
    patterns = [Pattern.parse(text) for text in files or own or camera.files]
    if sensor:
        patterns = [p.given("sensor", sensor) for p in patterns]
    return [p.given("setup", setup) if setup else p for p in patterns]


def declared_targets(campaign: Campaign) -> tuple[str, ...]:
    """Every value of {target} that campaign.toml knows."""
    targets = campaign.targets
    own = [n for c in campaign.cameras.values() for n in (*(c.dark or ()), *(c.white or ()))]
    white = targets.white.names if targets.white else ()
    named = (*targets.dark, *white, *targets.charts, *(targets.objects or ()), *campaign.objects)
    return tuple(dict.fromkeys((*named, *own)))


def patterns_of(
    survey: Survey, camera: str, setup: str = "", *, sensor: str | None = None
) -> list[Pattern]:
    """Return every pattern of a camera under a setup, or of one of its sensors."""
    keys = survey.campaign.cameras[camera]
    own = survey.campaign.setups[setup].cameras.get(camera) if setup else None
    files = own.files if own and own.files else None
    sensors = [sensor] if sensor is not None else [s.name for s in keys.sensors] or [""]
    return [p for name in sensors for p in _patterns_of_sensor(keys, name, files, setup)]
