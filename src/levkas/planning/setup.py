"""A setup that was read from its TOML file: the object, and lamps and cameras in their places."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.planning.luminous_intensity import Lobe, read_lobe
from levkas.planning.refusals import PlanRefused, wrong
from levkas.planning.spectra import GRID, Spectrum, eye, integrate, read_spectrum

if TYPE_CHECKING:
    from levkas.core.problems import Problem
    from levkas.planning.tables import (
        Bench,
        CameraKeys,
        LampKeys,
        ObjectKeys,
        PlacedLamp,
        SetupKeys,
    )


@dataclass(frozen=True, eq=False)
class Lamp:
    """A lamp in its place.

    Parameters
    ----------
    name : str
        Its kind, with a number where a setup has several.
    place, axis : ndarray, (3,)
        mm; unit vector of where it aims.
    lobe : Lobe
    candela : float
        Luminous intensity along the axis, filters and sheet included.
    spectrum : ndarray, (n,)
        Relative power after filters at `spectra.GRID`, of luminous integral 1.
    known : (first, last)
        Wavelengths at which the lamp and all its filters are known, nm.
    size_mm : (width, height) or None
        Of a soft light; none is a point.
    polariser : {"p", "s"} or None
        p lies in the plane of the object's normal and the lamp.
    measured : bool
        Whether its power is known; else `candela` is relative.
    """

    name: str
    place: np.ndarray
    axis: np.ndarray
    lobe: Lobe = field(default_factory=Lobe)
    candela: float = 1.0
    spectrum: np.ndarray = field(default_factory=lambda: np.zeros(len(GRID)))
    known: tuple[float, float] = (GRID[0], GRID[-1])
    size_mm: tuple[float, float] | None = None
    polariser: str | None = None
    filters: tuple[str, ...] = ()
    measured: bool = True
    modulation: float = 0.0
    flicker_hz: float = 100.0

    @property
    def angle_deg(self) -> float:
        """From the object's normal, degrees."""
        return float(np.degrees(np.arccos(self.place[2] / self.distance_mm)))

    @property
    def azimuth_deg(self) -> float:
        """From x towards y, degrees."""
        return float(np.degrees(np.arctan2(self.place[1], self.place[0])))

    @property
    def distance_mm(self) -> float:
        """From the object's middle."""
        return float(np.linalg.norm(self.place))

    def points(self, side: int = 5) -> tuple[np.ndarray, np.ndarray]:
        """Return points that shine in its stead, (n, 3) mm, and the share of each, of sum 1."""
        if self.size_mm is None:
            return self.place[None], np.ones(1)
        across = np.cross(self.axis, [0.0, 1.0, 0.0])
        across /= np.linalg.norm(across)
        up = np.cross(across, self.axis)
        nodes, weights = np.polynomial.legendre.leggauss(side)
        a, b = (g.ravel() for g in np.meshgrid(nodes, nodes))
        width, height = self.size_mm
        spread = 0.5 * (width * a[:, None] * across + height * b[:, None] * up)
        return self.place + spread, np.outer(weights, weights).ravel() / 4


