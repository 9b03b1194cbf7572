"""TOML files: those of a campaign, bounded before a parser sees them, and our own, spelled."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from levkas.core.problems import Problem, Refused
from levkas.readers.text import TextRefused, read_text

LARGEST_FILE = 1 << 20
LONGEST_KEY = 1024
"""Characters of a key, and of anything else that stands without quotes."""
DEEPEST = 16
"""Parts of a dotted key, and brackets within brackets: a key of 20,000 parts costs tomllib 1.5 GB."""
MOST_TOKENS = 200_000
"""Keys, values and marks of a file: 500 objects and 40 cameras are 30,000, 15,000 pairs 150,000."""

_TOKEN = re.compile(
    r'(?P<string>"""(?:\\.|[^\\])*?"{3,5}'
    r"|'''.*?'{3,5}"
    r'|"(?!"")(?:\\.|[^"\\\n])*"'
    r"|'(?!'')[^'\n]*')"
    r"|(?P<comment>\#[^\n]*)"
    r"|(?P<open>[\[{])|(?P<close>[\]}])|(?P<end>[,\n][,\s]*)|(?P<equals>=)|(?P<dot>\.)"
    r"""|(?P<bare>[ \t]*[+-]?\d+\.\d+(?![\w.+-])|[^\[\]{}=,.\n"'\#]+)""",
    re.DOTALL,
)


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
    _bound(path, text)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise TomlRefused(
            Problem(
                "E_VALUE",
                f"{path.name} is not valid TOML",
                str(path),
                found=str(error)[:200],
                expected="TOML 1.0",
                fix="Mend that line: text in quotes, lists in brackets, one key a line.",
            )
        ) from error


def to_toml(record: Mapping[str, Any]) -> str:
    """Spell a record as TOML; None and empty text, lists and tables are left out.

    Parameters
    ----------
    record : mapping
        Text, numbers, switches, lists of these and, one in another, mappings and lists of mappings.

    Examples
    --------
    >>> print(to_toml({"title": 'A "B"', "size": (2, 3.5), "cameras": {"d80": {"bits": 12}}}), end="")
    title = "A \\"B\\""
    size = [2, 3.5]
    <BLANKLINE>
    [cameras.d80]
    bits = 12
    """
    return "\n".join(_spell_table(_pruned(record), ())).lstrip("\n") + "\n"


def _pruned(record: Mapping[str, Any]) -> dict[str, Any]:
    inner = {k: _pruned(v) if isinstance(v, Mapping) else v for k, v in record.items()}
    return {k: v for k, v in inner.items() if v is not None and v not in ("", [], (), {})}


def _spell_table(record: Mapping[str, Any], where: tuple[str, ...]) -> Iterator[str]:
    tables = {k: v for k, v in record.items() if isinstance(v, Mapping)}
    for key, value in record.items():
        if not isinstance(value, Mapping):
            yield f"{_spell_key(key)} = {_spell(value)}"
    for key, table in tables.items():
        inner = (*where, key)
        if any(not isinstance(v, Mapping) for v in table.values()):
            yield f"\n[{'.'.join(map(_spell_key, inner))}]"
        yield from _spell_table(table, inner)


def _spell(value: Any) -> str:
    if isinstance(value, Mapping):
        told = ", ".join(f"{_spell_key(k)} = {_spell(v)}" for k, v in _pruned(value).items())
        return f"{{ {told} }}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_spell(v) for v in value) + "]"
    if isinstance(value, str):
        # JSON's escapes are TOML's; only DEL needs one more.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, float) and not math.isfinite(value):
        return "nan" if value != value else ("inf" if value > 0 else "-inf")
    return json.dumps(value)


def _spell_key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _spell(key)


def _bound(path: Path, text: str) -> None:
    """Refuse what would cost the parser more than the file is worth.

    Where a string has no end the scan ends too: the parser fails at the same place.
    """
    depth = parts = length = at = tokens = 0
    while at < len(text) and (token := _TOKEN.match(text, at)):
        kind, at = str(token.lastgroup), token.end()
        tokens += 1
        if tokens > MOST_TOKENS:
            raise _too_much(
                path, "it holds too much", _line(text, at), f"{MOST_TOKENS} keys, values and marks"
            )
        if kind == "comment":
            continue
        depth += {"open": 1, "close": -1}.get(kind, 0)
        if kind in ("open", "close", "end"):
            parts = length = 0
        elif kind == "equals":
            too_long, parts, length = length > LONGEST_KEY, 0, 0
            if too_long:
                raise _too_much(
                    path, "a key is too long", _line(text, at), f"{LONGEST_KEY} characters"
                )
        else:
            parts += kind == "dot"
            length += at - token.start()
        bare = kind == "bare" and max(map(len, token.group().split()), default=0)
        if max(depth, parts) > DEEPEST:
            raise _too_much(path, "it is nested too deeply", _line(text, at), f"{DEEPEST} levels")
        if bare > LONGEST_KEY:
            raise _too_much(
                path, "a word is too long", _line(text, at), f"{LONGEST_KEY} characters"
            )


def _line(text: str, at: int) -> str:
    return f"line {text.count(chr(10), 0, at) + 1}"


def _too_much(path: Path, message: str, found: str, expected: str) -> TomlRefused:
    return TomlRefused(
        Problem(
            "E_SIZE",
            f"{path.name}: {message}",
            str(path),
            found=found,
            expected=f"at most {expected}",
            fix="docs/campaign.md has every key: none needs as much.",
        )
    )
