"""Setup files: validated, lamps and cameras placed, contradictions refused."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Problem
from levkas.planning.setup import (
    Lighting,
    StudioCamera,
    StudioLamp,
    StudioSetup,
    aim_point,
    lamp_place,
    lobe_exponent,
)
from levkas.planning.spectra import GRID, Spectrum, eye, integrate, read_spectrum, read_table
from levkas.planning.tables import (
    Bench,
    LampKeys,
    PlacedLamp,
    PlanRefused,
    SetupKeys,
    value_problem,
)

if TYPE_CHECKING:
    from levkas.planning.tables import StudioCameraKeys


def load_setup(path: str | Path) -> StudioSetup:
    """Read a setup file and put its lamps and cameras in their places."""
    path = find_setup(path)
    bench = _validate(path)
    problems: list[Problem] = []
    setup = _resolve(path, bench, problems)
    if setup is not None:
        fields = {p.field for p in problems}
        problems += [p for p in find_contradictions(setup) if p.field not in fields]
    if problems or setup is None:
        raise PlanRefused(*dict.fromkeys(problems))
    return setup


def find_setup(path: str | Path) -> Path:
    """Return the setup file that a path means: itself, or the only TOML file of a folder."""
    path = Path(path).resolve()
    if not path.is_dir():
        return path
    found = sorted(path.glob("*.toml"))
    if len(found) != 1:
        raise PlanRefused(
            value_problem(str(path), "", "which setup file is meant?", f"{len(found)} in that folder",
                  "one .toml file", "Name the file.")
        )  # fmt: skip
    return found[0]


def _validate(path: Path) -> Bench:
    from pydantic import ValidationError

    from levkas.campaign.schema.toml import TomlRefused, read_toml

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


def _resolve(path: Path, bench: Bench, problems: list[Problem]) -> StudioSetup | None:
    """Read spectra, place lamps and cameras; what is wrong is added to `problems`."""
    file, before = str(path), len(problems)
    spectra: dict[str, Spectrum] = {}

    def attempt(make: Any) -> Any:
        try:
            return make()
        except PlanRefused as refused:
            problems.extend(refused.problems)
            return None

    for name, keys in bench.spectra.items():
        spectra[name] = attempt(lambda n=name, k=keys: read_spectrum(n, k, path.parent, file=file))
    problems += _names(bench, file)
    if len(problems) > before:
        return None
    lightings = {n: _lighting(n, keys, bench, spectra) for n, keys in bench.setups.items()}
    cameras = {
        n: attempt(lambda n=n, k=keys: place_camera(n, k, bench, path.parent, file=file))
        for n, keys in bench.cameras.items()
    }
    if any(camera is None for camera in cameras.values()):
        return None
    return StudioSetup(path, bench, lightings, cameras)


def _names(bench: Bench, file: str) -> list[Problem]:
    """Find names that lead nowhere."""
    found = []

    def known(where: str, name: str, names: Any, what: str) -> None:
        if name not in names:
            found.append(
                value_problem(file, where, f"there is no such {what}", name, ", ".join(names))
            )

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
    return found


def _lighting(name: str, keys: SetupKeys, bench: Bench, spectra: dict[str, Spectrum]) -> Lighting:
    lamps = tuple(
        _lamp(f"{p.lamp} {i + 1}", p, bench.lamps[p.lamp], bench, spectra)
        for i, p in enumerate(keys.lamps)
    )
    return Lighting(name, lamps, keys.title, keys.camera_polariser, keys.illuminance_lx)


def _lamp(
    name: str, placed: PlacedLamp, keys: LampKeys, bench: Bench, spectra: dict[str, Spectrum]
) -> StudioLamp:
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
    flux = (keys.power_w or 1.0) * keys.efficacy_lm_per_w * passed
    # A soft light without a beam follows Lambert's law.
    beam = 1.0 if keys.size_mm else 0.0
    exponent = beam if keys.beam_deg is None else lobe_exponent(keys.beam_deg)
    return StudioLamp(
        name, place, axis / max(float(np.linalg.norm(axis)), 1e-9), exponent,
        flux * (exponent + 1) / (2 * np.pi), power / integrate(power * eye()), known, keys.size_mm,
        placed.polariser, filters, keys.power_w is not None,
    )  # fmt: skip


FAINT = 0.01
"""Share of its peak below which a sensitivity need not be covered by a lamp's spectrum."""


