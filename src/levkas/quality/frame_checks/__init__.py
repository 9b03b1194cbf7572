"""Checks of single frames while a session lasts: what one shows by itself, and beside its companions.

`measure_frame` reduces a frame to some numbers and a small picture, `judge` compares those of one sensor. Nothing here
reads a file: a program that receives frames hands in their values.
"""

from levkas.quality.frame_checks.judging import FrameJudge, FrameOfSet, SetRules, judge
from levkas.quality.frame_checks.light_checks import FrameFinding, Severity, worst
from levkas.quality.frame_checks.measures import FrameMeasures, FramePictures, measure_frame

__all__ = [
    "FrameFinding",
    "FrameJudge",
    "FrameMeasures",
    "FrameOfSet",
    "FramePictures",
    "SetRules",
    "Severity",
    "judge",
    "measure_frame",
    "worst",
]
