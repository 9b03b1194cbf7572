"""Consistency checks of a setup: impossible places, unknown light, values hardly meant."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from levkas.planning.framing import image_of, in_field
from levkas.planning.surface import height_range
from levkas.planning.tables import asked, wrong

if TYPE_CHECKING:
    from levkas.core.problems import Problem
    from levkas.planning.setup import StudioCamera, StudioLamp, StudioSetup
    from levkas.planning.tables import Bench

LAMP_BODY_MM = 60.0
"""Half the breadth of a lamp's body that a camera would see."""


def find_contradictions(setup: StudioSetup) -> Iterator[Problem]:
    """Yield everything that cannot be built or computed as it stands."""
    file = str(setup.path)
    bench = setup.bench
    thing = bench.object
    if thing.recess_mm and 2 * (thing.border_mm + thing.bevel_mm) >= min(thing.size_mm):
        yield wrong(
            file, "object.border_mm", "the border leaves no picture", thing.border_mm,
            f"less than {min(thing.size_mm) / 2 - thing.bevel_mm:g} mm",
        )  # fmt: skip
    for camera in setup.cameras.values():
        yield from _blind(setup, camera, file)
    for name, lighting in setup.lightings.items():
        for i, lamp in enumerate(lighting.lamps):
            yield from _lamp(setup, lamp, f"setups.{name}.lamps.{i}", file)
        polarised = [lamp.polariser for lamp in lighting.lamps]
        if lighting.camera_polariser and not all(polarised):
            yield wrong(
                file, f"setups.{name}.camera_polariser",
                "a sheet before the camera crosses nothing: a lamp has none",
                lighting.camera_polariser, 'polariser = "p" at every lamp',
            )  # fmt: skip
    yield from _spectra(setup, file)


def _lamp(setup: StudioSetup, lamp: StudioLamp, at: str, file: str) -> Iterator[Problem]:
    highest = height_range(setup.object)[1]
    if lamp.place[2] <= highest:
        yield wrong(
            file, at, "this lamp stands behind the panel, or in its plane",
            f"{lamp.place[2]:.0f} mm before the object's middle (angle {lamp.angle_deg:.0f}°)",
            f"more than {highest:.0f} mm; below 88° from the normal",
            "Lower angle_deg, or give z > 0 in place_mm.", "E_LAMP_BEHIND",
        )  # fmt: skip
        return
    for camera in setup.cameras.values():
        place = image_of(camera, lamp.place)
        if place is not None and in_field(camera, lamp.place, LAMP_BODY_MM):
            yield wrong(
                file, at, f"this lamp stands in the view of camera {camera.name!r}",
                f"{lamp.place.round().tolist()} mm",
                f"outside its field, or beyond {camera.distance_mm:.0f} mm",
                "Move it aside: a larger angle_deg or distance_mm.", "E_LAMP_IN_VIEW",
            )  # fmt: skip
        elif _in_the_way(lamp.place, camera.place):
            yield wrong(
                file, at, f"camera {camera.name!r} stands between this lamp and the object",
                f"lamp at {lamp.angle_deg:.0f}°", "a clear path", "Move the lamp aside.",
                "E_LAMP_HIDDEN",
            )  # fmt: skip


def _in_the_way(lamp: np.ndarray, camera: np.ndarray) -> bool:
    along = float(camera @ lamp / (lamp @ lamp))
    return 0 < along < 1 and float(np.linalg.norm(camera - along * lamp)) < 80.0


def _blind(setup: StudioSetup, camera: StudioCamera, file: str) -> Iterator[Problem]:
    at = f"cameras.{camera.name}"
    keys = camera.keys
    if camera.distance_mm <= keys.focal_mm:
        if keys.distance_mm is not None and 10 * keys.distance_mm > 2 * keys.focal_mm:
            yield asked(
                file, f"{at}.distance_mm", keys.distance_mm, f"> {keys.focal_mm:g} mm, the focal length",
                f"{10 * keys.distance_mm:g} mm (centimetres)",
            )  # fmt: skip
        else:
            yield wrong(
                file, f"{at}.distance_mm", "a lens forms no image nearer than its focal length",
                round(camera.distance_mm, 1), f"> {keys.focal_mm:g} mm", code="E_CAMERA_BLIND",
            )  # fmt: skip
        return
    if camera.place[2] <= height_range(setup.object)[1]:
        yield wrong(
            file, f"{at}.place_mm", "this camera cannot see the object: it stands behind it",
            camera.place.round().tolist(), "z > 0", code="E_CAMERA_BLIND",
        )  # fmt: skip
        return
    w, h = setup.object.size_mm
    probes = [np.array([x, y, 0.0]) for x in (-w / 2, 0, w / 2) for y in (-h / 2, 0, h / 2)]
    if not any(in_field(camera, p, 0.0) for p in probes):
        yield wrong(
            file, f"{at}.aim_mm", "this camera cannot see the object: it looks past it",
            camera.aim[:2].tolist(), f"a point within {w:g} x {h:g} mm", code="E_CAMERA_BLIND",
        )  # fmt: skip


