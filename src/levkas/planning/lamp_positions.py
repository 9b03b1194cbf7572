"""Positions of the lamps as they hang, from a captured white."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.templates import Template
from levkas.core.problems import Problem, Refused, unknown_name
from levkas.core.text import counted
from levkas.planning.campaign_frames import files_of, not_known, scale_of, stack_of
from levkas.planning.framing import plan_framing
from levkas.planning.lamp_fit import SPREAD, FittedLamps, fit_lamps
from levkas.planning.loading import load_setup
from levkas.planning.setup import StudioSetup, drop, illuminate
from levkas.planning.tables import PlanRefused, value_problem
from levkas.readers.frames import read_facts

if TYPE_CHECKING:
    from levkas.planning.setup import Lighting, StudioLamp

EXPLAINED = 0.015  # rms that a white board, its noise and dust leave beside the lamps


@dataclass(frozen=True, eq=False)
class FittedPositions:
    """Lamps fitted to a white, beside their plan.

    Parameters
    ----------
    fitted : FittedLamps
    measured_drop : float
        Of the white, vignetting of the lens included.
    size_mm : (width, height)
        Of the part of the board that the frame shows.
    frames : int
    notes : tuple of str
        Doubts, and advice.
    """

    fitted: FittedLamps
    measured_drop: float
    size_mm: tuple[float, float]
    frames: int
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for `--json`."""
        return {
            "setup": self.fitted.lighting.name,
            "residual": self.fitted.residual,
            "explained": self.fitted.residual <= EXPLAINED,
            "drop": self.fitted.drop,
            "planned_drop": self.fitted.planned_drop,
            "measured_drop": self.measured_drop,
            "size_mm": list(self.size_mm),
            "frames": self.frames,
            "lamps": lamp_rows(self.fitted.lighting.lamps),
            "uncertainties": [asdict(error) for error in self.fitted.errors],
            "light_at_middle": light_at_middle(self.fitted.lighting.lamps),
            "moved": list(self.fitted.moved),
            "notes": list(self.notes),
        }


def lamp_rows(lamps: Sequence[StudioLamp]) -> list[dict[str, Any]]:
    """Return lamps as a setup file would place them; shares are of the strongest."""
    strongest = max(lamp.candela for lamp in lamps)
    rows = []
    for lamp in lamps:
        target = lamp.place - lamp.axis * lamp.place[2] / min(lamp.axis[2], -1e-6)
        rows.append(
            {
                "lamp": lamp.name.rpartition(" ")[0],
                "angle_deg": round(lamp.angle_deg, 1),
                "azimuth_deg": round(lamp.azimuth_deg, 1),
                "distance_mm": round(lamp.distance_mm),
                "aim": [round(float(target[0])), round(float(target[1]))],
                "share": round(lamp.candela / strongest, 3),
            }
        )
    return rows


def light_at_middle(lamps: Sequence[StudioLamp]) -> list[float]:
    """Return the light of each lamp at the board's middle, over that of the strongest there.

    A white determines this well, also where it cannot separate power from distance.
    """
    middle, facing = np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]])
    given = [float(illuminate([lamp], middle, facing)[0]) for lamp in lamps]
    return [round(g / max(given), 3) for g in given]


@dataclass(frozen=True)
class CapturedWhite:
    """White frames of one camera under a lighting, with their black, saturation and region.

    Parameters
    ----------
    frames : sequence of path
        Frames, or folders of them; averaged.
    darks : sequence of path
        Frames or folders; without them `black` is subtracted.
    black, saturation : float, optional
        Counts; default the file's own.
    bits : int, optional
        Of the converter; default as file or campaign declare.
    region : (x, y, width, height), optional
        Native pixels that show the board; the whole frame without it.
    camera : str, optional
        Whose planned field the frames show; without it the region shows just the object's size.
    """

    frames: Sequence[str | Path]
    darks: Sequence[str | Path] = ()
    black: float | None = None
    saturation: float | None = None
    bits: int | None = None
    region: Box | None = None
    camera: str | None = None


