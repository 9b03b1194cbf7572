"""Layers of a database in the formats of other programs: ``levkas export DATABASE --for envi``."""

from __future__ import annotations

from levkas.publish.export.run import FORMS, Exported, export

__all__ = ["FORMS", "Exported", "export"]
