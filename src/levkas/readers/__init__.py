"""Readers: native frames and what their headers declare, nothing changed and nothing invented."""
