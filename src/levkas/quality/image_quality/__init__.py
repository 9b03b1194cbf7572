"""Measures of images: sharpness, noise, dynamic range, glare, evenness of light."""
