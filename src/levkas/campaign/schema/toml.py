"""TOML files: those of a campaign, bounded before a parser sees them, and our own, written by tomlkit."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from itertools import accumulate
from pathlib import Path
from typing import Any

from levkas.core.problems import Problem, Refused
from levkas.core.text import TextRefused, read_text

LARGEST_FILE = 1 << 20
LONGEST_WORD = 1024
"""Characters of a key, and of anything else without quotes."""
DEEPEST = 16
"""Parts of a dotted key, and brackets within brackets: a key of 20,000 parts costs tomllib 1.5 GB."""
MOST_TOKENS = 200_000
"""Keys, values and marks of a file: 500 objects and 40 cameras are 30,000, 15,000 pairs 150,000."""

_QUOTED = re.compile(
    r'(?P<string>"""(?:\\.|[^\\])*?"{3,5}'
    r"|'''.*?'{3,5}"
    r'|"(?!"")(?:\\.|[^"\\\n])*"'
    r"|'(?!'')[^'\n]*')(?P<key>(?=[ \t]*[.=]))?"
    r"|\#[^\n]*",
    re.DOTALL,
)
_WORD = r"[^\s\[\]{}=,.]"
_LONG = re.compile(rf"{_WORD}{{{LONGEST_WORD + 1}}}")
_DOTTED = re.compile(rf"(?<!{_WORD})(?:{_WORD}+[ \t]*\.[ \t]*){{{DEEPEST + 1}}}")
_TOKENS = re.compile(rf"{_WORD}+|[\[\]{{}}=,.]")


class TomlRefused(Refused):
    """A file that is not TOML, or is built to exhaust its parser."""


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file of at most 1 MiB.

    Returns
    -------
    record : dict
        As `tomllib` gives it.

    Raises
    ------
    TomlRefused
        Where the file cannot be read, is too large, nested too deeply or no TOML.
    """
    try:
        text = read_text(path, "a TOML file in UTF-8", most=LARGEST_FILE).replace("\r\n", "\n")
    except TextRefused as refused:
        raise TomlRefused(*refused.problems) from None
    _check_bounds(path, text)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise TomlRefused(
            Problem(
                "E_VALUE",
                f"{path.name} is not valid TOML",
                str(path),
                found=f"{str(error)[:200]}{_line_of(error, text)}",
                expected="TOML 1.0",
                fix=_mend(error, text),
            )
        ) from error


def _line_of(error: Exception, text: str) -> str:
    """Return the line that an error of `tomllib` names, as it stands there; "" where it names none."""
    place = re.search(r"at line (\d+)", str(error))
    lines = text.split("\n")
    if place is None or not 0 < int(place[1]) <= len(lines):
        return ""
    return f": {lines[int(place[1]) - 1].strip()[:80]}"


def _mend(error: Exception, text: str) -> str:
    """Return what to do about a text that is no TOML.

    >>> _mend(ValueError("Invalid value (at line 1, column 9)"), "title = “A panel”")
    'Correct that line: only straight quotes, " at either end, enclose a text.'
    """
    if re.search("twice|overwrite", str(error)):
        return "Give each camera, setup and object a name of its own and each key once: rename or remove one of the two."
    if re.search("[“”„«»‘’‚]", _line_of(error, text)) and "Invalid value" in str(error):
        return 'Correct that line: only straight quotes, " at either end, enclose a text.'
    if "Unescaped" in str(error):
        return "Write the folders of a path with /, or put the text between single quotes."
    return "Correct that line: text in quotes, lists in brackets, one key per line."


def to_toml(record: Mapping[str, Any]) -> str:
    """Return a record as TOML; None and empty text, lists and tables are left out.

    Examples
    --------
    >>> print(to_toml({"title": 'A "B"', "size": (2, 3.5), "cameras": {"d80": {"bits": 12}}}), end="")
    title = "A \\"B\\""
    size = [2, 3.5]
    <BLANKLINE>
    [cameras.d80]
    bits = 12
    """
    import tomlkit

    return tomlkit.dumps(_pruned(record))


def to_inline_toml(value: Any) -> str:
    """Return one value as TOML in one line; whole floats lose their decimals.

    Examples
    --------
    >>> print(to_inline_toml({"start": 400.0, "step": 10}), to_inline_toml(("a", "b")))
    { start = 400, step = 10 } ["a", "b"]
    """
    if isinstance(value, dict):
        pairs = (f"{to_toml_key(k)} = {to_inline_toml(v)}" for k, v in value.items())
        return "{ " + ", ".join(pairs) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(to_inline_toml, value)) + "]"
    if isinstance(value, float):
        return f"{value:.12g}"
    import tomlkit

    return str(tomlkit.item(value).as_string())


def to_toml_key(name: str) -> str:
    """Return a key as TOML, in quotes where it needs them.

    >>> print(to_toml_key("d80"), to_toml_key("two words"))
    d80 "two words"
    """
    import tomlkit

    return str(tomlkit.key(name).as_string())


def _pruned(value: Any) -> Any:
    if isinstance(value, Mapping):
        inner = {k: _pruned(v) for k, v in value.items()}
        return {k: v for k, v in inner.items() if v is not None and v not in ("", [], {})}
    return [_pruned(v) for v in value] if isinstance(value, list | tuple) else value


def _check_bounds(path: Path, text: str) -> None:
    """Refuse what would cost the parser more than the file is worth; strings and comments count only as keys."""

    def bare(found: re.Match[str]) -> str:
        if found["string"] is None:
            return ""
        return "_" * (len(found[0]) - 2) if found["key"] is not None else "_"

    left = _QUOTED.sub(bare, text)
    levels = accumulate(1 if c in "[{" else -1 for c in re.findall(r"[\[\]{}]", left))
    for message, too_much, most in (
        ("a key or a word is too long", _LONG.search(left), f"{LONGEST_WORD} characters"),
        ("it is nested too deeply", _DOTTED.search(left), f"{DEEPEST} parts of a key"),
        ("it is nested too deeply", max(levels, default=0) > DEEPEST, f"{DEEPEST} levels"),
        (
            "it holds too much",
            sum(1 for _ in _TOKENS.finditer(left)) > MOST_TOKENS,
            f"{MOST_TOKENS} keys, values and marks",
        ),
    ):
        if too_much:
            raise TomlRefused(
                Problem(
                    "E_SIZE",
                    f"{path.name}: {message}",
                    str(path),
                    found="more",
                    expected=f"at most {most}",
                    fix="docs/campaign.md explains every key; none needs so much.",
                )
            )
