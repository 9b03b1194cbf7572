"""A guessed campaign, and its campaign.toml with a reason beside every guess."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from levkas.core.problems import Refused

WIDTH = 100
COLUMN = 53
"""Where comments begin, beside keys that leave them the place."""


@dataclass(frozen=True)
class Said:
    """One value of campaign.toml and why it is this one."""

    value: Any
    why: str = ""


@dataclass(frozen=True)
class SensorGuess:
    """One sensor of a camera: its name at ``{sensor}``, and its mosaic and channels where it has one."""

    name: str
    keys: dict[str, Said] = field(default_factory=dict)


@dataclass(frozen=True)
class CameraGuess:
    """One camera.

    Parameters
    ----------
    name : str
    about : tuple of str
        Comments above its table.
    keys : dict
        In the order of the file: kind, files, …
    sensors : tuple of SensorGuess
    hints : tuple of str
        Keys that may be wanted, as comments.
    unknown : tuple of str
        What the files do not say.
    centres : tuple of float
        Wavelengths of its bands, nm, as names or headers say them.
    targets : dict
        Target → role.
    setups : dict
        Name → files.
    """

    name: str
    keys: dict[str, Said]
    about: tuple[str, ...] = ()
    sensors: tuple[SensorGuess, ...] = ()
    hints: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    centres: tuple[float, ...] = ()
    targets: dict[str, str] = field(default_factory=dict)
    setups: dict[str, Said] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """As in campaign.toml."""
        return str(self.keys["kind"].value)


@dataclass(frozen=True)
class Proposal:
    """A whole campaign as it was guessed.

    Parameters
    ----------
    root : Path
        The folder that was looked at, where campaign.toml would stand.
    described : dict
        Keys of [campaign].
    cameras : tuple of CameraGuess
    targets : dict
        Keys of [targets].
    objects : tuple of str
    hints : tuple of str
        Keys of [targets] that may be wanted, as comments.
    unknown : tuple of str
        What a person must say; empty where nothing is left open.
    left_out : tuple of str
        Files that are in no camera, and why.
    """

    root: Path
    described: dict[str, Said]
    cameras: tuple[CameraGuess, ...]
    targets: dict[str, Said]
    objects: tuple[str, ...]
    hints: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The whole campaign.toml."""
        return "\n".join(_document(self)) + "\n"

    def to_dict(self) -> dict[str, Any]:
        """Return what campaign.toml says, as a parser reads it."""
        return tomllib.loads(self.text)

    def to_report(self) -> dict[str, Any]:
        """Return what `--json` says: the campaign, its text, what is unknown, what is left out."""
        return {
            "campaign": self.to_dict(),
            "toml": self.text,
            "unknown": list(self.unknown),
            "left_out": list(self.left_out),
        }


def to_toml(value: Any) -> str:
    """Spell one value as TOML.

    Examples
    --------
    >>> print(to_toml({"start": 400.0, "step": 10}), to_toml(("a", "b")), to_toml(True))
    { start = 400, step = 10 } ["a", "b"] true
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, float):
        return f"{value:.12g}"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {to_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(to_toml(v) for v in value) + "]"
    return str(value)


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else to_toml(name)


def _document(proposal: Proposal) -> Iterator[str]:
    yield "# Guessed by `levkas look` from the names, headers and numbers of the files; read it before a build."
    for title, lines in (
        ("Unknown, and for you to say:", proposal.unknown),
        ("Left out:", proposal.left_out),
    ):
        if lines:
            yield f"# {title}"
        for line in lines:
            yield from _wrapped(line, first="# - ", rest="#   ")
    yield "[campaign]"
    yield from _table(proposal.described)
    for camera in proposal.cameras:
        yield ""
        yield from (line for about in camera.about for line in _wrapped(about))
        yield f"[cameras.{_key(camera.name)}]"
        yield from _table(camera.keys)
        yield from (f"# {hint}" for hint in camera.hints)
        for sensor in camera.sensors:
            yield f"\n[[cameras.{_key(camera.name)}.sensors]]"
            yield from _table({"name": Said(sensor.name), **sensor.keys})
    if proposal.targets:
        yield "\n[targets]"
        yield from _table(proposal.targets)
        yield from (f"# {hint}" for hint in proposal.hints)
    for camera in proposal.cameras:
        for name, files in camera.setups.items():
            yield f"\n[setups.{_key(name)}.cameras.{_key(camera.name)}]"
            yield from _table({"files": files})
    if proposal.objects:
        yield f"\n# [objects.{_key(proposal.objects[0])}]"
        yield from _aligned('# title = ""', "what a museum says of it; all of it is optional")
        yield from _aligned("# size_mm = [width, height]", "gives the sampling in px per mm")
    if len(proposal.objects) > 1 or any(camera.setups for camera in proposal.cameras):
        yield "\n# [registration]"
        yield from _aligned(
            "# joint = true", "if nothing moved: a camera's captures share its lens"
        )


def _table(keys: dict[str, Said]) -> Iterator[str]:
    for key, said in keys.items():
        value = to_toml(said.value)
        listed = isinstance(said.value, list | tuple) and len(value) > WIDTH - len(key) - 3
        if not listed:
            yield from _aligned(f"{key} = {value}", said.why)
            continue
        yield from _aligned(f"{key} = [", said.why)
        yield from (f"    {line}" for line in _filled([f"{to_toml(v)}," for v in said.value]))
        yield "]"


def _aligned(line: str, why: str) -> Iterator[str]:
    """A key with its comment beside it, or above where it is long."""
    if not why:
        yield line
    elif len(line) < COLUMN and COLUMN + 2 + len(why) <= WIDTH + 10:
        yield f"{line:{COLUMN}}# {why}"
    elif len(line) + 4 + len(why) <= WIDTH:
        yield f"{line}  # {why}"
    else:
        yield from _wrapped(why)
        yield line


def _wrapped(text: str, *, first: str = "# ", rest: str = "# ") -> Iterator[str]:
    import textwrap

    clean = " ".join(text.split())
    yield from textwrap.wrap(
        clean, WIDTH, initial_indent=first, subsequent_indent=rest, break_long_words=False
    )


def _filled(parts: Sequence[str]) -> Iterator[str]:
    line = ""
    for part in parts:
        if line and len(line) + 1 + len(part) > WIDTH - 4:
            yield line
            line = ""
        line = f"{line} {part}" if line else part
    if line:
        yield line


class LookRefused(Refused):
    """A folder holds nothing that a campaign could be made of, or already has one."""
