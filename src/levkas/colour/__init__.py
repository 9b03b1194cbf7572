"""Colorimetry: the standard observer, illuminants, sRGB, gamut."""
