"""Control points that people set, read and written as their programs do."""

from levkas.registration.control_points.dialects import (
    DIALECTS,
    Dialect,
    format_points,
    losses,
    parse_points,
    read_points,
    sniff,
    write_points,
)
from levkas.registration.control_points.points import ControlPoints, PointsRefused

__all__ = [
    "DIALECTS",
    "ControlPoints",
    "Dialect",
    "PointsRefused",
    "format_points",
    "losses",
    "parse_points",
    "read_points",
    "sniff",
    "write_points",
]
