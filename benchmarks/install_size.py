"""What each package that Levkas needs at run time takes on the disk.

    python benchmarks/install_size.py

Files of every package of the closure of pyproject.toml's dependencies as they are installed here, without bytecode, which is made when a
module is first imported. Packages of less than `SMALL` MB are added up. The table stands in docs/howto/install.md.
"""

from __future__ import annotations

import tomllib
from importlib.metadata import distribution
from pathlib import Path

from house import ROOT, closure

SMALL = 40
"""MB."""


def megabytes(name: str) -> float:
    """Return what the files of a package take, MB, without bytecode."""
    package = distribution(name)
    paths = [Path(str(file.locate())) for file in package.files or () if file.suffix != ".pyc"]
    return sum(path.stat().st_size for path in paths if path.is_file()) / 1e6


def main() -> None:
    """Measure and print the table."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        declared = tomllib.load(file)["project"]["dependencies"]
    sizes = {name: megabytes(name) for name in closure(declared)}
    large = {name: size for name, size in sizes.items() if size >= SMALL}
    rows = dict(sorted(large.items(), key=lambda item: -item[1]))
    rows[f"{len(sizes) - len(large)} others"] = sum(sizes.values()) - sum(large.values())
    rows["all"] = sum(sizes.values())
    for name, size in rows.items():
        print(f"| {name} | {size:.0f} |")


if __name__ == "__main__":
    main()