@dataclass(frozen=True, eq=False)
class Lighting:
    """One setup: its lamps, and whether the camera looks through a sheet polariser."""

    name: str
    lamps: tuple[Lamp, ...]
    title: str = ""
    camera_polariser: str | None = None
    illuminance_lx: float | None = None

    @property
    def crossed(self) -> bool:
        """Whether camera and lamps are polarised at right angles."""
        return self.camera_polariser == "crossed"


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera in its place; `keys` are those of its table."""

    name: str
    keys: CameraKeys
    place: np.ndarray
    aim: np.ndarray
    labels: tuple[str, ...] = ()
    wavelengths: np.ndarray = field(default_factory=lambda: np.zeros(0))
    quantum: np.ndarray = field(default_factory=lambda: np.zeros((0, len(GRID))))
    seen: tuple[float, float] = (400.0, 720.0)

    @property
    def distance_mm(self) -> float:
        """From the point it aims at."""
        return float(np.linalg.norm(self.place - self.aim))


@dataclass(frozen=True, eq=False)
class Setup:
    """Everything of a setup file."""

    path: Path
    bench: Bench
    lightings: dict[str, Lighting]
    cameras: dict[str, Camera]
    spectra: dict[str, Spectrum]

    @property
    def object(self) -> ObjectKeys:
        """What is to be captured."""
        return self.bench.object

    def lighting(self, name: str | None = None) -> Lighting:
        """Return a lighting by name, the first without one.

        Raises
        ------
        PlanRefused
            Where there is none such.
        """
        if name is None:
            return next(iter(self.lightings.values()))
        if name not in self.lightings:
            raise PlanRefused(
                wrong(
                    str(self.path), "setups", "there is no such setup", name,
                    ", ".join(self.lightings),
                )
            )  # fmt: skip
        return self.lightings[name]


def load_setup(path: str | Path) -> Setup:
    """Read a setup file and put its lamps and cameras in their places.

    Raises
    ------
    PlanRefused
        With every problem: what is misspelt, out of range, contradicts itself, or cannot be meant.
    """
    from levkas.planning.warnings import find_doubts

    path = find_setup(path)
    bench = _validate(path)
    problems: list[Problem] = list(find_doubts(bench, str(path)))
    setup = _resolve(path, bench, problems)
    if setup is not None:
        from levkas.planning.checks import find_contradictions

        told = {p.field for p in problems}
        problems += [p for p in find_contradictions(setup) if p.field not in told]
    if problems or setup is None:
        raise PlanRefused(*dict.fromkeys(problems))
    return setup


def find_setup(path: str | Path) -> Path:
    """Return the setup file that a path means: itself, or the only TOML file of a folder.

    Raises
    ------
    PlanRefused
        Where a folder holds none or several.
    """
    path = Path(path).resolve()
    if not path.is_dir():
        return path
    found = sorted(path.glob("*.toml"))
    if len(found) != 1:
        raise PlanRefused(
            wrong(str(path), "", "which setup file is meant?", f"{len(found)} in that folder",
                  "one .toml file", "Name the file.")
        )  # fmt: skip
    return found[0]


def _validate(path: Path) -> Bench:
    from pydantic import ValidationError

    from levkas.campaign.schema.toml import TomlRefused, read_toml
    from levkas.planning.tables import Bench

    try:
        record = read_toml(path)
        return Bench.model_validate(record)
    except TomlRefused as refused:
        raise PlanRefused(*refused.problems) from None
    except ValidationError as invalid:
        from levkas.campaign.schema.error_messages import explain

        problems = explain(record, invalid.errors(), Bench)
        fix = "docs/planning.md explains every key."
        raise PlanRefused(
            *(replace(p, file=str(path), fix=p.fix or fix) for p in problems)
        ) from None


def _resolve(path: Path, bench: Bench, problems: list[Problem]) -> Setup | None:
    """Read spectra, place lamps and cameras; what is wrong is added to `problems`."""
    from levkas.planning.sensitivities import place_camera

    file, before = str(path), len(problems)
    spectra: dict[str, Spectrum] = {}
    lobes: dict[str, Lobe] = {}

    def attempt(make: Any) -> Any:
        try:
            return make()
        except PlanRefused as refused:
            problems.extend(refused.problems)
            return None

    for name, keys in bench.spectra.items():
        spectra[name] = attempt(lambda n=name, k=keys: read_spectrum(n, k, path.parent, file=file))
    for name, lamp in bench.lamps.items():
        lobes[name] = attempt(lambda n=name, k=lamp: read_lobe(n, k, path.parent, file=file))
    problems += _names(bench, file)
    if len(problems) > before:
        return None
    lightings = {n: _lighting(n, keys, bench, spectra, lobes) for n, keys in bench.setups.items()}
    cameras = {
        n: attempt(lambda n=n, k=keys: place_camera(n, k, bench, path.parent, file=file))
        for n, keys in bench.cameras.items()
    }
    if any(camera is None for camera in cameras.values()):
        return None
    return Setup(path, bench, lightings, cameras, spectra)


def _names(bench: Bench, file: str) -> list[Problem]:
    """Find names that lead nowhere, and lamps that stand nowhere."""
    found = []

    def known(where: str, name: str, names: Any, what: str) -> None:
        if name not in names:
            found.append(wrong(file, where, f"there is no such {what}", name, ", ".join(names)))

    for name, lamp in bench.lamps.items():
        known(f"lamps.{name}.spectrum", lamp.spectrum, bench.spectra, "spectrum")
        for filter_ in lamp.filters:
            known(f"lamps.{name}.filters", filter_, bench.spectra, "spectrum")
    for name, keys in bench.setups.items():
        for i, placed in enumerate(keys.lamps):
            at = f"setups.{name}.lamps.{i}"
            known(f"{at}.lamp", placed.lamp, bench.lamps, "lamp")
            for filter_ in placed.filters or ():
                known(f"{at}.filters", filter_, bench.spectra, "spectrum")
            by_angle = placed.angle_deg is not None and placed.distance_mm is not None
            if by_angle == (placed.place_mm is not None):
                found.append(
                    wrong(file, at, "a lamp has a place: angle_deg and distance_mm, or place_mm",
                          expected="one of the two")
                )  # fmt: skip
    return found


def lamp_place(angle_deg: float, azimuth_deg: float, distance_mm: float) -> np.ndarray:
    """Return where a lamp stands, mm, (3,).

    >>> lamp_place(70.0, 0.0, 2100.0).round().tolist()
    [1973.0, 0.0, 718.0]
    """
    angle, azimuth = np.radians(angle_deg), np.radians(azimuth_deg)
    sine = np.sin(angle)
    return distance_mm * np.array([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(angle)])


def aim_point(aim: Any, place: np.ndarray, size_mm: tuple[float, float]) -> np.ndarray:
    """Return the point on the object that a lamp aims at, mm, (3,).

    The far edge is where the line from the lamp's foot through the middle leaves the object.

    >>> aim_point("far edge", np.array([1973.0, 0.0, 718.0]), (420.0, 320.0)).tolist()
    [-210.0, 0.0, 0.0]
    """
    if not isinstance(aim, str):
        return np.array([aim[0], aim[1], 0.0])
    away = np.hypot(place[0], place[1])
    if aim == "middle" or away < 1e-6:
        return np.zeros(3)
    to_lamp = place[:2] / away
    reach = min(s / 2 / max(abs(c), 1e-9) for s, c in zip(size_mm, to_lamp, strict=True))
    sign = -1.0 if aim == "far edge" else 1.0
    return np.array([*(sign * reach * to_lamp + 0.0), 0.0])


def _lighting(
    name: str, keys: SetupKeys, bench: Bench, spectra: dict[str, Spectrum], lobes: dict[str, Lobe]
) -> Lighting:
    lamps = tuple(
        _lamp(f"{p.lamp} {i + 1}", p, bench.lamps[p.lamp], bench, spectra, lobes[p.lamp])
        for i, p in enumerate(keys.lamps)
    )
    return Lighting(name, lamps, keys.title, keys.camera_polariser, keys.illuminance_lx)


def _lamp(
    name: str, placed: PlacedLamp, keys: LampKeys, bench: Bench,
    spectra: dict[str, Spectrum], lobe: Lobe,
) -> Lamp:  # fmt: skip
    if placed.place_mm is not None:
        place = np.array(placed.place_mm)
    else:
        assert placed.angle_deg is not None and placed.distance_mm is not None
        place = lamp_place(placed.angle_deg, placed.azimuth_deg, placed.distance_mm)
    axis = aim_point(placed.aim, place, bench.object.size_mm) - place
    filters = keys.filters if placed.filters is None else placed.filters
    bare = spectra[keys.spectrum]
    power, known = bare.values * ((bare.known[0] <= GRID) & (bare.known[1] >= GRID)), bare.known
    luminous = integrate(power * eye())
    for filter_ in filters:
        sheet = spectra[filter_]
        power = power * sheet.values
        known = (max(known[0], sheet.known[0]), min(known[1], sheet.known[1]))
    passed = integrate(power * eye()) / luminous
    if placed.polariser:
        passed *= bench.sheets.transmittance
    flux = placed.share * (keys.power_w or 1.0) * keys.efficacy_lm_per_w * passed
    flicker = keys.flicker
    return Lamp(
        name, place, axis / max(float(np.linalg.norm(axis)), 1e-9), lobe,
        flux / lobe.solid_angle(), power / integrate(power * eye()), known, keys.size_mm,
        placed.polariser, filters, keys.power_w is not None,
        flicker.modulation if flicker else 0.0, flicker.frequency_hz if flicker else 100.0,
    )  # fmt: skip
