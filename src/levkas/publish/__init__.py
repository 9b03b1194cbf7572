"""Publications: a database described, in two sizes, as tiles, as a bag."""

from __future__ import annotations

from levkas.publish.publication import Publication, PublishRefused

__all__ = ["Publication", "PublishRefused"]
