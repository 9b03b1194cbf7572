"""Presets of simulated campaigns: size, content, difficulty."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from levkas.core.problems import Problem, Refused, unknown_name
from levkas.simulation.cameras import CameraModel, camera_models

REFERENCE = ("lctf-vis", "550 nm")
OTHER_SETUPS = ("45-degree", "crossed", "soft", "d65")
UNEVEN_DEG, MOST_UNEVEN_DEG = 5.0, 15.0


@dataclass(frozen=True)
class Preset:
    """Size, content and difficulty of a campaign.

    Parameters
    ----------
    scale : float
        Pixels a side over those of the real cameras.
    thin : bool
        Fewer bands, shots and templates, as in `cameras.camera_models`.
    charts : bool
        A colour chart before every camera.
    supersampling : int
        Sub-pixels a pixel and axis.
    fineness : float
        Least samples of the painting per mm.
    tilt_deg, roll_deg, shift_mm : float
        Spread of how cameras stand and paintings lie.
    depth_mm, radius_mm : (least, most)
        Of the panel.
    full_well : float, optional
        Electrons of all sensors; few for much noise.
    scanner_turn_deg : float
        The line scanner turned about its axis: 90 scans along the other side.
    wobble : (float, float), optional
        Amplitude and period, lines, of the unevenness of the line scanner's travel; else the camera's own.
    own_pigments : bool
        Every painting after the first has the pigments of another workshop.
    unevenness_deg : float, optional
        How far ground and leaf lean, as in a setup file of the planner; 0 is an even panel with a
        varnish that mirrors. Left out, it is 5 where lightings are compared, else 0.
    overlap : float
        Share of a tile that its neighbour sees too.
    stage_mm, stage_deg : float
        Spread of where a stage stops, of its height a fourth, and of how the camera leans there.
    stage_turn_deg : float
        Spread of the stage's axes about the camera's.
    """

    scale: float = 0.32
    thin: bool = False
    charts: bool = True
    supersampling: int = 3
    fineness: float = 6.0
    tilt_deg: float = 0.6
    roll_deg: float = 0.5
    shift_mm: float = 3.0
    depth_mm: tuple[float, float] = (2.5, 4.0)
    radius_mm: tuple[float, float] = (2500.0, 5000.0)
    bevel_mm: float = 7.0
    twist_mm: float = 0.6
    full_well: float | None = None
    scanner_turn_deg: float = 0.0
    wobble: tuple[float, float] | None = None
    own_pigments: bool = False
    unevenness_deg: float | None = None
    overlap: float = 0.25
    stage_mm: float = 0.5
    stage_deg: float = 0.05
    stage_turn_deg: float = 0.4


PRESETS: dict[str, Preset] = {
    "default": Preset(),
    "small": Preset(scale=0.3, thin=True, charts=False, fineness=5.0),
    "full": Preset(scale=1.0, charts=False),
    # A linear SNR of 15 where the panel reflects a fifth.
    "hard": Preset(
        tilt_deg=3.0, roll_deg=4.0, shift_mm=8.0, depth_mm=(4.5, 6.0), radius_mm=(1800.0, 3000.0),
        bevel_mm=0.5, twist_mm=1.5, full_well=1600.0, scanner_turn_deg=90.0,
    ),
}  # fmt: skip


class SimulationRefused(Refused):
    """Options under which no campaign can be simulated."""


def refusal(message: str, field: str, found: object, expected: str) -> SimulationRefused:
    """Return a refusal of one option."""
    return SimulationRefused(
        Problem("E_VALUE", message, field=field, found=found, expected=expected)
    )


def choose_preset(preset: str | Preset, *, scale: float | None, objects: int) -> Preset:
    """Return a preset by name, at another scale where one is given; raises `SimulationRefused`."""
    if isinstance(preset, str):
        if preset not in PRESETS:
            what = "there is no such preset"
            raise SimulationRefused(unknown_name(what, preset, PRESETS, field="preset"))
        preset = PRESETS[preset]
    if scale is not None:
        preset = replace(preset, scale=scale)
    if not 0 < preset.scale <= 1:
        raise refusal("the scale is out of range", "scale", preset.scale, "0 < scale <= 1")
    lean = preset.unevenness_deg
    if lean is not None and not 0 <= lean <= MOST_UNEVEN_DEG:
        expected = f"0 <= unevenness <= {MOST_UNEVEN_DEG:g}"
        raise refusal("the unevenness is out of range", "unevenness", lean, expected)
    if objects < 1:
        raise refusal("a campaign needs an object", "objects", objects, "1 or more")
    # At full size sub-pixels are as fine as the painting's samples with two a side already.
    return replace(preset, supersampling=2) if preset.scale > 0.6 else preset


def choose_tiles(
    models: Mapping[str, CameraModel], tiles: str | Sequence[str] | None, overlap: float
) -> dict[str, CameraModel]:
    """Return cameras of which some capture in tiles.

    Parameters
    ----------
    tiles : str or sequence of str, optional
        ``"3x4"``: rows and columns of every camera that takes frames; ``"d80=3x4"``: of one, ``"v10=1x3"``: passes of the line scanner.
    overlap : float
        Share of a tile that its neighbour sees too.

    Raises
    ------
    SimulationRefused
        For a text that is no such number, and an unknown camera.
    """
    made = dict(models)
    if not 0.02 <= overlap <= 0.6:
        raise refusal("the overlap is out of range", "overlap", overlap, "0.02 to 0.6")
    for text in (tiles,) if isinstance(tiles, str) else tiles or ():
        name, _, count = text.rpartition("=")
        found = re.fullmatch(r"([1-9]\d?)x([1-9]\d?)", count.strip())
        if found is None:
            raise refusal(
                "these are no tiles", "tiles", text, "ROWSxCOLUMNS, or CAMERA=ROWSxCOLUMNS"
            )
        if name and name not in models:
            raise refusal("no camera has this name", "tiles", name, ", ".join(models))
        rows, columns = map(int, found.groups())
        for one in [name] if name else [n for n, model in models.items() if not model.scan]:
            made[one] = models[one].tiled(rows, columns, overlap)
    return made


def choose_setups(setups: bool | Sequence[str]) -> tuple[str, ...]:
    """Return the lightings besides the cameras' own; raises `SimulationRefused` on unknown ones."""
    wanted = (OTHER_SETUPS[:1] if setups else ()) if isinstance(setups, bool) else tuple(setups)
    unknown = [name for name in wanted if name not in OTHER_SETUPS]
    if unknown:
        what = "there is no such lighting"
        raise SimulationRefused(unknown_name(what, unknown[0], OTHER_SETUPS, field="setup"))
    return tuple(dict.fromkeys(wanted))


def choose_cameras(preset: Preset, cameras: Sequence[str] | None) -> dict[str, CameraModel]:
    """Return the cameras of a preset at its scale; raises `SimulationRefused` on unknown ones."""
    models = camera_models(thin=preset.thin)
    wanted = list(models) if cameras is None else list(cameras)
    unknown = [c for c in wanted if c not in models]
    if unknown:
        what = "there is no such camera"
        raise SimulationRefused(unknown_name(what, unknown[0], models, field="cameras"))
    result = {}
    for name, model in models.items():
        if name not in wanted and name != REFERENCE[0]:
            continue
        if model.scan and abs(preset.scanner_turn_deg % 180 - 90) < 45:
            model = replace(model, width=model.height, height=model.width)
        if preset.full_well is not None:
            sensors = tuple(
                replace(s, noise=replace(s.noise, dark=8.0, gain=4035 / preset.full_well,
                                         full_well=1.02 * preset.full_well))
                for s in model.sensors
            )  # fmt: skip
            model = replace(model, sensors=sensors)
        model = model.scaled(preset.scale)
        if model.scan and preset.wobble is not None:
            size, period = preset.wobble
            model = replace(model, wobble=(size, period / model.sampling, model.wobble[2]))
        result[name] = model
    return result
