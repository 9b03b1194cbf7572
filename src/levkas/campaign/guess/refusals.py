"""What a look at a folder refuses."""

from __future__ import annotations

from levkas.core.problems import Refused


class LookRefused(Refused):
    """A folder holds nothing that a campaign could be made of, or already has one."""
