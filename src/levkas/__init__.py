"""Levkas: raw captures of a painting to one calibrated, registered spectral image database."""

__version__ = "0.1.0"
