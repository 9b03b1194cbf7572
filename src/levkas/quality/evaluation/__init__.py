"""Errors against truth, structural similarity, loop closure."""
