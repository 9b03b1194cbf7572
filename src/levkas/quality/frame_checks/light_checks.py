"""Checks of the light of a frame: exposure, black level, dark, white, drift, noise.

Each returns findings, none where all is well: what is wrong in one sentence, and what to do before the painting leaves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from levkas.calibration.lamp import measure_light
from levkas.calibration.templates import CalibrationRefused, Template
from levkas.calibration.white_area import LEAST, find_white_area
from levkas.calibration.whites import check_white
from levkas.quality.frame_checks.measures import SAMPLE, FrameMeasures

Severity = Literal["look", "stop"]
GOAL = 0.85
"""Share of the full scale that the white's brightest cell is to have: the paper's 85 %, see `planning.exposure_levels`."""
CLIPPED = {"white": (2e-4, 2e-3), "object": (0.01, 0.05)}
"""Share of a channel at full scale to look at, and to stop at: a white divides every frame, an object has highlights. Hot
sensels and cosmic rays are below 1e-4, glints of gold and varnish of a sound icon below 0.7 %."""
HOT, SCATTERS = 1e-4, 4.0
"""Share of sensels that are hot, and standard deviations that their number in a small frame may lie above it."""
NEAR_FULL, DIM_WHITE, DIM_OBJECT = 0.97, 0.06, 0.03
"""Of the full scale above black: a white's brightest cell that leaves no head-room, and brightest parts that leave most of
the scale unused."""
LEAK, LIFTED, BLACK_OFF, NOISES = (0.005, 0.1), 0.05, 0.002, 4.0
"""Of the full scale: unevenness of a dark, or its level, to look at and to stop at; an even level that is light and not
black; a change of black from the dark before; and that over the noise."""
UNEVEN, ROUGH, RELIT = 0.3, (0.06, 0.25), 0.04
"""A white's darkest cell over its median; rms about a smooth surface, to look at and to stop at; change of its shading from
the white before."""
SHOWN = (LEAST, 0.25)
"""Share of a white that shows the object: a build marks these pixels, and refuses from a half."""
DRIFT, STACK = (0.02, 0.1), 0.01
"""Relative change of the light between whites, to look at and to stop at; and within a stack, to look at."""
NOISIER, QUIET_COUNTS = 1.8, 0.6
"""Variance over that of frames of the same light; noise of fewer counts is rounding."""
SAME_TIME = 1.1
"""Larger over smaller of two exposures that are one: EXIF has the nominal 1/60 s for 1/64."""


@dataclass(frozen=True)
class FrameFinding:
    """One thing that is wrong with a frame.

    Parameters
    ----------
    check : str
        ``"exposure"``, ``"black"``, ``"dark"``, ``"white"``, ``"drift"``, ``"noise"``, ``"focus"``, ``"glare"``,
        ``"moved"``, ``"settings"``, ``"twice"`` or ``"file"``.
    severity : {"look", "stop"}
        Whether a person should look at it, or the frame cannot be used.
    text, advice : str
        What is wrong, and what to do now, a sentence each.
    """

    check: str
    severity: Severity
    text: str
    advice: str

    def to_dict(self) -> dict[str, str]:
        """Return the finding, JSON-ready."""
        return dict(vars(self))


def worst(findings: Sequence[FrameFinding]) -> str:
    """Return ``"green"``, ``"look"`` or ``"stop"``.

    >>> worst([]), worst([FrameFinding("noise", "look", "", ""), FrameFinding("white", "stop", "", "")])
    ('green', 'stop')
    """
    return next((s for s in ("stop", "look") if any(f.severity == s for f in findings)), "green")


def graded(value: float, limits: tuple[float, float]) -> Severity | None:
    """Return how bad a value is that should be small, by the limits of look and of stop."""
    return "stop" if value >= limits[1] else "look" if value >= limits[0] else None


def times(factor: float, exposure_s: float | None) -> str:
    """Return an exposure as advice: the factor, and the seconds where they are known.

    >>> times(0.5, 0.2), times(3.0, None)
    ('expose 0.5 times as long (0.1 s)', 'expose 3 times as long')
    """
    seconds = f" ({exposure_s * factor:.2g} s)" if exposure_s else ""
    return f"expose {factor:.2g} times as long{seconds}"


def check_exposure(
    frame: FrameMeasures,
    role: str,
    names: Sequence[str],
    *,
    black: float,
    full: float | None,
    exposure_s: float | None = None,
) -> list[FrameFinding]:
    """Check how much of the scale, from `black` to `full` counts, a white, object or chart uses; `names` are its channels'."""
    worst_one = int(frame.full_share.argmax())
    share = float(frame.full_share[worst_one])
    limits = CLIPPED["white" if role == "white" else "object"]
    limits = (max(limits[0], _hot_share(frame)), limits[1])
    where = f" in {names[worst_one]}" if len(names) > 1 else ""
    if (severity := graded(share, limits)) is not None:
        factor = 0.5 if share > 0.05 else 0.7
        return [
            FrameFinding(
                "exposure",
                severity,
                f"{percent(share)} of the {role} is at full scale{where}",
                f"capture it again: {times(factor, exposure_s)}, or dim the lamp",
            )
        ]
    if full is None or full <= black:
        return []
    used = (frame.cells.max((1, 2)) if role == "white" else frame.high) - black
    brightest = float(used.max()) / (full - black)
    factor = GOAL / max(brightest, 1e-6)
    if role == "white" and brightest > NEAR_FULL:
        text = f"the white reaches {percent(brightest)} of the full scale: a lamp that brightens clips it"
        return [
            FrameFinding("exposure", "look", text, f"capture it again: {times(factor, exposure_s)}")
        ]
    if brightest < (DIM_WHITE if role == "white" else DIM_OBJECT):
        text = f"the {role} uses {percent(max(brightest, 0))} of the scale, so noise is large"
        advice = "check the lamp, the shutter and the lens cap"
        if brightest > 0.002:
            advice = f"{times(factor, exposure_s)}, or check the lamp"
        return [FrameFinding("exposure", "look", text, advice)]
    return []


