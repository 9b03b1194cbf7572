"""Spectra estimated from the channels of registered cameras, and their scores."""
