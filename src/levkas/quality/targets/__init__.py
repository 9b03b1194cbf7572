"""Colour charts and slanted edges: found, measured, rated; arrays in, numbers out."""
