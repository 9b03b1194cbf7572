"""The volume of the house is a promise: no figure of budgets.toml is passed, and none is ever raised.

    python tests/test_budgets.py            figures as they are, the budget, and the goal of the layout
    python tests/test_budgets.py --lower    budgets come down to the figures

Lines are those of the files that git knows, docstrings and blanks with them; code is what is left without these
and without comments. Words are pieces between spaces. A constant is a number that somebody chose: a name in capitals
at the head of a module, or a field of a class called …Settings, whose value holds a number.
"""

import ast
import io
import re
import subprocess
import sys
import tokenize
import tomllib
import typing
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
BUDGETS = Path(__file__).with_name("budgets.toml")
GENERATED = {"docs/commands.md", "docs/benchmarks.md", "docs/keys.md", "docs/codes.md"}
"""Pages that a program writes."""
FILES = {
    "campaign.toml": ("campaign.schema.tables", "Document"),
    "edits.toml": ("campaign.schema.tables", "EditsDocument"),
    "setup.toml": ("planning.tables", "Bench"),
}
"""Every file that a user writes, by the module and the name of its schema."""
LAYOUT = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
    tokenize.ENDMARKER,
}  # fmt: skip


def tracked(*patterns):
    """Return the files that git knows, and new ones that it does not ignore."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--"]
    done = subprocess.run([*command, *patterns], cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        pytest.skip("no checkout: the files that belong to the project are not known")
    return sorted({ROOT / n for n in done.stdout.split("\0") if n and (ROOT / n).is_file()})


def lines_of(paths):
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def words_of(paths):
    return sum(len(path.read_text(encoding="utf-8").split()) for path in paths)


def code_lines(text):
    """Return how many lines of a module hold code: neither docstring, comment nor blank."""
    code = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in LAYOUT:
            code.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str):
            code.difference_update(range(node.lineno, node.end_lineno + 1))
    return len(code)


def constants_of(text):
    """Return how many numbers a module has that somebody chose."""
    found = 0
    for node in ast.parse(text).body:
        settings = isinstance(node, ast.ClassDef) and node.name.endswith("Settings")
        for one in node.body if settings else [node]:
            if isinstance(one, ast.Assign | ast.AnnAssign) and one.value is not None:
                targets = one.targets if isinstance(one, ast.Assign) else [one.target]
                names = [n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
                numbers = any(
                    isinstance(n, ast.Constant) and type(n.value) in (int, float)
                    for n in ast.walk(one.value)
                )
                found += numbers * sum(settings or name.isupper() for name in names)
    return found


def surface():
    """Return how many commands there are and how many options, ``--help`` not counted."""
    import typer.main

    from levkas.cli import app

    def leaves(command):
        inner = getattr(command, "commands", None)
        return [leaf for c in inner.values() for leaf in leaves(c)] if inner else [command]

    commands = leaves(typer.main.get_command(app))
    options = [p for c in commands for p in c.params if p.param_type_name == "option"]
    return {"commands": len(commands), "options": sum(p.name != "help" for p in options)}


def keys_of(model, seen):
    """Return the keys of a table of a file, those of inner tables with them, each table once."""
    from pydantic import BaseModel

    found = []
    for name, field in model.model_fields.items():
        found.append(f"{model.__name__}.{field.alias or name}")
        waiting = [field.annotation]
        while waiting:
            one = waiting.pop()
            waiting += typing.get_args(one)
            if isinstance(one, type) and issubclass(one, BaseModel) and one not in seen:
                seen.add(one)
                found += keys_of(one, seen)
    return found


def file_keys():
    """Return the keys of every file that a user writes."""
    import importlib

    roots = [getattr(importlib.import_module(f"levkas.{m}"), n) for m, n in FILES.values()]
    return [key for root in roots for key in keys_of(root, set())]


def figures():
    """Return every figure, by table and name."""
    package = tracked("src/levkas/*.py")
    parts = {}
    for path in package:
        inner = path.relative_to(ROOT / "src" / "levkas").parts
        parts.setdefault(inner[0] if len(inner) > 1 else "root", []).append(path)
    texts = [path.read_text(encoding="utf-8") for path in package]
    codes = {code for text in texts for code in re.findall(r"\bE_[A-Z0-9_]+\b", text)}
    pages = [p for p in tracked("docs/*.md") if str(p.relative_to(ROOT)) not in GENERATED]
    by_hand = [*pages, *tracked("README.md", "CONTRIBUTING.md", "SECURITY.md")]
    return {
        "lines": {name: lines_of(paths) for name, paths in parts.items()},
        "code": {
            name: sum(code_lines(p.read_text(encoding="utf-8")) for p in paths)
            for name, paths in parts.items()
        },
        "house": {
            "lines": lines_of(package),
            "code": sum(map(code_lines, texts)),
            "files": len(package),
            "tests, lines": lines_of(tracked("tests/*.py", "conftest.py")),
            "tests, files": len(tracked("tests/*.py")),
            "TypeScript, lines": lines_of(tracked("frontend/src/*.ts")),
            "benchmarks, lines": lines_of(tracked("benchmarks/*.py")),
            "benchmarks, scripts": len(
                [p for p in tracked("benchmarks/*.py") if p.parent.name == "benchmarks"]
            ),
            "documentation, words": words_of(by_hand),
            "README, words": words_of(tracked("README.md")),
            "CHANGELOG, words": words_of(tracked("CHANGELOG.md")),
            "keys": len(file_keys()),
            "error codes": len(codes),
            "constants": sum(map(constants_of, texts)),
            "locks": len(tracked("*.lock")),
            **surface(),
        },
    }


def budgets():
    with BUDGETS.open("rb") as file:
        return tomllib.load(file)


@pytest.fixture(scope="module")
def counted():
    return figures()


@pytest.mark.parametrize("table", ["lines", "code", "house"])
def test_no_budget_is_passed(counted, table):
    allowed = budgets()[table]
    over = {n: (v, allowed.get(n, 0)) for n, v in counted[table].items() if v > allowed.get(n, 0)}
    assert over == {}


@pytest.mark.parametrize("table", ["lines", "code"])
def test_packages_lend_each_other_no_more_than_there_is(table):
    assert sum(budgets()[table].values()) <= budgets()["house"][table]


@pytest.mark.slow
def test_a_frame_enters_few_modules(tmp_path):
    """In a process of its own: what other tests have traced or patched is not counted."""
    command = [sys.executable, __file__, "--frame", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    first, entered = map(int, done.stdout.split()[-2:])
    allowed = budgets()["frame"]
    assert first <= allowed["modules before its first pixel"]
    assert entered <= allowed["modules in all"]


def trace_a_frame(folder):
    """Build one object of a filter camera and a mosaic; return how many modules ran, before the first pixel and in all.

    Every module is loaded before; a module counts once one of its Python functions has run on any thread.
    """
    import importlib
    import inspect
    import pkgutil
    import threading

    import tomlkit

    import levkas
    from levkas.simulation.campaigns import simulate_campaign

    for _ in simulate_campaign(folder, preset="small", scale=0.15, objects=1):
        pass
    path = folder / "campaign.toml"
    campaign = tomllib.loads(path.read_text(encoding="utf-8"))
    campaign["cameras"] = {name: campaign["cameras"][name] for name in ("lctf-vis", "d80")}
    path.write_text(tomlkit.dumps(campaign), encoding="utf-8")
    for module in pkgutil.walk_packages(levkas.__path__, "levkas."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    entered, first = Counter(), []

    def note(frame, event, value):
        name = frame.f_globals.get("__name__", "")
        if not name.startswith("levkas"):
            return
        if event == "call" and frame.f_code.co_flags & inspect.CO_OPTIMIZED:
            entered[name] += 1
        elif event == "return" and not first and name.startswith("levkas.readers"):
            first.extend([len(entered)] * (getattr(value, "ndim", 0) >= 2))

    threading.setprofile(note)
    sys.setprofile(note)
    bad = [step.line for step in levkas.build(folder) if step.state in ("refused", "failed")]
    sys.setprofile(None)
    threading.setprofile(None)
    if bad:
        sys.exit("\n".join(bad))
    return first[0], len(entered)


def main(arguments):
    if arguments[:1] == ["--frame"]:
        print(*trace_a_frame(Path(arguments[1])))
        return
    import tomlkit

    document = tomlkit.parse(BUDGETS.read_text(encoding="utf-8"))
    goals = document["goals"]
    for table, numbers in figures().items():
        allowed = document[table]
        for name, number in numbers.items():
            goal = goals[table].get(name, "") if table in goals else ""
            print(f"{table:6} {name:24} {number:8,} of {allowed.get(name, 0):8,}   goal {goal}")
            if "--lower" in arguments and number < allowed.get(name, 0):
                allowed[name] = number
        if table != "house" and "--lower" in arguments:
            for name in [n for n in allowed if n not in numbers]:
                del allowed[name]
    if "--lower" in arguments:
        BUDGETS.write_text(tomlkit.dumps(document), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
