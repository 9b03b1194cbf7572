"""Tiles of one painting: placed beside one another by what they show both, and adjusted as one."""

from levkas.registration.tiles.placement import place_tiles
from levkas.registration.tiles.tile_record import TilePlacement

__all__ = ["TilePlacement", "place_tiles"]
