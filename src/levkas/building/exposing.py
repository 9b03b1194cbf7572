"""Exposures of one sensor: an object's shots as one, its white, and the noise that both tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.building.bench import Bench, exposure_of
from levkas.building.exposure_times import doubt_scaling
from levkas.calibration.darks import SAME_TIME
from levkas.calibration.templates import CalibrationRefused, Template
from levkas.core.problems import Problem

if TYPE_CHECKING:
    from levkas.calibration.exposures import Merged
    from levkas.calibration.noise_fit import NoiseModel
    from levkas.campaign.discovery.captures import FrameRef


@dataclass(frozen=True)
class Exposed:
    """An object's frames as one; merged exposures are above dark, and say what moved."""

    shot: Template
    moved: np.ndarray | None = None


def average_shots(bench: Bench, frames: Sequence[FrameRef]) -> list[Template]:
    """Average the object's shots, exposure by exposure."""
    times = sorted({exposure_of(f) for f in frames}, key=lambda t: (t is not None, t or 0.0))
    if len(times) > 1 and bench.camera.exposures == "one":
        from levkas.campaign.discovery.captures import CaptureRefused

        raise CaptureRefused(
            Problem(
                "E_EXPOSURES",
                f"{bench.camera.name}: shots of several exposures",
                str(frames[0].path.parent),
                f"cameras.{bench.camera.name}.exposures",
                ", ".join(f"{t:g} s" for t in times if t),
                "one exposure",
                'Write exposures = "best" (the longest unsaturated) or "merge".',
            )
        )
    return [bench.average([f for f in frames if exposure_of(f) == t]) for t in times]


def expose(
    bench: Bench, shots: list[Template], darks: list[Template], noise: NoiseModel | None
) -> Exposed:
    """The object's frames as one: averaged, the best exposure, or all merged above dark."""
    from levkas.calibration.exposures import best_exposure

    if len(shots) == 1:
        return Exposed(shots[0])
    if bench.camera.exposures == "merge":
        merged = _merge(bench, shots, darks, noise)
        return Exposed(merged.template, moved=merged.moved)
    return Exposed(best_exposure(shots))


def _merge(
    bench: Bench, shots: list[Template], darks: list[Template], noise: NoiseModel | None
) -> Merged:
    """An exposure series in counts a second above dark."""
    from levkas.calibration.exposures import merge_exposures

    if bench.saturation is None:
        raise CalibrationRefused(
            Problem(
                "E_VALUE",
                f"{bench.camera.name}: exposures cannot be merged without a saturation level",
                field=f"cameras.{bench.camera.name}.saturation",
                fix="Declare `bits` or `saturation`.",
            )
        )
    pattern = bench.sensor.pattern
    more: dict[str, Any] = {"period": (len(pattern), len(pattern[0]))} if pattern else {}
    return merge_exposures(
        shots, darks, saturation=bench.saturation, black=bench.black, noise=noise, **more
    )


def white_of(
    bench: Bench,
    frames: Sequence[FrameRef],
    darks: list[Template],
    *,
    noise: NoiseModel | None = None,
    merged: bool = False,
) -> Template | None:
    """The white of one exposure, the best one; or several of them merged, above dark."""
    from levkas.calibration.exposures import best_exposure

    if not frames:
        return None
    whites = bench.templates(frames)
    if len(whites) == 1:
        return whites[0]
    return _merge(bench, whites, darks, noise).template if merged else best_exposure(whites)


def check_scaling(
    bench: Bench,
    exposed: Exposed,
    white: Template | None,
    series: Sequence[list[Template]],
    darks: list[Template],
) -> str:
    """Look whether counts may be scaled from the white's time to the object's, and say if that is not known.

    `series` are exposures of one scene each: the object's, the white's. A merge has been checked already.

    Raises
    ------
    CalibrationRefused
        E_EXPOSURES where a series shows that counts do not scale, with exposure and level.
    """
    from levkas.calibration.linearity import check_linearity, require_reciprocity

    taken, other = exposed.shot.exposure_s, white.exposure_s if white else None
    if exposed.shot.above_dark or not taken or not other or abs(taken / other - 1) <= SAME_TIME:
        return ""
    pattern = bench.sensor.pattern
    more: dict[str, Any] = {"period": (len(pattern), len(pattern[0]))} if pattern else {}
    hidden = bool(darks) and all(np.mean(dark.black) > 0.5 for dark in darks)
    for shots in series:
        if len(shots) < 2 or bench.saturation is None:
            continue
        found = check_linearity(
            shots, darks, saturation=bench.saturation, black=bench.black, fit_offset=hidden, **more
        )
        if found.points:
            require_reciprocity(found)
            return ""
    return doubt_scaling(bench, taken, other)


def noise_of(
    bench: Bench, shots: list[Template], whites: list[Template | None], darks: list[Template]
) -> NoiseModel | None:
    """Noise of the sensor from stacks, darks among them, or from single shots where there are no stacks."""
    from levkas.building.measuring import note_noise
    from levkas.calibration.noise_fit import fit_noise, fit_noise_single

    dark = darks[0] if darks else None
    stacks = [t for t in (*shots, *(w for w in whites if w is not None)) if t.count > 1]
    black = bench.black or 0.0
    fitted = None
    if stacks:
        stacks += [d for d in darks if d.count > 1]
        under = [_dark_of(t, darks) for t in stacks] if darks else None
        fitted = fit_noise(stacks, under, black=black, step=bench.step)
    unread = fitted is not None and not any(d.count > 1 for d in darks)
    if (fitted is None or unread) and len(shots) == len(whites):  # of a line scan there is no shot
        under = [_dark_of(t, darks) for t in shots] if darks else None
        more: dict[str, Any] = {"pattern": bench.sensor.pattern, "step": bench.step}
        single = fit_noise_single(shots, whites, under, black=black, **more)
        if fitted is None:
            fitted = single
        elif single is not None and fitted.read_variance <= fitted.step**2 / 12:
            fitted = replace(fitted, read_variance=single.read_variance)
    note_noise(bench.told, fitted, dark, black, bench.saturation)
    return fitted


def _dark_of(stack: Template, darks: Sequence[Template]) -> Template:
    """Return the dark nearest in time, a dark itself where it is one of them."""
    if any(stack is dark for dark in darks):
        return stack
    time = stack.exposure_s
    timed = [
        (abs(np.log(d.exposure_s / time)), i) for i, d in enumerate(darks) if time and d.exposure_s
    ]
    return darks[min(timed)[1] if timed else 0]
