"""What the package imports is what it declares, and it imports where there is nothing of Unix."""

import ast
import functools
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
NOT_INSTALLED = {
    "SimpleITK": "simpleitk", "ants": "antspyx", "itk": "itk-elastix", "mahotas": "mahotas",
}  # fmt: skip
"""Import name → distribution of the extras that the tests' environment does not have."""
USED = ("cluster", "export", "peers", "remote")
"""Extras that the package, or the comparison with its peers, imports."""
UNIX = ("resource", "fcntl", "pwd", "grp", "termios", "tty", "pty", "syslog")


@functools.cache
def imported():
    """Import names of the package's sources that are not of Python itself → one file that imports them."""
    return imports_of(
        [*(ROOT / "src" / "levkas").rglob("*.py"), *(ROOT / "benchmarks" / "peers").rglob("*.py")]
    )


def imports_of(paths):
    """Import names of sources that are not of Python itself → one file that imports them."""
    found = {}
    for path in sorted(paths):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level:
                modules = [node.module]
            for module in modules:
                found.setdefault(module.partition(".")[0], path.name)
    return {
        n: p
        for n, p in found.items()
        if n not in sys.stdlib_module_names and not n.startswith("levkas")
    }


distributions_by_module = functools.cache(metadata.packages_distributions)


def distributions(name):
    reported = distributions_by_module().get(name, [NOT_INSTALLED.get(name, name)])
    return {canonicalize_name(one) for one in reported}


def declared(texts):
    return {canonicalize_name(Requirement(text).name) for text in texts}


def test_every_package_that_is_imported_is_declared():
    extras = PROJECT["optional-dependencies"]
    known = declared([*PROJECT["dependencies"], *(one for e in USED for one in extras[e])])
    missing = {name: path for name, path in imported().items() if not distributions(name) & known}
    assert missing == {}


def test_every_package_that_is_declared_is_imported():
    extras = PROJECT["optional-dependencies"]
    used = set().union(*map(distributions, imported()))
    requested = declared([*PROJECT["dependencies"], *(one for e in USED for one in extras[e])])
    assert requested - used == set()


def test_locks_name_what_is_declared_and_no_registry():
    for lock, extras in {
        "requirements.lock": ("test", "lint", "docs"),
        "requirements-use.lock": (),
        "requirements-peers.lock": ("peers",),
    }.items():
        text = (ROOT / lock).read_text(encoding="utf-8")
        pinned = {line.partition("==")[0] for line in text.splitlines() if "==" in line}
        optional = PROJECT["optional-dependencies"]
        wanted = [*PROJECT["dependencies"], *(one for name in extras for one in optional[name])]
        assert declared(wanted) <= pinned, lock
        assert "://" not in text and "--index-url" not in text, lock


def test_the_lock_for_use_has_the_versions_of_development():
    use, development = (
        {
            line.split(" ")[0]
            for line in (ROOT / name).read_text().splitlines()
            if line[:1].isalpha()
        }
        for name in ("requirements-use.lock", "requirements.lock")
    )
    assert use < development


@pytest.mark.slow
def test_every_module_imports_where_there_is_nothing_of_unix():
    """As on Windows: a module that is not there is None in `sys.modules`."""
    code = (
        "import importlib, pkgutil, sys\n"
        f"sys.modules.update(dict.fromkeys({UNIX!r}))\n"
        "import levkas\n"
        "failed = []\n"
        "for module in pkgutil.walk_packages(levkas.__path__, 'levkas.', failed.append):\n"
        "    try:\n"
        "        importlib.import_module(module.name)\n"
        "    except ImportError as error:\n"
        "        failed.append(f'{module.name}: {error}')\n"
        "print(len(sys.modules), *failed, sep='\\n')\n"
        "sys.exit(bool(failed))\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=900)
    assert run.returncode == 0, run.stdout + run.stderr
    assert int(run.stdout.split()[0]) > 400
