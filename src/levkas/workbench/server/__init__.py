"""The local server of the workbench, behind its guard."""
