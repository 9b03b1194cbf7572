"""Write docs/commands.md from the command line's own help; a test keeps the two the same."""

from pathlib import Path

import typer.main
from typer.testing import CliRunner


def reference() -> str:
    """Return the page."""
    from levkas.cli import app

    group = typer.main.get_command(app)
    parts = [
        "# Commands",
        "",
        "Exit status: 0 done, 1 something was refused or failed, 2 wrong use. With `--json` a command",
        "prints one object: `levkas`, `command`, `ok`, `problems`, and what it reports; `build` and `status` list under `layers` the verdict,",
        "the held-out error in px and mm, the share that was checked, and the reasons of every layer.",
        "",
    ]
    runner, width = CliRunner(), {"terminal_width": 96, "max_content_width": 96}
    for name in _with_subcommands(group):
        shown = runner.invoke(app, [*name.split(), "--help"], prog_name="levkas", **width)
        parts += [f"## `levkas {name}`", "", "```text", shown.output.rstrip(), "```", ""]
    return "\n".join(line.rstrip() for line in parts)


def _with_subcommands(group: typer.main.TyperGroup) -> list[str]:
    """Return the names of commands, sorted, those of a group right after it: ``plan exposure``."""
    found = []
    for name, command in sorted(group.commands.items()):
        found += [name, *(f"{name} {inner}" for inner in sorted(getattr(command, "commands", {})))]
    return found


if __name__ == "__main__":
    (Path(__file__).parent / "commands.md").write_text(reference(), encoding="utf-8")
