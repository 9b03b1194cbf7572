"""What commands share: help with examples and plain words, options that need or exclude others, near misses named."""

from __future__ import annotations

import re
from collections import Counter
from typing import Any, get_args

from typer import BadParameter
from typer.core import TyperCommand

from levkas.cli.examples import EXAMPLES
from levkas.core.problems import closest_match

NOT_ONE = re.compile(r"(?:Value error, )?'(?P<value>[^']*)' is not one of (?P<choices>.*)\.")
"""What typer writes of a choice that is none."""
Needs = dict[str, tuple[str, ...]]
NEEDS: dict[str, Needs] = {
    "evaluate": {"--frame": ("--points",)},
    "plan exposure": {"--setup-name": ("--setup",), "--report": ("--setup",)},
}
"""Command → option → others, one of which it needs."""
EXCLUDES: dict[str, Needs] = {
    "plan exposure": {
        "--setup": ("frames", "--dark", "--pattern", "--black", "--bits", "--saturation", "--time")
    },
    "publish": {"--check": ("--no-iiif",)},
    "simulate": {"--setups": ("--setup",)},
    "watch": {"--once": ("--bell", "--port", "--no-open")},
}
"""Command → option → others that would have no effect beside it."""

METAVARS = {"path": "PATH", "int": "N", "float": "NUMBER"}
"""Type → what stands behind an option in the help; behind one of text its own name."""


class StrictCommand(TyperCommand):
    """A command that refuses what it would ignore, with exit status 2 (`UsageError`), and whose help has examples."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        for param in self.params:
            if param.metavar is None and not getattr(param, "is_flag", False):
                param.metavar = _metavar(param)

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the words behind the command: arguments in capitals, in brackets where they may be left out."""
        arguments = [p for p in self.get_params(ctx) if p.param_type_name == "argument"]
        words = [str(p.metavar) if p.required else f"[{p.metavar}]" for p in arguments]
        return ["[OPTIONS]", *words]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments and options, each with the plain word for its value."""
        for title, kind in (("Arguments", "argument"), ("Options", "option")):
            params = [p for p in self.get_params(ctx) if p.param_type_name == kind]
            records = [(p, record) for p in params if (record := p.get_help_record(ctx))]
            if records:
                with formatter.section(title):
                    formatter.write_dl(
                        [
                            (str(p.metavar) if kind == "argument" else name, text)
                            for p, (name, text) in records
                        ]
                    )

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the examples of the command."""
        with formatter.section("Examples"):
            for line in EXAMPLES.get(_words(ctx), ()):
                formatter.write(f"{'':>{formatter.current_indent}}{line}\n")

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse words as typer does; raises UsageError where an option would have no effect."""
        try:
            rest = super().parse_args(ctx, list(args))
        except BadParameter as error:
            if found := NOT_ONE.fullmatch(error.message):
                choices = re.findall(r"'([^']*)'", found["choices"])
                near = closest_match(found["value"], choices)
                error.message = " ".join(
                    filter(None, (f"{found['value']!r} is none of {', '.join(choices)}.", near))
                )
            raise
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
            if option in given and not any(one in given for one in needed):
                ctx.fail(f"{option} acts only with {' or '.join(needed)}")
        return rest


def _metavar(param: Any) -> str:
    """Return the word for what a person writes: ``PATH``, ``N``, ``envi|matlab``, ``OBJECT``."""
    value = param.type_descriptor
    if value.is_choice:
        return "|".join(str(choice) for choice in value.choices)
    inner = get_args(value.annotation)
    kind = getattr(inner[0] if inner else value.annotation, "__name__", "str").lower()
    own = _name(param).lstrip("-").replace("-", "_").upper()
    if param.param_type_name == "argument":
        return f"{own}..." if param.nargs != 1 else own
    return METAVARS.get(kind, own.rpartition("_")[2])


def _name(param: Any) -> str:
    """The long name of an option, or the name of an argument."""
    return next((opt for opt in param.opts if opt.startswith("--")), str(param.opts[0]))


def _words(ctx: Any) -> str:
    """The words of a command after ``levkas``: ``"plan exposure"``."""
    words: list[str] = []
    while ctx.parent is not None:
        words.insert(0, str(ctx.info_name))
        ctx = ctx.parent
    return " ".join(words)
