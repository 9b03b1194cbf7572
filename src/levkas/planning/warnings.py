"""Values that are possible but hardly meant: they are asked about, never mended silently."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from levkas.planning.refusals import asked

if TYPE_CHECKING:
    from levkas.core.problems import Problem
    from levkas.planning.tables import Bench

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
