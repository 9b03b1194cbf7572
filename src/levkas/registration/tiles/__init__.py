"""Tiles of one painting: placed beside one another by what they show both, and adjusted as one."""

from levkas.registration.tiles.placement import TilePlacement, place_tiles

__all__ = ["TilePlacement", "place_tiles"]
