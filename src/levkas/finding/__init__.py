"""From names of files to captures: patterns, folders, frames, sensors, bands."""
