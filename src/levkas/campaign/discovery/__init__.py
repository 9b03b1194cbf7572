"""Captures of a campaign found among its files."""