def _spectra(setup: StudioSetup, file: str) -> Iterator[Problem]:
    for name, lighting in setup.lightings.items():
        for i, lamp in enumerate(lighting.lamps):
            for camera in setup.cameras.values():
                low, high = camera.seen
                if lamp.known[0] > low + 1 or lamp.known[1] < high - 1:
                    parts = ", ".join(
                        f"{n} {s.known[0]:g}–{s.known[1]:g} nm"
                        for n, s in setup.spectra.items()
                        if n in lamp.filters
                        or n == setup.bench.lamps[lamp.name.rpartition(" ")[0]].spectrum
                    )
                    yield wrong(
                        file, f"setups.{name}.lamps.{i}.spectrum",
                        f"the light is not known where camera {camera.name!r} sees", parts,
                        f"{low:g}–{high:g} nm",
                        "Give a table that covers it, or leave the camera out.", "E_SPD_COVER",
                    )  # fmt: skip


LEAST_OBJECT_MM, MOST_OBJECT_MM = 80.0, 5000.0
FARTHEST_MM = 20_000.0
NEAREST_BY_SIZE = 1.2
"""A lamp nearer than this many times the object's longer side cannot light it evenly."""


def find_doubts(bench: Bench, file: str) -> Iterator[Problem]:
    """Yield a question for every value whose unit cannot be right; `sure = true` answers it."""
    longest = max(bench.object.size_mm)
    yield from _object(bench, file)
    for name, setup in bench.setups.items():
        for i, lamp in enumerate(setup.lamps):
            if lamp.sure:
                continue
            at = f"setups.{name}.lamps.{i}"
            away = lamp.distance_mm
            if lamp.place_mm is not None:
                away = float(np.linalg.norm(lamp.place_mm))
            if away is not None:
                key = "place_mm" if lamp.place_mm else "distance_mm"
                yield from _distance(
                    file, f"{at}.{key}", away, NEAREST_BY_SIZE * longest, key == "distance_mm"
                )
            if lamp.angle_deg is not None and 0 < lamp.angle_deg < np.pi / 2:
                yield asked(
                    file, f"{at}.angle_deg", lamp.angle_deg, "degrees from the normal, 5 to 89",
                    f"{np.degrees(lamp.angle_deg):.0f} degrees (it looks like radians)",
                )  # fmt: skip
    yield from _cameras(bench, file)


def _object(bench: Bench, file: str) -> Iterator[Problem]:
    thing = bench.object
    longest = max(thing.size_mm)
    bent = thing.bend
    if not thing.sure and not LEAST_OBJECT_MM <= longest <= MOST_OBJECT_MM:
        unit = 10 if longest < LEAST_OBJECT_MM else 0.1
        w, h = (f"{unit * v:g}" for v in thing.size_mm)
        unit_name = "centimetres" if unit == 10 else "tenths of a millimetre"
        yield asked(
            file, "object.size_mm", list(thing.size_mm), "80 to 5,000 mm",
            f"[{w}, {h}] mm ({unit_name})",
            "Write the size in mm, or `sure = true` in [object] if it is so.",
        )  # fmt: skip
    if bent and bent.radius_mm < longest / 2:
        yield asked(
            file, "object.bend.radius_mm", bent.radius_mm, f"> {longest / 2:g} mm",
            f"{10 * bent.radius_mm:g} mm (centimetres) or {1000 * bent.radius_mm:g} mm (metres)",
        )  # fmt: skip
    if thing.recess_mm > 25 and not thing.sure:
        yield asked(
            file, "object.recess_mm", thing.recess_mm, "0 to 25 mm",
            f"{thing.recess_mm / 1000:g} mm (micrometres)",
        )  # fmt: skip


def _distance(file: str, field: str, found: float, least: float, single: bool) -> Iterator[Problem]:
    if found < least:
        if found < 25:
            meant, unit = 1000 * found, "metres"
        else:
            meant, unit = 10 * found, "centimetres"
    elif found > FARTHEST_MM:
        meant, unit = found / 10, "tenths of a millimetre"
    else:
        return
    what = f"{meant:g} mm ({found:g} {unit})" if single else unit
    yield asked(
        file, field, round(found, 1), f"{least:g} to {FARTHEST_MM:g} mm", what,
        f"Write {meant:g} if that is meant, or `sure = true` beside it if {found:g} mm is.",
    )  # fmt: skip


def _cameras(bench: Bench, file: str) -> Iterator[Problem]:
    longest = max(bench.object.size_mm)
    for name, camera in bench.cameras.items():
        if camera.sure:
            continue
        at = f"cameras.{name}"
        if camera.distance_mm is not None and camera.distance_mm > camera.focal_mm:
            yield from _distance(
                file, f"{at}.distance_mm", camera.distance_mm, 0.75 * longest, True
            )
        if not 6 <= camera.focal_mm <= 1500:
            yield asked(
                file, f"{at}.focal_mm", camera.focal_mm, "6 to 1,500 mm",
                f"{10 * camera.focal_mm:g} mm (centimetres)",
            )  # fmt: skip
        if not 0.8 <= camera.pitch_um <= 60:
            scale = 1000 if camera.pitch_um < 0.8 else 0.001
            yield asked(
                file, f"{at}.pitch_um", camera.pitch_um, "0.8 to 60 µm",
                f"{scale * camera.pitch_um:g} µm",
            )  # fmt: skip
        if not 0.7 <= camera.f_number <= 64:
            yield asked(file, f"{at}.f_number", camera.f_number, "0.7 to 64", "the f-number")
        bands = camera.wavelengths
        if bands is not None and not 200 <= bands.start < bands.stop <= 2500:
            yield asked(
                file, f"{at}.wavelengths", f"{bands.start:g} to {bands.stop:g}", "200 to 2,500 nm",
                "micrometres" if bands.stop < 100 else "ångström",
            )  # fmt: skip
