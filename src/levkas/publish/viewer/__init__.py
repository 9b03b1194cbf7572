"""The viewer: static pages in a published folder, for a browser and no server."""

from __future__ import annotations

from levkas.publish.viewer.pages import About
from levkas.publish.viewer.run import write_viewer

__all__ = ["About", "write_viewer"]
