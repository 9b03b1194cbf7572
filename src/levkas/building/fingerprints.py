"""What every stage depends on: files, parameters and code, by names that a person understands."""

from __future__ import annotations

import hashlib
import json
from typing import TYPE_CHECKING, Any

from levkas.building.hand_points import told_points
from levkas.building.ledger import Hashes, Key, code_version

if TYPE_CHECKING:
    from levkas.campaign import Campaign
    from levkas.discovery import Capture

STAGES = ("calibrate", "register", "resample")
CALIBRATION_KEYS = (
    "kind", "bits", "black", "saturation", "exposures", "scan", "denoise", "demosaic",
)  # fmt: skip
CODE = {
    "calibrate": (
        "calibration",
        "readers",
        "rounding.py",
        "lanes.py",
        "double_lanes.py",
        "squares.py",
        "building/band_stacks.py",
        "building/bench.py",
        "building/developing.py",
        "building/exposing.py",
        "building/flatfielding.py",
        "building/line_templates.py",
        "building/passages.py",
        "building/scan_opening.py",
        "building/scans.py",
        "building/whiteboard.py",
        "building/measuring.py",
        "building/focusing.py",
        "radiometry/glare.py",
        "radiometry/light.py",
        "radiometry/sharpness.py",
    ),
    "register": (
        "registration",
        "building/registering.py",
        "building/hand_points.py",
        "control_points",
        "edits.py",
        "transforms.py",
        "spline.py",
        "ledge.py",
        "lanes.py",
        "map_kernels.py",
    ),
    "adjust": (
        "registration",
        "building/adjusting.py",
        "building/measured.py",
        "building/rig_mates.py",
        "transforms.py",
        "spline.py",
        "ledge.py",
    ),
    "resample": (
        "rounding.py",
        "building/streaming.py",
        "building/held_lines.py",
        "building/default_setup.py",
        "warping.py",
        "warping_kernels.py",
        "wide_kernels.py",
        "pixelmap.py",
        "taps.py",
        "lanes.py",
        "squares.py",
        "words.py",
        "spline.py",
        "ledge.py",
        "map_kernels.py",
        "gridding.py",
        "colour.py",
        "database",
        "transforms.py",
        "radiometry/glare.py",
        "radiometry/ranges.py",
    ),
    "report": (
        "reporting",
        "evaluation.py",
        "building/pages.py",
        "building/provenance.py",
        "declaring/toml.py",
        "building/radiometry_pages.py",
        "radiometry/places.py",
    ),
}


def digest(prints: dict[str, Any]) -> str:
    """Hash a fingerprint, so that what depends on it can name it."""
    text = json.dumps(prints, sort_keys=True, ensure_ascii=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def of_calibration(campaign: Campaign, capture: Capture, hashes: Hashes) -> dict[str, Any]:
    """Files, templates, keys of the camera and of its white."""
    camera = campaign.cameras[capture.camera]
    prints: dict[str, Any] = {"code": code_version(*CODE["calibrate"])}
    for key in CALIBRATION_KEYS:
        prints[f"cameras.{camera.name}.{key}"] = getattr(camera, key)
    white = campaign.targets.white
    if white:
        prints["targets.white.reflectance"] = white.reflectance
        if isinstance(white.reflectance, str) and (campaign.root / white.reflectance).is_file():
            prints[f"file {white.reflectance}"] = hashes(campaign.root / white.reflectance)
    for sensor in capture.sensors:
        where = (
            f"cameras.{camera.name}.sensors.{sensor.name}"
            if sensor.name
            else f"cameras.{camera.name}"
        )
        prints[f"{where}.pattern"] = (
            [list(row) for row in sensor.pattern] if sensor.pattern else None
        )
        prints[f"{where}.bands"] = [[band.label, str(band.wavelength)] for band in sensor.bands]
        for frame in (*sensor.object, *sensor.dark, *sensor.white):
            name = _relative(campaign, frame.path)
            prints[f"file {name}"] = hashes(frame.path)
    return _plain(prints)


def of_registration(
    campaign: Campaign, capture: Capture, calibrated: str, reference: str
) -> dict[str, Any]:
    """The calibrated bands of the capture and of the reference, [registration], what a hand corrected."""
    prints: dict[str, Any] = {
        "code": code_version(*CODE["register"]),
        "calibrated frames": calibrated,
        "frames of the reference": reference,
        "campaign.reference": campaign.reference.model_dump(),
        "grid.region": campaign.grid.model_dump()["region"] if campaign.grid else None,
    }
    for key, value in campaign.registration_of(capture.camera).items():
        prints[f"registration.{key}"] = value
    for sensor in capture.sensors:
        prints[f"sensors.{sensor.name}.align"] = sensor.align
    for band, edits in campaign.edits.of(capture.object, capture.layer).items():
        if told := edits.told():
            frame = f"{capture.layer}:{band}" if band else capture.layer
            prints[f"edits.toml: correction of {frame}"] = told
    prints |= told_points(campaign, capture)
    return _plain(prints)


def of_adjustment(own: str, mates: dict[str, str]) -> dict[str, Any]:
    """The capture's own registration, and those of all that it is adjusted with."""
    prints: dict[str, Any] = {"code": code_version(*CODE["adjust"]), "its own registration": own}
    prints |= {f"registration of {name}": made_of for name, made_of in mates.items()}
    return _plain(prints)


def of_resampling(
    campaign: Campaign, capture: Capture, registered: str, reference: str, *, default: str = ""
) -> dict[str, Any]:
    """The registration, the grid, what the files say of the object, and the default lighting's layer."""
    prints: dict[str, Any] = {
        "code": code_version(*CODE["resample"]),
        "registration": registered,
        "registration of the reference": reference,
    }
    if default:
        prints["layer under the default setup"] = default
    for key, value in (campaign.grid.model_dump() if campaign.grid else {}).items():
        prints[f"grid.{key}"] = value
    for key, value in _facts(campaign, capture.object).items():
        prints[f"objects.{capture.object}.{key}"] = value
    for key in ("creator", "date", "licence"):  # they stand in the files' own tags
        prints[f"campaign.{key}"] = getattr(campaign.campaign, key)
    return _plain(prints)


def of_report(campaign: Campaign, name: str, layers: dict[str, str]) -> dict[str, Any]:
    """Every layer of the object, and its museum facts."""
    prints: dict[str, Any] = {"code": code_version(*CODE["report"])}
    prints.update({f"layer {layer}": value for layer, value in layers.items()})
    for key, value in _facts(campaign, name).items():
        prints[f"objects.{name}.{key}"] = value
    for key in ("title", "creator", "date", "licence"):
        prints[f"campaign.{key}"] = getattr(campaign.campaign, key)
    return _plain(prints)


def _facts(campaign: Campaign, name: str) -> dict[str, Any]:
    facts = campaign.objects.get(name)
    return facts.model_dump() if facts else {}


def _relative(campaign: Campaign, path: Any) -> str:
    try:
        return str(path.relative_to(campaign.root).as_posix())
    except ValueError:
        return "/".join(path.parts[-3:])


def _plain(prints: dict[str, Any]) -> dict[str, Any]:
    """What JSON would make of it, so that a stored fingerprint equals a new one."""
    return dict(json.loads(json.dumps(prints, default=str)))


def keys_of(capture: Capture) -> dict[str, Key]:
    """Return the keys of a capture's stages, by stage."""
    return {s: Key(capture.object, capture.camera, capture.setup, s) for s in STAGES}
