"""Options that act only with others or exclude them, and options given twice: refused before a command runs, never ignored."""

from __future__ import annotations

import os
from collections import Counter
from typing import Any

from typer.core import TyperCommand

Needs = dict[str, tuple[str, ...]]
NEEDS: dict[str, Needs] = {
    "build": {"--insecure": ("--cluster", "$DASK_SCHEDULER_ADDRESS")},
    "chart": {"--overwrite": ("--output",)},
    "estimate": {"--overwrite": ("--output",)},
    "estimate score": {"--overwrite": ("--output",)},
    "evaluate": {"--frame": ("--points",), "--overwrite": ("--maps",)},
    "map": {"--overwrite": ("--output",)},
    "agree": {"--overwrite": ("--output",)},
    "methods": {"--frame": ("--points",), "--overwrite": ("--output",)},
    "plan exposure": {
        "--setup-name": ("--setup",),
        "--report": ("--setup",),
        "--overwrite": ("--report",),
    },
    "plan filter": {"--overwrite": ("--report",)},
    "plan light": {"--overwrite": ("--report",)},
    "plan series": {
        "--setup": ("--camera",),
        "--camera": ("--setup",),
        "--overwrite": ("--report",),
    },
    "radiometry": {"--overwrite": ("--output",)},
}
"""Command → option → others, one of which it needs; ``$NAME`` is a variable of the environment."""
EXCLUDES: dict[str, Needs] = {
    "build": {"--cluster": ("--workers",)},
    "plan exposure": {
        "--setup": ("frames", "--dark", "--pattern", "--black", "--bits", "--saturation", "--time")
    },
    "publish": {"--check": ("--edition", "--no-iiif")},
    "simulate": {"--setups": ("--setup",)},
    "status": {"--graph": ("--json",)},
}
"""Command → option → others that would have no effect beside it."""


class StrictCommand(TyperCommand):
    """A command that refuses what it would ignore, with exit status 2 (`UsageError`)."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse words as typer does; raises UsageError where an option would have no effect."""
        rest = super().parse_args(ctx, list(args))
        values, _, order = self.make_parser(ctx).parse_args(list(args))
        options = [param for param in order if param.param_type_name == "option"]
        for param, count in Counter(options).items():
            texts = values[param.name] if param.multiple else []
            if twice := [text for text, times in Counter(texts).items() if times > 1]:
                ctx.fail(f"{_name(param)} {twice[0]} is given twice")
            if count > 1 and not param.multiple:
                ctx.fail(f"{_name(param)} is given {count} times; one counts")
        given = {_name(param) for param in order if values.get(param.name) is not None}
        words = _words(ctx)
        for option, others in EXCLUDES.get(words, {}).items():
            if option in given and (idle := [other for other in others if other in given]):
                ctx.fail(f"{', '.join(idle)} has no effect with {option}")
        for option, needed in NEEDS.get(words, {}).items():
            if option in given and not any(_is_there(one, given) for one in needed):
                ctx.fail(f"{option} acts only with {' or '.join(needed)}")
        return rest


def _name(param: Any) -> str:
    """The long name of an option, or the name of an argument."""
    return next((opt for opt in param.opts if opt.startswith("--")), str(param.opts[0]))


def _is_there(name: str, given: set[str]) -> bool:
    return bool(os.environ.get(name[1:])) if name.startswith("$") else name in given


def _words(ctx: Any) -> str:
    """The words of a command after ``levkas``: ``"plan exposure"``."""
    words: list[str] = []
    while ctx.parent is not None:
        words.insert(0, str(ctx.info_name))
        ctx = ctx.parent
    return " ".join(words)
