"""A database without a manifest: every file decoded, and all of them held against one another."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from levkas.core.problems import Problem, Refused
from levkas.core.text import read_json
from levkas.database.consistency import check_agreement
from levkas.database.file_inventory import TWINS, Holdings, base_of
from levkas.database.integrity import (
    TiffFacts,
    check_array,
    check_file,
    check_tiff,
)
from levkas.database.manifest import is_partial, unfinished
from levkas.database.twins import check_stores


@dataclass(frozen=True)
class Structure:
    """One file that was decoded, or "" for what several say of one another.

    `ours` tells that Levkas wrote the database, so that more can be expected of it.
    """

    name: str
    problems: tuple[Problem, ...] = ()
    ours: bool = False


def check_structure(root: Path, names: frozenset[str]) -> Iterator[Structure]:
    """Yield every file as it is decoded, then where the files disagree.

    Parameters
    ----------
    root : Path
    names : frozenset of str
        Files below it, relative with ``/``.
    """
    arrays = _arrays(root, names)
    inside = {n for n in names if any(n.startswith(f"{array}/") for array in arrays)}
    tiffs: dict[str, TiffFacts] = {}
    problems: list[Problem] = []
    for name in sorted(names - inside):
        found = _check(root, name, tiffs)
        problems += found
        yield Structure(name, tuple(found))
    ours = any(facts.software.startswith("levkas") for facts in tiffs.values())
    described = check_stores(root, names, ours=ours)
    yield Structure("", tuple(described), ours)
    problems += described
    gaps: list[Problem] = []
    undescribed = {str(Path(p.file or "").parent) for p in described}
    for array in arrays:
        found = (
            []
            if str(root / array) in undescribed
            else check_array(
                root / array,
                [n.removeprefix(f"{array}/") for n in inside if n.startswith(f"{array}/")],
            )
        )
        # Others may leave empty chunks out: what the TIFF beside has there decides.
        gaps += [p for p in found if p.code == "E_MISSING" and not ours]
        problems += (found := [p for p in found if p not in gaps])
        yield from _by_file(root, array, inside, found)
    unsound = frozenset(Path(p.file or "").relative_to(root).as_posix() for p in problems)
    disagreeing = list(check_agreement(Holdings(root, names, tiffs, unsound)))
    yield Structure("", tuple(disagreeing))
    named = {p.file for p in disagreeing}
    yield Structure("", tuple(g for g in gaps if g.file in named or not _has_twin(g, root, tiffs)))


def _check(root: Path, name: str, tiffs: dict[str, TiffFacts]) -> list[Problem]:
    if is_partial(name):
        return [unfinished(root / name)]
    if not name.lower().endswith((".tif", ".tiff")):
        return check_file(root / name)
    facts, problems = check_tiff(root / name)
    if facts is not None:
        tiffs[name] = facts
    return problems


def _by_file(root: Path, array: str, inside: set[str], found: list[Problem]) -> Iterator[Structure]:
    """Share the problems of an array among its files; those of missing ones come last."""
    mine = sorted(n for n in inside if n.startswith(f"{array}/"))
    for name in mine:
        yield Structure(name, tuple(p for p in found if p.file == str(root / name)))
    here = {str(root / name) for name in mine}
    yield Structure("", tuple(p for p in found if p.file not in here))


def _arrays(root: Path, names: frozenset[str]) -> list[str]:
    """Folders of Zarr arrays, those too whose description is damaged."""
    folders = {n.rpartition("/")[0] for n in names if n.endswith(("/.zarray", "/zarr.json"))}
    return [folder for folder in sorted(folders) if _is_array(root / folder)]


def _is_array(folder: Path) -> bool:
    if (folder / ".zarray").is_file():
        return True
    try:
        return bool(read_json(folder / "zarr.json").get("node_type") != "group")
    except Refused:
        return (folder / "c").is_dir()


def _has_twin(gap: Problem, root: Path, tiffs: dict[str, TiffFacts]) -> bool:
    """Whether a TIFF of the same layer could be compared where a chunk is missing."""
    parts = Path(gap.file or "").relative_to(root).parts
    if len(parts) < 5 or parts[0] != "zarr" or parts[3] not in TWINS:
        return False
    return base_of("/".join(parts[:3])) + TWINS[parts[3]] in tiffs