def place_camera(
    name: str, keys: StudioCameraKeys, bench: Bench, root: Path, *, file: str
) -> StudioCamera:
    """Return a camera in its place."""
    at = f"cameras.{name}"
    if keys.sensitivity is None:
        return StudioCamera(name, keys, *_bands(keys))
    w, table, labels = read_table(root / keys.sensitivity, field=f"{at}.sensitivity", file=file)
    if keys.wavelengths is not None:
        return StudioCamera(name, keys, *_tuned(keys, w, table[:, 0]))
    labels = labels or [f"C{i + 1}" for i in range(table.shape[1])]
    table = np.maximum(table, 0) * keys.peak_qe / max(table.max(), 1e-12)
    quantum = np.stack([np.interp(GRID, w, c, left=0, right=0) for c in table.T])
    centres = quantum @ GRID / np.maximum(quantum.sum(1), 1e-12)
    strong = (table >= FAINT * table.max(0)).any(1)
    range_nm = (float(w[strong][0]), float(w[strong][-1]))
    _check_sensors(keys, labels, f"{at}.sensors", file)
    return StudioCamera(name, keys, tuple(labels), centres, quantum, range_nm)


def _check_sensors(keys: StudioCameraKeys, labels: list[str], field: str, file: str) -> None:
    named = [label for sensor in keys.sensors for label in sensor]
    if named and sorted(named) != sorted(labels):
        raise PlanRefused(
            value_problem(file, field, "the sensors do not share the channels out", ", ".join(named),
                  f"each of {', '.join(labels)} once")
        )  # fmt: skip


def _bands(
    keys: StudioCameraKeys,
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray, tuple[float, float]]:
    """Gaussian bands over the peak efficiency, or one flat channel where no bands are given."""
    if keys.wavelengths is None:
        flat = np.where((GRID >= 400) & (GRID <= 720), keys.peak_qe, 0.0)
        return ("grey",), np.array([560.0]), flat[None], (400.0, 720.0)
    return _tuned(keys, np.array([GRID[0], GRID[-1]]), np.ones(2))


def _tuned(
    keys: StudioCameraKeys, w: np.ndarray, efficiency: np.ndarray
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray, tuple[float, float]]:
    """Return bands of a tunable filter: Gaussians under the sensor's own efficiency."""
    assert keys.wavelengths is not None
    centres = np.array(keys.wavelengths.values())
    width = keys.fwhm_nm / 2.3548
    shapes = np.exp(-0.5 * ((GRID - centres[:, None]) / width) ** 2)
    held = np.interp(GRID, w, efficiency) * keys.peak_qe / efficiency.max()
    reach = keys.fwhm_nm
    range_nm = (float(centres[0] - reach / 2), float(centres[-1] + reach / 2))
    return tuple(f"{c:g} nm" for c in centres), centres, shapes * held, range_nm


def find_contradictions(setup: StudioSetup) -> Iterator[Problem]:
    """Yield everything that cannot be built or computed as it stands."""
    file = str(setup.path)
    bench = setup.bench
    thing = bench.object
    if thing.recess_mm and 2 * (thing.border_mm + thing.bevel_mm) >= min(thing.size_mm):
        yield value_problem(
            file, "object.border_mm", "the border leaves no picture", thing.border_mm,
            f"less than {min(thing.size_mm) / 2 - thing.bevel_mm:g} mm",
        )  # fmt: skip
    for camera in setup.cameras.values():
        if camera.distance_mm <= camera.keys.focal_mm:
            yield value_problem(
                file, f"cameras.{camera.name}.distance_mm",
                "a lens forms no image nearer than its focal length", camera.distance_mm,
                f"> {camera.keys.focal_mm:g} mm", code="E_CAMERA_BLIND",
            )  # fmt: skip
    for name, lighting in setup.lightings.items():
        polarised = [lamp.polariser for lamp in lighting.lamps]
        if lighting.camera_polariser and not all(polarised):
            yield value_problem(
                file, f"setups.{name}.camera_polariser",
                "a sheet before the camera crosses nothing: a lamp has none",
                lighting.camera_polariser, 'polariser = "p" at every lamp',
            )  # fmt: skip
    yield from _spectra(setup, file)


def _spectra(setup: StudioSetup, file: str) -> Iterator[Problem]:
    for name, lighting in setup.lightings.items():
        for i, lamp in enumerate(lighting.lamps):
            for camera in setup.cameras.values():
                low, high = camera.range_nm
                if lamp.known[0] > low + 1 or lamp.known[1] < high - 1:
                    yield value_problem(
                        file, f"setups.{name}.lamps.{i}.spectrum",
                        f"the light is unknown over the wavelengths of camera {camera.name!r}",
                        f"{lamp.known[0]:g}–{lamp.known[1]:g} nm",
                        f"{low:g}–{high:g} nm",
                        "Give a table that covers it, or leave the camera out.", "E_SPD_COVER",
                    )  # fmt: skip
