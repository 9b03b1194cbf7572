"""A capture whose target is known, and what frames of one sensor share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from levkas.campaign.guess.listing import Seen
from levkas.campaign.guess.words import GENERIC, Token, role_in

TARGET = "{target}"
STEM, PARENT = -1, -2
"""Places of the target that are no folder below the root: in the file's own name; the root's name."""
TYPED = ("time", "wavelength", "exposure")


@dataclass(frozen=True)
class Named:
    """A capture whose target is known.

    Parameters
    ----------
    seen : Seen
    target : str
    role : str
        ``"dark"``, ``"white"``, ``"chart"`` or ``"object"``.
    folders : tuple of str
        With ``{target}`` where a folder is the target.
    stem : tuple of Token
        With one token of kind ``"target"`` where the name says it.
    """

    seen: Seen
    target: str
    role: str
    folders: tuple[str, ...]
    stem: tuple[Token, ...]


def signature(seen: Seen) -> tuple[object, ...]:
    """What all frames of one sensor share: size (of a scan the width), channels, kind of number."""
    shape = seen.facts.shape
    if seen.facts.kind == "envi":
        return ("envi", shape[1], shape[2], seen.facts.dtype)
    return (shape[:2], seen.channels, seen.facts.dtype, seen.facts.kind == "raw")


def in_folder(seen: Seen, tokens: tuple[Token, ...], place: int) -> Named:
    """Return a capture whose target is the folder at `place`, or the root's own name."""
    if place == PARENT:
        target = seen.path.parent.resolve().name
        return Named(seen, target, "object", ("..", TARGET), tokens)
    target = seen.folders[place]
    folders = tuple(TARGET if i == place else name for i, name in enumerate(seen.folders))
    role = role_in(target) or "object"
    return Named(seen, target, role, folders, _with_target(tokens, target))


def _with_target(tokens: tuple[Token, ...], target: str) -> tuple[Token, ...]:
    """Mark the words of a name that repeat the folder's."""
    for start in range(len(tokens)):
        for stop in range(len(tokens), start, -1):
            if joined(tokens[start:stop]) == target:
                return (
                    *tokens[:start],
                    Token(TARGET, tokens[start].gap, "target"),
                    *tokens[stop:],
                )
    return tokens


def joined(tokens: Sequence[Token]) -> str:
    """The text of some parts as it stood; what stood before the first is left out."""
    text = "".join(t.gap + t.text for t in tokens)
    return text[len(tokens[0].gap) :] if tokens else ""


def deepest(folders: tuple[str, ...]) -> int:
    """The deepest folder that has a name of its own, else the root."""
    levels = [i for i, name in enumerate(folders) if name.lower() not in GENERIC]
    return levels[-1] if levels else PARENT
