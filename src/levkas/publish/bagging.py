"""A BagIt bag (RFC 8493) of a published folder: a copy aside, checked by the `bagit` package.

The folder itself is never turned into a bag: it stays what it is.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from levkas import __version__
from levkas.core.problems import Problem
from levkas.publish.publication import PublishRefused, require_ours

if TYPE_CHECKING:
    from levkas.core.files import Folder
    from levkas.publish.metadata import PublicationFacts

DECLARATION = "BagIt-Version: 1.0\nTag-File-Character-Encoding: UTF-8\n"
NEW_BAG = "Give another folder: --bag NEW."
MANIFEST, TAGS = "manifest-sha256.txt", "tagmanifest-sha256.txt"


def write_bag(published: str | Path, target: str | Path, facts: PublicationFacts) -> Iterator[str]:
    """Copy a published folder into a bag, comparing every hash on the way; yields file by file.

    Parameters
    ----------
    published : path
    target : path
        A new folder, or an earlier bag, which is replaced when the new one is whole.
    facts : PublicationFacts
        For bag-info.txt; the date is that of the publication, never the clock's.

    Raises
    ------
    PublishRefused
        Where a file is not what was published, or `target` exists.
    WriteRefused
        Where the disk refuses.
    """
    from levkas.core.digests import hash_file
    from levkas.core.files import publishing
    from levkas.database.manifest import NAME as MANIFEST_NAME
    from levkas.database.manifest import list_files, read_manifest

    root, target = Path(published).resolve(), Path(target).resolve()
    check_target(root, target)
    manifest = read_manifest(root / MANIFEST_NAME)
    wanted = {name: file.sha256 for name, file in manifest.files.items()}
    wanted[MANIFEST_NAME] = hash_file(root / MANIFEST_NAME)
    if odd := [name for name in sorted(wanted) if "%" in name or len(name.splitlines()) != 1]:
        raise PublishRefused(
            Problem(
                "E_VALUE",
                "a file of this name cannot be in a bag: programs read its line of the manifest in two ways",
                file=str(root / odd[0]),
                found=f"{len(odd)} of {len(wanted)} files",
                expected="names without % and line breaks (RFC 8493, section 2.1.3)",
                fix="Rename it in the database, or move it out; then build and publish again.",
            )
        )
    missing = sorted(set(wanted) - set(list_files(root)))
    if missing:
        raise PublishRefused(_not_whole(root / missing[0], "it is missing"))
    with publishing(target, bytes_needed=manifest.bytes) as folder:
        size = 0
        for name in sorted(wanted):
            yield name
            if folder.copy_file(root / name, f"data/{name}") != wanted[name]:
                raise PublishRefused(_not_whole(root / name, "it is not what was published"))
            size += (root / name).stat().st_size
        _write_tags(folder, wanted, size, facts)
        yield "checking the bag"
        _check_bag(folder.path, target)


def _write_tags(folder: Folder, hashes: dict[str, str], size: int, facts: PublicationFacts) -> None:
    lines = [f"{sha}  data/{_encoded(name)}\n" for name, sha in sorted(hashes.items())]
    tags = {
        "bagit.txt": DECLARATION,
        "bag-info.txt": "".join(f"{k}: {v}\n" for k, v in _info(facts, size, len(hashes)).items()),
        MANIFEST: "".join(lines),
    }
    made = {}
    for name, text in tags.items():
        data = text.encode("utf-8")
        folder.write_bytes(name, data)
        made[name] = hashlib.sha256(data).hexdigest()
    listed = "".join(f"{sha}  {name}\n" for name, sha in sorted(made.items()))
    folder.write_bytes(TAGS, listed.encode("utf-8"))


def _info(facts: PublicationFacts, size: int, count: int) -> dict[str, str]:
    tags = {
        "External-Description": " ".join(facts.description.split()) or facts.title,
        "External-Identifier": facts.doi,
        "Contact-Name": "; ".join(p.name for p in facts.creators),
        "Bagging-Date": facts.published[:10],
        "Bag-Software-Agent": f"levkas {__version__}",
        "Payload-Oxum": f"{size}.{count}",
    }
    return {key: value for key, value in tags.items() if value}


def _encoded(name: str) -> str:
    return name.replace("%", "%25").replace("\n", "%0A").replace("\r", "%0D")


def check_target(root: Path, target: Path) -> None:
    """Refuse a folder that is no bag of ours, holds what is bagged, or lies in it."""
    if target == root or root in target.parents or target in root.parents:
        raise PublishRefused(
            Problem(
                "E_UNWRITABLE",
                "the bag cannot be written to this folder: it contains the bagged files, or is inside them",
                file=str(target),
                expected="a new folder, or an earlier bag",
                fix=NEW_BAG,
            )
        )
    require_ours(target, "bag", fix=NEW_BAG)


def _check_bag(folder: Path, final: Path) -> None:
    """Let the library read every file of the bag again."""
    import bagit

    try:
        bagit.Bag(str(folder)).validate(processes=1)
    except bagit.BagError as error:
        raise PublishRefused(
            Problem("E_DAMAGED", f"the bag is not valid: {error}", file=str(final))
        ) from error


def _not_whole(path: Path, why: str) -> Problem:
    return Problem(
        "E_DAMAGED",
        f"{path.name} cannot be bagged: {why}",
        file=str(path),
        fix="Publish again; levkas validate names all that is damaged.",
    )