def fit_white(
    setup: str | Path | StudioSetup,
    white: CapturedWhite,
    name: str | None = None,
    *,
    lamp: int | None = None,
    bent: bool = False,
) -> FittedPositions:
    """Fit the lamps of a lighting to captured whites.

    Parameters
    ----------
    setup : path or StudioSetup
    white : CapturedWhite
    name : str, optional
        Of the lighting that was hung; the first without one.
    lamp : int, optional
        The only one of the lighting's lamps that shone, from 1: its place is then found far better.
    bent : bool
        The board is bent as the object is.

    Raises
    ------
    WhiteRefused
        E_BITS where the full scale is not known; E_NO_FRAMES, E_REGION, E_WHITE_SATURATED, E_WHITE_DARK.
    PlanRefused
        Where setup, lighting or camera are not there or cannot be planned.
    """
    setup = setup if isinstance(setup, StudioSetup) else load_setup(setup)
    lighting = _shining(setup, setup.lighting(name), lamp)
    files = files_of(white.frames)
    stack, floor = average_whites(
        files, files_of(white.darks), white.black, white.saturation, white.bits
    )
    box = check_region(white.region, stack.mean.shape, str(files[0]))
    light = thin_white(stack, floor, box, str(files[0]))
    size, centre, doubts = _shown(setup, white.camera, stack.mean.shape, box)
    thing = setup.object.model_copy(update={"size_mm": size})
    fitted = fit_lamps(light, lighting, thing, is_bent=bent, centre_mm=centre)
    notes = (*doubts, *_notes(lighting, fitted))
    return FittedPositions(fitted, drop(light), size, len(files), notes)


def _shining(setup: StudioSetup, lighting: Lighting, lamp: int | None) -> Lighting:
    """Return a lighting with the one lamp that shone."""
    if lamp is None:
        return lighting
    count = len(lighting.lamps)
    if not 1 <= lamp <= count:
        place = f"setups.{lighting.name}.lamps"
        raise PlanRefused(
            value_problem(str(setup.path), place, "there is no such lamp", lamp, f"1 to {count}")
        )
    return replace(lighting, lamps=(lighting.lamps[lamp - 1],))


def positions_text(found: FittedPositions) -> str:
    """Return what a white shows in lines, the lamps as a setup file would have them."""
    fitted = found.fitted
    lines = [
        f"{fitted.lighting.name}: the light drops by {100 * fitted.drop:.1f} % over the board, planned "
        f"{100 * fitted.planned_drop:.1f} %; the white itself by {100 * found.measured_drop:.1f} %, lens included",
        f"  lamps and lens explain the white to {100 * fitted.residual:.2f} % rms "
        f"({counted(found.frames, 'frame')})",
        *(f"  {words}" for words in fitted.moved),
        *(f"  {words}" for words in found.notes),
        "",
        "As they hang, for the setup file:",
    ]
    for row in lamp_rows(fitted.lighting.lamps):
        keys = ", ".join(
            f'{k} = "{v}"' if isinstance(v, str) else f"{k} = {v}" for k, v in row.items()
        )
        lines.append(f"  {{ {keys} }},")
    return "\n".join(lines)


def _notes(plan: Lighting, fitted: FittedLamps) -> list[str]:
    notes = []
    if fitted.residual > EXPLAINED:
        notes.append(
            f"More than {100 * EXPLAINED:.1f} % is left: other light in the room, a board that is not flat, "
            "clean or whole in the frame, or another lighting than this one."
        )
    lamps = fitted.lighting.lamps
    given = light_at_middle(lamps)
    if min(given) < 0.95:
        notes.append(
            f"{lamps[int(np.argmin(given))].name} gives the middle {100 * (1 - min(given)):.0f} % "
            "less light than the strongest: bring it nearer, or dim the other."
        )
    for planned, lamp in zip(plan.lamps, lamps, strict=True):
        turned = abs(lamp.angle_deg - planned.angle_deg)
        if turned > 2.5 * SPREAD["angle"]:
            notes.append(
                f"{lamp.name} would stand {turned:.0f}° from its plan, which is implausible: measure the angle. "
                "The lens, or a white that is not flat, may imitate uneven light."
            )
    if len(lamps) > 1:
        notes.append(
            "One white cannot separate a strong far lamp from a weak near one: what it does not determine is kept from the plan. "
            "A white under each lamp alone (--lamp 1, --lamp 2) tells each one's place two or three times better."
        )
    return notes


def _shown(
    setup: StudioSetup, camera: str | None, shape: tuple[int, ...], box: Box
) -> tuple[tuple[float, float], tuple[float, float], list[str]]:
    """Return size and centre, mm, of what the box shows, and what to doubt."""
    x, y, width, height = box
    rows, columns = shape[:2]
    whole = setup.object.size_mm
    if camera is None:
        ratio = width / height / (whole[0] / whole[1])
        doubts = []
        if not 0.85 < ratio < 1.18:
            doubts.append(
                f"The white is {width} x {height} pixels, the object {whole[0]:g} x {whole[1]:g} mm: name the "
                "camera, or give the region that the object takes."
            )
        return whole, (0.0, 0.0), doubts
    if camera not in setup.cameras:
        what, file = "there is no such camera", str(setup.path)
        raise PlanRefused(unknown_name(what, camera, setup.cameras, file=file, field="cameras"))
    field = next(f.field_mm for f in plan_framing(setup) if f.camera == camera)
    doubts = []
    if not 0.9 < columns / rows / (field[0] / field[1]) < 1.11:
        doubts.append(
            f"The frame is {columns} x {rows} pixels, the field of {camera} {field[0]:.0f} x {field[1]:.0f} mm: "
            "is it this camera's, and not turned?"
        )
    scale = field[0] / columns, field[1] / rows
    centre = (x + width / 2 - columns / 2) * scale[0], (y + height / 2 - rows / 2) * scale[1]
    return (width * scale[0], height * scale[1]), centre, doubts


