"""Write docs/commands.md from the command line's own help; a test keeps the two the same."""

from pathlib import Path

import typer.main
from typer._click import Context  # typer carries its own click


def reference() -> str:
    """Return the page."""
    from levkas.cli import app

    group = typer.main.get_command(app)
    parts = [
        "# Commands",
        "",
        "Exit status: 0 done, 1 something was refused or failed, 2 wrong use. With `--json` a command",
        "prints one object: `levkas`, `command`, `ok`, `problems`, and what it reports.",
        "",
    ]
    for name, command in sorted(_flat(group.commands), key=lambda item: item[0]):
        context = Context(
            command, info_name=f"levkas {name}", terminal_width=96, max_content_width=96
        )
        parts += [
            f"## `levkas {name}`",
            "",
            "```text",
            command.get_help(context).rstrip(),
            "```",
            "",
        ]
    return "\n".join(line.rstrip() for line in parts)


def _flat(commands: dict, before: str = "") -> list:
    """Commands with those of groups under their own names: ``plan light``."""
    found = []
    for name, command in commands.items():
        inner = getattr(command, "commands", None)
        found += _flat(inner, f"{before}{name} ") if inner else [(before + name, command)]
    return found


if __name__ == "__main__":
    (Path(__file__).parent / "commands.md").write_text(reference(), encoding="utf-8")
