"""The command line: one file a group of commands, each parses, calls the library once and prints."""

from __future__ import annotations

import io
import sys
from typing import Annotated, Any

import typer
import typer.core

from levkas import __version__
from levkas.cli import (
    build,
    demo,
    doctor,
    estimate,
    evaluate,
    inspect,
    measure,
    plan,
    publish,
    watch,
)
from levkas.cli.options import StrictCommand
from levkas.core.instructions import hold_instructions

ORDER = {
    "Begin": ("doctor", "demo", "look", "plan", "simulate"),
    "Capture": ("watch",),
    "Build": ("build", "status", "inspect"),
    "Measure": ("radiometry", "chart", "evaluate", "agree", "validate"),
    "Use": ("map", "estimate", "estimate apply", "export", "publish"),
}
"""Commands as `levkas --help` lists them: in groups, in the order of work."""


GONE = {
    "loops": "register two cameras by `levkas.register`, and follow points around",
    "estimate score": "predictions made elsewhere are compared in a line of numpy: the layers are arrays of `levkas.open`",
    "plan filter": "`levkas plan exposure WHITE` names the weakest channel",
    "plan series": "expose once for the white (`levkas plan exposure`), then longer, each four times the one before",
    "methods": "`python benchmarks/methods.py CAMPAIGN` in a checkout compares methods of registration",
}
"""Commands of before, with what is there in their place."""


class Grouped(typer.core.TyperGroup):
    """Commands listed in groups, each with the whole of its first sentence; some have a name of two words."""

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Return the command that words begin with: ``estimate apply`` before ``estimate``."""
        two = " ".join(args[:2])
        if two in self.commands:
            return two, self.commands[two], args[2:]
        if gone := next((name for name in (two, *args[:1]) if name in GONE), None):
            ctx.fail(f"`levkas {gone}` is gone: {GONE[gone]}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a list of commands for each group."""
        for title, names in ORDER.items():
            with formatter.section(title):
                rows = [(name, self.commands[name].get_short_help_str(limit=200)) for name in names]
                formatter.write_dl(rows)


app = typer.Typer(
    name="levkas",
    cls=Grouped,
    help="Raw captures of a painting to one calibrated, registered spectral image database.",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    no_args_is_help=True,
    rich_markup_mode=None,
)
_plan = typer.Typer(
    help="Plan light, framing and exposures.", no_args_is_help=True, rich_markup_mode=None
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"levkas {__version__}")
        raise typer.Exit


@app.callback()
def _levkas(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    # Names of files need not be text; a report in JSON stays one, where "\\udcff" is an escape.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


for _name, _command in {
    "look": build.look,
    "build": build.build,
    "status": build.status,
    "estimate": estimate.estimate,
    "estimate apply": estimate.apply,
    "evaluate": evaluate.evaluate,
    "agree": evaluate.agree,
    "validate": build.validate,
    "chart": measure.chart,
    "map": evaluate.map_points,
    "simulate": demo.simulate,
    "demo": demo.demo,
    "doctor": doctor.doctor,
    "inspect": inspect.inspect,
    "watch": watch.watch,
    "publish": publish.publish,
    "export": publish.export,
    "radiometry": measure.radiometry,
}.items():
    app.command(_name, cls=StrictCommand)(_command)
for _name, _command in {
    "light": plan.light,
    "framing": plan.framing,
    "exposure": plan.exposure,
}.items():
    _plan.command(_name, cls=StrictCommand)(_command)
app.add_typer(_plan, name="plan")


def main() -> None:
    """Run the command line, with libraries that compute alike on unlike processors."""
    hold_instructions()
    app()
