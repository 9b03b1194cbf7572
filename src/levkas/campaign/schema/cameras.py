"""What the keys of one camera say against one another."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

from levkas.campaign.discovery.patterns import Pattern
from levkas.campaign.schema.tables import CameraKeys, Range, Sensor
from levkas.core.problems import Problem

KEYS_OF_KINDS = {
    "pattern": ("mosaic", "bands"),
    "bands": ("mosaic", "bands", "cube", "image"),
    "demosaic": ("mosaic", "sensors"),
    "scan": ("cube",),
    "sensors": ("sensors",),
}
"""Camera keys that mean nothing elsewhere."""


def wrong(
    field: str, message: str, found: Any = None, expected: str | None = None, fix: str | None = None
) -> Problem:
    """Return a value's problem."""
    return Problem("E_VALUE", message, field=field, found=found, expected=expected, fix=fix)


def check_camera(where: str, camera: CameraKeys) -> Iterator[Problem]:
    """Yield what does not fit together in the table `where`, such as ``cameras.nir``."""
    for key, kinds in KEYS_OF_KINDS.items():
        if getattr(camera, key) and camera.kind not in kinds:
            per_sensor = key in ("pattern", "bands") and camera.kind == "sensors"
            yield wrong(
                f"{where}.{key}",
                f"a camera of kind {camera.kind!r} has no `{key}`",
                expected=" or ".join(f'kind = "{kind}"' for kind in kinds),
                fix="Write it in each [[sensors]] table." if per_sensor else "Take it out.",
            )
    if camera.kind == "sensors":
        yield from _sensors(where, camera)
    elif not camera.files:
        yield Problem("E_KEY", "files is required", field=f"{where}.files")
    for text in camera.files:
        yield from check_pattern(f"{where}.files", text, camera.kind)
    yield from _wavelengths(where, camera)
    yield from _channels(where, camera.pattern if camera.kind == "mosaic" else None, camera.bands)
    if camera.black is not None and camera.saturation and camera.black >= camera.saturation:
        yield wrong(
            f"{where}.black",
            "black is not below saturation",
            camera.black,
            f"< {camera.saturation:g}",
        )
    dark, white = set(camera.dark or ()), set(camera.white or ())
    if dark & white:
        yield wrong(f"{where}.white", "a template is dark and white at once", min(dark & white))


def _sensors(where: str, camera: CameraKeys) -> Iterator[Problem]:
    if not camera.sensors:
        yield Problem("E_KEY", "[[sensors]] tables are required", field=f"{where}.sensors")
    for name, count in Counter(s.name for s in camera.sensors).items():
        if count > 1:
            yield wrong(f"{where}.sensors.{name}", "two sensors have one name", name)
    for sensor in camera.sensors:
        at = f"{where}.sensors.{sensor.name}"
        if not sensor.files and not any("{sensor}" in text for text in camera.files):
            yield Problem(
                "E_KEY",
                "files is required",
                field=f"{at}.files",
                fix=f"Write it here, or {{sensor}} in {where}.files.",
            )
        for text in sensor.files:
            yield from check_pattern(f"{at}.files", text, camera.kind)
        yield from _channels(at, sensor.pattern, sensor.bands)
    yield from _sensor_alignment(where, camera.sensors)


def _sensor_alignment(where: str, sensors: tuple[Sensor, ...]) -> Iterator[Problem]:
    identity = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    if sensors and sensors[0].align not in ("measure", identity):
        yield wrong(
            f"{where}.sensors.{sensors[0].name}.align",
            "the first sensor is what the others are aligned to",
            fix="Take it out.",
        )


def check_pattern(field: str, text: str, kind: str) -> Iterator[Problem]:
    """Yield what is wrong with a pattern of files for a camera of some kind."""
    try:
        fields = Pattern.parse(text).fields
    except ValueError as error:
        yield wrong(field, str(error), text, "a pattern such as raw/NAME/{target}/{shot}.tif")
        return
    if "target" not in fields:
        yield wrong(field, "the pattern has no {target}", text, "raw/NAME/{target}/*.tif")
    for name in ("band", "wavelength"):
        if name in fields and kind != "bands":
            yield wrong(
                field, f"only a camera of kind 'bands' has {{{name}}}", text, fix="Write * instead."
            )
    if "sensor" in fields and kind != "sensors":
        yield wrong(
            field, "only a camera of kind 'sensors' has {sensor}", text, fix="Write * instead."
        )


def _wavelengths(where: str, camera: CameraKeys) -> Iterator[Problem]:
    centres, keys = camera.centres, camera.wavelengths
    if centres is None:
        return
    field = f"{where}.wavelengths"
    if not centres and isinstance(keys, Range):
        yield wrong(
            field,
            f"{keys.start:g} to {keys.stop:g} nm is no whole number of steps of {keys.step:g} nm",
        )
    elif not centres:
        yield wrong(field, "the list is empty", fix="Take it out: the files say their wavelengths.")
    elif len(set(centres)) < len(centres):
        yield wrong(field, "a wavelength stands there twice", Counter(centres).most_common(1)[0][0])
    elif camera.bands and len(camera.bands) != len(centres):
        yield Problem(
            "E_BAND_COUNT",
            "`bands` and `wavelengths` do not fit",
            field=field,
            found=f"{len(centres)} wavelengths",
            expected=f"{len(camera.bands)}, one a band",
        )
    elif not camera.bands and any("{band}" in text for text in camera.files):
        yield Problem(
            "E_KEY",
            "nothing says which band has which wavelength",
            field=f"{where}.bands",
            fix="Write `bands` in the order of `wavelengths`.",
        )


def _channels(
    where: str, pattern: tuple[tuple[str, ...], ...] | None, bands: tuple[str, ...] | None
) -> Iterator[Problem]:
    for name, count in Counter(bands or ()).items():
        if count > 1:
            yield Problem(
                "E_BAND_TWICE", "two bands have one name", field=f"{where}.bands", found=name
            )
    channels = {name for row in pattern or () for name in row}
    if pattern and bands and len(bands) != len(channels):
        yield Problem(
            "E_BAND_COUNT",
            "`bands` does not fit `pattern`",
            field=f"{where}.bands",
            found=len(bands),
            expected=f"{len(channels)}: {', '.join(sorted(channels))}",
        )