def _hot_share(frame: FrameMeasures) -> float:
    """Return the share of a channel up to which sensels at full scale may be hot ones: of 5,000 sensels three.

    Their number is Poisson's, so that in a small frame one or two are above the usual share; from 160,000 on it is below 2e-4.
    """
    sensels = min(float(np.prod(frame.shape / frame.period)), SAMPLE)
    return float(HOT + SCATTERS * np.sqrt(HOT / sensels))


def check_dark(
    dark: FrameMeasures,
    *,
    black: float | None,
    scale: float | None,
    before: FrameMeasures | None = None,
) -> list[FrameFinding]:
    """Check that a dark is dark, even, and as the one `before` it of the same time; `black` and `scale`, counts, are stated."""
    level = float(np.median(dark.level))
    noise = max(float(np.nanmedian(dark.noise)), QUIET_COUNTS)
    apart = dark.cells - np.median(dark.cells, (1, 2), keepdims=True)
    lit = float(np.quantile(apart, 0.95))
    above = level - black if black is not None else level - 0.25 * (scale or np.inf)
    is_light = bool(scale) and (lit >= LEAK[0] * (scale or 0) or above >= LIFTED * (scale or 0))
    severity = graded(max(lit, above) / scale, LEAK) if scale else None
    if severity is not None and not is_light:
        text = f"the black level is {level:.0f} counts, and {black:.0f} is stated"
        advice = "check ISO, gain and warm-up, or correct `black` in campaign.toml"
        return [FrameFinding("black", severity, text, advice)]
    if severity is not None:
        uneven = lit >= above
        text = f"the dark is not dark: {level:.0f} counts" + f", up to {level + lit:.0f}" * uneven
        advice = "cover the lens, switch the lamp off, and repeat"
        if uneven and severity == "look":
            advice += "; if it stays, it is the sensor's own glow, which the dark takes away"
        return [FrameFinding("dark", severity, text, advice)]
    if before is not None and before.level.shape == dark.level.shape:
        change = float(np.median(dark.cells.mean((1, 2)) - before.cells.mean((1, 2))))
        if abs(change) > max(BLACK_OFF * (scale or 0.0), NOISES * noise):
            text = f"the black level moved by {change:+.1f} counts since the dark before"
            advice = "let the camera warm up, then repeat the darks and the frames between"
            return [FrameFinding("black", "look", text, advice)]
    return []


