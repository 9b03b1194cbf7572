"""Transforms, pixel maps, grids, and the one resampling."""
