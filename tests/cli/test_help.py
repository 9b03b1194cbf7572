"""The help of every command, its examples, completion by the shell, and near misses of names, choices and folders."""

import re
import shlex
import subprocess
import sys

import pytest
import typer.main
from typer.testing import CliRunner

from levkas.cli import app
from levkas.cli.examples import EXAMPLES

GROUP = typer.main.get_command(app)
COMMANDS = [
    f"{name} {inner}".strip()
    for name, command in GROUP.commands.items()
    for inner in (getattr(command, "commands", None) or [""])
]


def run(*words):
    """Run a command: (exit status, standard output, standard error)."""
    done = CliRunner().invoke(app, [str(w) for w in words], prog_name="levkas")
    return done.exit_code, done.stdout, done.stderr


def parsed(line):
    """Parse a command line as the program does, and return the command's words."""
    command, parent, name, words = GROUP, None, "levkas", shlex.split(line)[1:]
    while hasattr(command, "commands"):
        context = command.context_class(command, info_name=name, parent=parent)
        name, command, words = command.resolve_command(context, words)
        parent = context
    command.parse_args(command.context_class(command, info_name=name, parent=parent), words)
    return name


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_two_examples_that_parse_and_plain_words(command):
    status, text, _ = run(*command.split(), "--help")
    assert status == 0
    for line in EXAMPLES[command]:
        assert line in text and line.startswith(f"levkas {command} ".strip())
        assert parsed(line) == (command if command in GROUP.commands else command.split()[-1])
    assert len(EXAMPLES[command]) in (1, 2)
    usage, _, rest = text.partition("\n")
    assert not re.search(r"[<{]|list\[", usage) and not re.search(r"<\w+|list\[", rest)


def test_every_command_has_examples_and_no_other():
    assert sorted(EXAMPLES) == sorted(COMMANDS)


@pytest.mark.parametrize(
    "line",
    ["export icnos --for envi", "build icnos", "evaluate icnos", "map icnos icon1 --to d80"],
)
def test_a_folder_that_does_not_exist_is_called_so(line, tmp_path, monkeypatch):
    (tmp_path / "icons").mkdir()
    monkeypatch.chdir(tmp_path)
    status, _, err = run(*line.split())
    assert status == 1 and "no such folder" in err and "Did you mean 'icons'?" in err, err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        ("levkas ex", "export"),
        ("levkas export --for en", "envi"),
        ("levkas export DATABASE --object o", "one"),
        ("levkas export DATABASE --camera inf", "infrared"),
    ],
)
def test_the_shell_completes_commands_choices_and_names_of_the_database(line, wanted, plates):
    words = line.replace("DATABASE", str(plates / "database"))
    code = "import sys; sys.argv[0] = 'levkas'; from levkas.cli import app; app()"
    asked = {
        "_LEVKAS_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split()) - 1),
    }
    ran = subprocess.run([sys.executable, "-c", code], env={"PYTHONPATH": ":".join(sys.path), **asked}, capture_output=True, text=True, check=False)  # fmt: skip
    assert ran.stdout.split() == [wanted], ran.stderr
