"""The viewer: static pages in a published folder, for a browser and no server."""

from __future__ import annotations

from levkas.viewer.about import About
from levkas.viewer.run import write_viewer

__all__ = ["About", "write_viewer"]