def check_dark_time(exposure_s: float | None, darks: Sequence[float]) -> list[FrameFinding]:
    """Check that there is a dark of a frame's exposure, s; where no dark states one, nothing is known."""
    if exposure_s is None or not darks:
        return []
    if any(max(exposure_s, t) <= SAME_TIME * min(exposure_s, t) for t in darks if t > 0):
        return []
    there = ", ".join(f"{t:g}" for t in sorted(set(darks))[:4])
    text = f"there is no dark of {exposure_s:g} s; darks are of {there} s"
    advice = f"capture a dark of {exposure_s:g} s before the camera is moved or cools"
    return [FrameFinding("dark", "look", text, advice)]


def check_white_frame(
    white: FrameMeasures,
    *,
    black: float,
    before: FrameMeasures | None = None,
    scene: FrameMeasures | None = None,
) -> list[FrameFinding]:
    """Check that a white is lit, smooth, even, as the one `before` it of its band, and free of the object, its `scene`."""
    template = _template(white.picture)
    try:
        check_white(template, np.full((1, 1), black), None, None)
    except CalibrationRefused as refused:
        problem = refused.problems[0]
        advice = problem.fix or "capture the white again"
        return [FrameFinding("white", "stop", f"{problem.message}: {problem.found}", advice)]
    if scene is not None and (found := _painting_in(white, scene, black)):
        return [found]
    if (cells := _relative_cells(white, black)) is None:
        return []
    if before is not None and before.cells.shape == white.cells.shape:
        ratio = _ratio(white.cells - black, before.cells - black)
        ratio /= np.median(ratio)
        change = float(np.quantile(ratio, 0.98) - np.quantile(ratio, 0.02))
        if change > RELIT:
            text = f"the shading of the white changed by {percent(change)} since the white before"
            advice = "check whether a lamp was moved or something stands before it, and repeat"
            return [FrameFinding("white", "look", text, advice)]
        return []
    rough = white_roughness(white, black)
    if (severity := graded(rough, ROUGH)) is not None:
        text = f"the white is not smooth: {percent(rough)} rms about a smooth surface"
        advice = "let the board fill the frame, and take away what stands before it"
        return [FrameFinding("white", severity, text, advice)]
    least = float(np.quantile(cells, 0.02))
    if least < UNEVEN:
        text = f"the white is uneven: its darkest part has {percent(least)} of the middle"
        return [
            FrameFinding("white", "look", text, "move the lamps away, or aim them at the far edge")
        ]
    return []


def white_roughness(white: FrameMeasures, black: float) -> float:
    """Return the rms of a white's cells about the smooth surface that fits them best, relative; 0 of an unlit one."""
    cells = _relative_cells(white, black)
    return 0.0 if cells is None else float(np.sqrt(np.mean((cells - _surface(cells)) ** 2)))


def _relative_cells(white: FrameMeasures, black: float) -> np.ndarray | None:
    """Return the cells over their median, the mean of the channels that are lit; None where none is."""
    light = np.maximum(white.cells - black, 0)
    middle = np.median(light, (1, 2))
    lit = middle > 0
    return (light[lit] / middle[lit][:, None, None]).mean(0) if lit.any() else None


def check_drift(
    white: FrameMeasures, before: FrameMeasures, *, black: float, ratio_of_times: float = 1.0
) -> list[FrameFinding]:
    """Check how the light of a white changed since the white before, whose exposure is 1/`ratio_of_times` of its."""
    if white.cells.shape != before.cells.shape:
        return []
    change = float(np.median(_ratio(white.cells - black, before.cells - black))) / ratio_of_times
    severity = graded(abs(change - 1), DRIFT)
    if severity is None:
        return []
    text = f"the lamp gives {percent(abs(change - 1))} {'less' if change < 1 else 'more'} than at the white before"
    advice = "let the lamp settle, then capture white and object again"
    return [FrameFinding("drift", severity, text, advice)]


def check_stack(shot: FrameMeasures, first: FrameMeasures, *, black: float) -> list[FrameFinding]:
    """Check how the light changed between the first shot of a stack and this one."""
    if shot.cells.shape != first.cells.shape:
        return []
    cells = np.stack([one.cells.reshape(len(one.cells), -1) for one in (first, shot)])
    light = measure_light(cells, black)
    sure = light.error < STACK / 2
    if not sure.any():
        return []
    change = float(np.median((light.levels[1] / light.levels[0])[sure]))
    if abs(change - 1) < STACK:
        return []
    text = f"{percent(abs(change - 1))} {'less' if change < 1 else 'more'} light than in the first shot of the stack"
    return [
        FrameFinding("drift", "look", text, "wait until the lamp is steady, and repeat the stack")
    ]


