"""Calibration: raw frames of one sensor to reflectance with flags and variance, arrays only."""
