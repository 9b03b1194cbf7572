"""What a value must be, in our words: findings of a schema, as pydantic words them, taken apart."""

from __future__ import annotations

import re

PHRASES = {
    "^Value error, ": "",
    "^Value should have at least 1 item.*": "not be empty",
    r"^[A-Z]\w* should have at (least|most) (\d+) (character|item)s?.*": r"have at \1 \2 \3s",
    r"^[A-Z]\w* should ": "",
    "be a valid string": "be text in quotes",
    "be a valid boolean": "be true or false",
    "be a valid integer.*": "be a whole number",
    "be a valid number": "be a number",
    "be a valid dictionary.*": "be a table",
    "be a valid tuple": "be a list",
    "be greater than or equal to": "be at least",
    "be less than or equal to": "be at most",
    " after validation.*": "",
}
"""Pydantic's words in ours."""


def requirement(message: str) -> str:
    """Return what a value must be, by the message of a finding.

    >>> requirement("Input should be a valid integer, got a number with a fractional part")
    'must be a whole number'
    >>> requirement("Value should have at least 1 item after validation, not 0")
    'must not be empty'
    """
    for theirs, ours in PHRASES.items():
        message = re.sub(theirs, ours, message)
    return message if message.startswith("must") else f"must {message[0].lower()}{message[1:]}"
