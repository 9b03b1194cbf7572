"""Building a database: the one place where the stages meet."""

from levkas.building.run import build, status
from levkas.building.steps import BuildReport, Step, summarise

__all__ = ["BuildReport", "Step", "build", "status", "summarise"]
