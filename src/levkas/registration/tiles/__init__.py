"""Tiles of one painting: placed beside one another by what they show both, and adjusted as one."""

from levkas.registration.tiles.overlaps import NoOverlap, OverlapWindows, measure_overlap
from levkas.registration.tiles.placement import TilePlacement, place_tiles
from levkas.registration.tiles.search import correlate_tiles, similarity

__all__ = [
    "NoOverlap", "OverlapWindows", "TilePlacement", "correlate_tiles", "measure_overlap", "place_tiles",
    "similarity",
]  # fmt: skip
