"""Checks of the picture of a frame: focus, whether it moved, glare."""

from __future__ import annotations

import numpy as np

from levkas.calibration.sight import shift_between
from levkas.quality.frame_checks.light_checks import (
    ROUGH,
    FrameFinding,
    graded,
    percent,
    white_roughness,
)
from levkas.quality.frame_checks.measures import FrameMeasures

BLURRED, UNLIKE_BLURRED = (1.4, 2.2), (2.5, 5.0)
"""Blur over that of the sharpest shot of the same band and exposure, to look at and to stop at; of another object or band,
whose edges are others and which the lens focuses otherwise."""
DETAIL_LEFT = (0.75, 0.35)
"""Share of the fine detail of the sharpest shot of a stack, below which to look at it and to stop: 0.75 is lost by a blur of
0.5 px more."""
DETAIL_STEP, BLUR_STEP = 0.05, 0.1
"""Share of detail, and px of blur, by which a shot must differ from the one before it for its focus to run somewhere."""
LEAST_BLUR, UNLIKE_BLUR = 0.4, 1.5
"""Px more than the sharpest frame has: less is the scatter of the measure."""
TREMBLED_PX = 0.75
"""Native px between shots that are averaged, to look at; a build refuses `differing_shots.MOVED_PX`."""
BETWEEN_BANDS = (4.0, 0.006)
"""Px, and share of the width: what filters and the lens may shift one band against the next at most."""
GLARE, ABOVE_WHITE, OTHER_LIGHT = (0.01, 0.06), 1.15, 0.3
"""Share of the picture above the white, to look at and to stop at; reflectance that no paint has; share from which it is
the white that is wrong."""


def check_focus(
    frame: FrameMeasures,
    best: FrameMeasures,
    before: FrameMeasures | None = None,
    *,
    same_scene: bool = True,
) -> list[FrameFinding]:
    """Check the focus against the sharpest frame of its camera: of the same object, band and exposure where there are others.

    `before` is the shot before it of these: it tells whether the focus runs away or comes back.
    """
    if same_scene and np.isfinite(best.fine):
        left = float(np.nan_to_num(frame.fine)) / float(best.fine)
        severity = graded(1 - left, (1 - DETAIL_LEFT[0], 1 - DETAIL_LEFT[1]))
        if severity is None:
            return []
        way = ""
        if before is not None:
            step = left - float(np.nan_to_num(before.fine)) / float(best.fine)
            way = _way(-step, DETAIL_STEP)
        text = f"{percent(max(left, 0))} of the fine detail of the sharpest shot is left{way}"
        return [FrameFinding("focus", severity, text, "focus again at this band, and repeat")]
    blur, least = float(frame.blur_px), float(best.blur_px)
    apart = LEAST_BLUR if same_scene else UNLIKE_BLUR
    if not (np.isfinite(blur) and np.isfinite(least)) or blur < least + apart:
        return []
    severity = graded(blur / least, BLURRED if same_scene else UNLIKE_BLURRED)
    if severity is None:
        return []
    way = ""
    if before is not None and np.isfinite(before.blur_px):
        way = _way(blur - float(before.blur_px), BLUR_STEP)
    text = f"edges are blurred by {blur:.1f} px, {least:.1f} px in the sharpest frame{way}"
    return [FrameFinding("focus", severity, text, "focus again at this band, and repeat")]


def _way(worse: float, least: float) -> str:
    return (
        ", and getting worse" if worse > least else ", and getting better" if worse < -least else ""
    )


def check_moved(
    frame: FrameMeasures, other: FrameMeasures, *, same_band: bool, full: float | None = None
) -> list[FrameFinding]:
    """Check whether camera or object moved since another frame of the same scene."""
    shift = shift_between(frame.sight, other.sight, full)
    if shift is None:
        return []
    distance = float(np.hypot(*shift))
    least = max(BETWEEN_BANDS[0], BETWEEN_BANDS[1] * float(frame.shape[1]))
    limits = (TREMBLED_PX, np.inf) if same_band else (least, 4 * least)
    severity = graded(distance, limits)
    if severity is None:
        return []
    what = "the shot before" if same_band else "the band before"
    text = f"the picture moved by {distance:.1f} px against {what}"
    advice = "check tripod, stage and table, and repeat from the first shot"
    return [FrameFinding("moved", severity, text, advice)]


def check_glare(
    frame: FrameMeasures, white: FrameMeasures, *, black: float, ratio_of_times: float = 1.0
) -> list[FrameFinding]:
    """Check how much of an object is brighter than the white, whose exposure is 1/`ratio_of_times` of its.

    A white that is a picture of something shows no glare: it is named itself.
    """
    import cv2

    if frame.cells.shape != white.cells.shape or white_roughness(white, black) >= ROUGH[1]:
        return []
    size = frame.picture.shape[::-1]
    board = np.asarray(cv2.resize(white.picture, size, interpolation=cv2.INTER_AREA)) - black
    lit = board > 0.1 * np.median(board)
    if not lit.any():
        return []
    share = float(np.mean((frame.picture - black)[lit] > ABOVE_WHITE * ratio_of_times * board[lit]))
    severity = graded(share, GLARE)
    if severity is None:
        return []
    if share > OTHER_LIGHT:
        text = f"{percent(share)} of the picture is brighter than the white: the white has other light or exposure"
        advice = "capture a white under this light and with this exposure"
        return [FrameFinding("white", "stop", text, advice)]
    text = f"{percent(share)} of the picture is brighter than the white: glare"
    advice = "move the lamps further to the side, or shade what they mirror in; for gold it may be all right"
    return [FrameFinding("glare", severity, text, advice)]
