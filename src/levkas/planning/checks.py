"""What a setup says against itself: lamps and cameras where they cannot be, light that is not known."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from levkas.planning.framing import image_of, in_field
from levkas.planning.refusals import asked, wrong
from levkas.planning.surface import height_range

if TYPE_CHECKING:
    from levkas.core.problems import Problem
    from levkas.planning.setup import Camera, Lamp, Setup

LAMP_BODY_MM = 60.0
"""Half the breadth of a lamp's body that a camera would see."""


def find_contradictions(setup: Setup) -> Iterator[Problem]:
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


def _lamp(setup: Setup, lamp: Lamp, at: str, file: str) -> Iterator[Problem]:
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


def _blind(setup: Setup, camera: Camera, file: str) -> Iterator[Problem]:
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


def _spectra(setup: Setup, file: str) -> Iterator[Problem]:
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
