"""Names that can be part of file names, addresses, frame names and lists of checksums on every system."""

from __future__ import annotations

import re
import unicodedata

from levkas.core.problems import LONGEST_NAME

EXPECTED = f"at most {LONGEST_NAME} letters, digits, - and _"
_FORBIDDEN = re.compile(r'[/\\:*?"<>|@{}%]')
_DEVICES = re.compile(r"(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³])(\..*)?", re.IGNORECASE)
_UNFINISHED = re.compile(r"\.partial-[0-9a-f]{8}$")
_DIRECTIONS = frozenset("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
"""Characters that turn the direction of the letters behind them."""


def is_safe_name(name: str) -> bool:
    """Return whether a name can be part of file names and frame names on every system.

    >>> is_safe_name("lctf-vis"), is_safe_name("d80@soft")
    (True, False)
    """
    return not why_unsafe(name)


def why_unsafe(name: str) -> str:
    """Return what keeps a name out of file names; ``""`` for nothing.

    ``/ \\ : * ? " < > |`` no file name of Windows has, ``@``, ``:`` and ``{}`` have a meaning in names of frames
    and patterns, and ``%`` is written ``%25`` in a BagIt manifest, which `sha256sum` takes for another file.

    >>> why_unsafe("Icon 50%")
    "it contains '%'"
    >>> why_unsafe("aux"), why_unsafe("Icon 50")
    ('Windows has a device of this name', '')
    """
    found = _FORBIDDEN.search(name)
    invisible = [c for c in name if unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp")]
    invisible += sorted(_DIRECTIONS & {*name})
    reasons = {
        "it is empty": not name,
        f"it has {len(name)} letters": len(name) > LONGEST_NAME,
        f"it contains {found[0]!r}" if found else "": found,
        f"it contains the control character U+{ord(invisible[0]):04X}"
        if invisible
        else "": invisible,
        "it begins or ends with a dot or a space": re.search(r"^[.\s]|[.\s]$", name),
        "Windows has a device of this name": _DEVICES.fullmatch(name),
        "it is the name of an unfinished file": _UNFINISHED.search(name),
        "its accents are not composed (Unicode NFC)": not unicodedata.is_normalized("NFC", name),
    }
    return next((reason for reason, holds in reasons.items() if holds), "")