TOLERATED = 1e-3  # share of pixels at saturation: glints and hot sensels
CELLS = 24  # columns to which a white is thinned: light has no detail, dust and noise have
PERIODS = (60, 12, 1)  # of mosaics, common multiples: blocks then hold all channels alike

Box = tuple[int, int, int, int]


class WhiteRefused(Refused):
    """A white from which the lamps cannot be fitted."""


def average_whites(
    files: list[Path],
    darks: list[Path],
    black: float | None,
    saturation: float | None,
    bits: int | None = None,
) -> tuple[Template, np.ndarray | float]:
    """Average whites; return them and what is to be subtracted.

    Raises WhiteRefused, ``E_BITS`` where the code at which they clip is not known.
    """
    if not files:
        raise WhiteRefused(
            Problem(
                "E_NO_FRAMES", "there is no white", expected="one frame or more, or their folder"
            )
        )
    facts = read_facts(files[0])
    scale = scale_of(files, facts, bits=bits, saturation=saturation, white=True)
    if scale is None and np.dtype(facts.dtype).kind in "ui":
        raise WhiteRefused(not_known(files[0], facts))
    full = scale.full.counts if scale else None
    stack = stack_of(files, saturation=full)
    if not darks:
        levels = (black, scale.black if scale else None, facts.black)
        return stack, next((level for level in levels if level is not None), 0.0)
    dark = stack_of(darks)
    if dark.mean.shape != stack.mean.shape:
        raise WhiteRefused(
            Problem(
                "E_SIZE", "the dark has another size than the white", str(darks[0]),
                found=str(dark.mean.shape), expected=str(stack.mean.shape),
                fix="Take both with the same camera and settings.",
            )
        )  # fmt: skip
    return stack, dark.mean


def check_region(region: Box | None, shape: tuple[int, ...], file: str) -> Box:
    """Return x, y, width, height; of the whole frame without a region."""
    rows, columns = shape[:2]
    if region is None:
        return 0, 0, columns, rows
    x, y, width, height = region
    if min(x, y) < 0 or min(width, height) < 8 or x + width > columns or y + height > rows:
        raise WhiteRefused(
            Problem("E_REGION", "the region does not lie in the frame", file, "region", str(region),
                    f"within {columns} x {rows} pixels, 8 or more each way",
                    "Give x,y,width,height in native pixels.")
        )  # fmt: skip
    return region


def thin_white(stack: Template, floor: np.ndarray | float, box: Box, file: str) -> np.ndarray:
    """Return the light on a coarse grid: medians of blocks, which dust and hot sensels do not move."""
    x, y, width, height = box
    cut = np.s_[y : y + height, x : x + width]
    clipped = float(np.mean(stack.saturated[cut]))
    if clipped > TOLERATED:
        raise WhiteRefused(
            Problem("E_WHITE_SATURATED", "the white clips, so that its shape is lost", file,
                    found=f"{clipped:.1%} of its values at saturation", expected=f"{TOLERATED:.1%} at most",
                    fix="Expose for less, or give the right --saturation.")
        )  # fmt: skip
    values = (stack.mean - floor)[cut].astype(np.float64)
    light = _thinned(values.reshape(height, width, -1))
    if light.min() <= 0:
        raise WhiteRefused(
            Problem("E_WHITE_DARK", "parts of the white are not above the black level", file,
                    found=f"{light.min():.1f} counts above it", expected="more than 0",
                    fix="Give the board's place as --region, and the camera's own darks.")
        )  # fmt: skip
    return light


def _thinned(values: np.ndarray) -> np.ndarray:
    """Return medians of blocks, (rows, columns), of a frame (h, w, samples).

    Each phase of a mosaic and each channel is scaled to one mean first: among unlike values a median
    would jump from one to the other.
    """
    height, width, samples = values.shape
    period = next(p for p in PERIODS if p == 1 or min(width, height) >= 12 * p)
    rows, columns = height // period, width // period
    cells = values[: rows * period, : columns * period]
    cells = cells.reshape(rows, period, columns, period, samples)
    gain = cells.mean((0, 2))
    level = max(float(gain.mean()), 1e-12)
    cells = cells * np.divide(level, gain, out=np.ones_like(gain), where=gain > 0)[:, None]
    block = max(1, -(-columns // CELLS))
    rows, columns = rows // block * block, columns // block * block
    cells = cells[:rows, :, :columns].reshape(
        rows // block, block * period, columns // block, block * period * samples
    )
    return np.median(cells, axis=(1, 3))