def noise_ratio(frame: FrameMeasures, others: Sequence[FrameMeasures], black: float) -> float:
    """Return the variance of a frame over what others of its role have at its level; 1 where that is not known.

    Shot noise grows as the light: compared is the variance a count above `black` of whites and of shots of one scene, of
    darks, whose black is infinite here, the variance itself.
    """
    alike = [one for one in others if one.noise.shape == frame.noise.shape]
    if not alike:
        return 1.0
    own, of_others = _per_light(frame, black), [_per_light(o, black) for o in alike]
    # Of three, the odd one out is not the one that the two others are compared with.
    typical = np.median([own, *of_others] if len(alike) > 1 else of_others, 0)
    sure = np.isfinite(own) & np.isfinite(typical)
    sure &= np.min([one.noise for one in (frame, *alike)], 0) > QUIET_COUNTS
    return float(np.median(own[sure] / typical[sure])) if sure.any() else 1.0


def check_noise(
    frame: FrameMeasures, others: Sequence[FrameMeasures], black: float
) -> list[FrameFinding]:
    """Check that a frame has the noise of others: darks, whites, or shots of one scene."""
    ratio = noise_ratio(frame, others, black)
    if 1 / NOISIER <= ratio <= NOISIER:
        return []
    root = float(np.sqrt(ratio))
    if ratio > 1:
        advice = "check ISO and gain, the camera's temperature, and light that flickers"
        return [FrameFinding("noise", "look", f"{root:.1f} times the camera's noise", advice)]
    text = f"only {root:.1f} times the camera's noise"
    advice = "switch noise reduction off in the camera or in the tethering program"
    return [FrameFinding("noise", "look", text, advice)]


def _per_light(frame: FrameMeasures, black: float) -> np.ndarray:
    dim = frame.level - black < 20 * np.maximum(frame.noise, QUIET_COUNTS)
    return np.asarray(frame.noise**2 / np.where(dim, 1.0, frame.level - black))


def _painting_in(white: FrameMeasures, scene: FrameMeasures, black: float) -> FrameFinding | None:
    """Return the finding of a white that shows the object."""
    import cv2

    if white.picture.shape[0] * scene.picture.shape[1] == 0:
        return None
    size = scene.picture.shape[::-1]
    small = np.asarray(cv2.resize(white.picture, size, interpolation=cv2.INTER_AREA))
    level = np.full((1, 1), black)
    advice = "take the painting out of the frame, or cover it with the board, and repeat"
    try:
        area = find_white_area(_template(scene.picture), _template(small), (level, level))
    except CalibrationRefused as refused:
        problem = refused.problems[0]
        return FrameFinding("white", "stop", f"{problem.message}: {problem.found}", advice)
    if area.uncovered is None:
        return None
    share = float(area.uncovered.mean())
    if share < LEAST:
        return None
    severity = graded(share, SHOWN)
    return FrameFinding(
        "white", severity or "look", f"{percent(share)} of the white shows the object", advice
    )


def _template(picture: np.ndarray) -> Template:
    none = np.zeros(picture.shape, bool)
    return Template(picture.astype(np.float32), None, 1, none, none)


def _ratio(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    lit = other > 0.1 * np.median(other)
    return np.where(lit, one, 1.0)[lit] / other[lit]


def _surface(cells: np.ndarray) -> np.ndarray:
    """Return the polynomial of third order that fits a table of cells best."""
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in cells.shape), indexing="ij")
    terms = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], -1)
    design = terms.reshape(cells.size, -1)
    found = np.linalg.lstsq(design, cells.ravel(), rcond=None)[0]
    return np.asarray((design @ found).reshape(cells.shape))


def percent(share: float) -> str:
    """Return a share as messages give it.

    >>> percent(0.0412), percent(0.5), percent(0.0004)
    ('4.1 %', '50 %', '0.04 %')
    """
    return f"{100 * share:.2g} %" if share < 0.995 else f"{100 * share:.0f} %"
