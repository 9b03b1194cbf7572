"""Building a database: the one place where the stages meet."""

from levkas.building.graph import BuildReport, Step, summarise
from levkas.building.run import build, status

__all__ = ["BuildReport", "Step", "build", "status", "summarise"]
