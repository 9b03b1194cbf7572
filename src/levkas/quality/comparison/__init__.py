"""Methods of registration side by side: ours, the paper's, its opponents and today's peers."""

from levkas.quality.comparison.methods import COMPARED, ComparedMethod
from levkas.quality.comparison.table import Comparison, KnownPositions, compare

__all__ = ["COMPARED", "ComparedMethod", "Comparison", "KnownPositions", "compare"]
