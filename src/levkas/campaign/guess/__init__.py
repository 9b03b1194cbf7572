"""Guess a campaign.toml from a folder of captures, every guess with its reason."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.campaign.guess.proposal import LookRefused
from levkas.core.problems import Problem
from levkas.core.text import missing_path

if TYPE_CHECKING:
    from levkas.campaign.guess.proposal import Proposal

__all__ = ["LookRefused", "look", "write_campaign"]

FILE = "campaign.toml"


def look(folder: str | Path) -> Proposal:
    """Guess a campaign from the names, headers and numbers of the files below a folder.

    Nothing is written. What the files do not show is listed as unknown.

    Returns
    -------
    proposal : Proposal
        `text` is a whole campaign.toml with comments, `to_dict()` its content.

    Raises
    ------
    LookRefused
        Where there is no image that can be read.
    """
    from levkas.campaign.guess.listing import list_captures
    from levkas.campaign.guess.proposal import propose
    from levkas.readers.frames import EXPECTED

    if (absent := missing_path(Path(folder))) is not None:
        raise LookRefused(absent)
    listing = list_captures(folder)
    if not listing.captures:
        kinds = Counter(Path(name).suffix.lower() or name for name in listing.others)
        others = ", ".join(f"{n} {suffix}" for suffix, n in kinds.most_common(5))
        unreadable = [f"{name}: {why}" for name, why in list(listing.unreadable.items())[:3]]
        raise LookRefused(
            Problem(
                "E_NO_FRAMES",
                "no readable capture was found here",
                file=str(folder),
                found="; ".join([*([others] if others else []), *unreadable]) or "no files",
                expected=EXPECTED,
                fix="Give the folder that holds the raw frames.",
            )
        )
    return propose(listing)


def write_campaign(proposal: Proposal) -> Path:
    """Write the proposal as campaign.toml into the folder that was looked at.

    Raises
    ------
    LookRefused
        ``E_EXISTS`` where there is one.
    WriteRefused
        Where the disk refuses.
    """
    from levkas.core.files import write_text

    path = proposal.root / FILE
    if path.exists() or path.is_symlink():
        raise LookRefused(
            Problem(
                "E_EXISTS",
                "a campaign.toml exists already",
                file=str(path),
                fix="Move it, or copy what you need from the proposal by hand.",
            )
        )
    write_text(path, proposal.text)
    return path
