"""A publication in the making: source, target folder, description; and the database as its first part."""

from __future__ import annotations

import contextlib
import hashlib
from dataclasses import dataclass, field
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.core.ownership import Kind, made, refusal, require_outside, stands_in
from levkas.core.problems import Problem, Refused, closest_match
from levkas.core.text import counted, read_json
from levkas.database.catalogue import NAME as CATALOGUE
from levkas.database.manifest import NAME, list_files, plain, read_manifest
from levkas.database.store import write_index

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from levkas.core.files import Folder
    from levkas.database.catalogue import Entry
    from levkas.database.layout import LayerId
    from levkas.database.manifest import Listed, Manifest
    from levkas.publish.analysis_names import Analysis
    from levkas.publish.metadata import PublicationFacts

PROVENANCE = "provenance.json"
"""Beside the layers of an object: every step of their making, with the hashes of raw files."""

SPLITS = "splits.csv"
MIDDLES = {"train": 0.3, "validation": 0.7, "test": 0.9}
"""Of the spans of 60, 20 and 20 % that objects are assigned by."""

LOCAL = "http://localhost:8000/"
"""Where ``python -m http.server`` in the publication's folder gives it."""


class PublishRefused(Refused):
    """A database cannot be published as it is; every reason is listed."""


@dataclass(frozen=True)
class Publication:
    """What the parts of a publication share.

    Parameters
    ----------
    source : Path
        The database, which is only read.
    manifest : Manifest
        Of the database.
    out : Folder
        Where the publication is made; it takes its name when it is whole.
    facts : PublicationFacts
        Who, what, under which licence.
    url : str
        Address under which the folder will be found, with ``/`` at its end; empty where not known.
    iiif : bool
        Whether tiles are wanted.
    analyses : tuple of Analysis
        That are wanted.
    hashes : dict
        SHA-256 of files that were hashed while they were written, by relative path.
    campaign : Path, optional
        campaign.toml of the database, where it is known: its declarations are published too.
    left_out : list of str
        What could not be made, and why.
    without : tuple of LayerId
        Layers that are not published.
    """

    source: Path
    manifest: Manifest
    out: Folder
    facts: PublicationFacts
    url: str = ""
    iiif: bool = True
    analyses: tuple[Analysis, ...] = ()
    hashes: dict[str, str] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    campaign: Path | None = None
    without: tuple[LayerId, ...] = ()

    @property
    def folder(self) -> Path:
        """Path of the folder that is being made."""
        return self.out.path

    @property
    def base(self) -> str:
        """Address of the folder; that of a server on this machine where none is known."""
        return self.url or LOCAL

    def write_bytes(self, name: str, data: bytes | memoryview) -> None:
        """Write a file of the folder; all are synced together in the end. Raises WriteRefused."""
        self.out.write_bytes(name, data)
        self.hashes[name] = hashlib.sha256(data).hexdigest()

    def write_text(self, name: str, text: str) -> None:
        """Write text as UTF-8; raises WriteRefused."""
        self.write_bytes(name, text.encode("utf-8"))

    def copy_file(self, source: Path, name: str) -> str:
        """Copy a file and return its SHA-256; raises WriteRefused."""
        self.hashes[name] = self.out.copy_file(source, name)
        return self.hashes[name]

    def entries(self) -> tuple[Entry, ...]:
        """Return the rows of the catalogue."""
        from levkas.database.catalogue import read_catalogue

        return read_catalogue(self.folder)


def write_content(publication: Publication) -> Iterator[str]:
    """Copy every file that the database's manifest lists, but for layers that are left out, and split its objects.

    Raises
    ------
    PublishRefused
        Where files are missing or differ from the manifest: all of them, at most ten.
    """
    problems = []
    files = _files_without(publication) if publication.without else publication.manifest.files
    for name, listed in files.items():
        yield name
        source = publication.source / name
        try:
            found = publication.copy_file(source, name)
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
            problems.append(_not_whole(source, "it is missing"))
            continue
        if found != listed.sha256:
            problems.append(_not_whole(source, "it has changed since the build"))
    if problems:
        raise PublishRefused(*problems[:10])
    for name in {layer.object for layer in publication.without}:
        if (store := publication.folder / f"zarr/{name}.zarr").is_dir():
            write_index(store)
    yield SPLITS
    names = dict.fromkeys(entry.object for entry in publication.entries())
    lines = "".join(f"{name},{split}\n" for name, split in split_objects(names).items())
    publication.write_text(SPLITS, "object,split\n" + lines)


def split_objects(names: Iterable[str]) -> dict[str, str]:
    """Assign objects to splits by the SHA-256 of their names, so that each stays where it is when others come; sorted by name.

    From three objects on, an empty split takes the object that lies nearest to it from the largest one.

    >>> split_objects(["icon1", "icon2", "icon3", "icon4", "icon5", "icon6"])["icon1"]
    'test'
    """
    digests = {name: hashlib.sha256(name.encode()).digest() for name in sorted(names)}
    places = {name: int.from_bytes(one[:6], "big") / 2**48 for name, one in digests.items()}
    splits = {
        name: "train" if place < 0.6 else "validation" if place < 0.8 else "test"
        for name, place in places.items()
    }
    empty = [split for split in MIDDLES if split not in splits.values()]
    for wanted in empty if len(places) >= len(MIDDLES) else ():
        largest = max(MIDDLES, key=list(splits.values()).count)
        mine = [name for name, split in splits.items() if split == largest]
        splits[min(mine, key=lambda n: (abs(places[n] - MIDDLES[wanted]), n))] = wanted
    return splits


def layers_without(database: Path, without: Sequence[str]) -> tuple[LayerId, ...]:
    """Return the layers that are left out: of a ``CAMERA``, a ``CAMERA@SETUP``, or one ``OBJECT/CAMERA``.

    Raises
    ------
    PublishRefused
        Where none is called so or none is left, and for every other layer that is of an earlier build.
    """
    from levkas.database.catalogue import read_catalogue

    entries = read_catalogue(database) if (database / CATALOGUE).is_file() else ()
    names = {e.layer: {e.camera, e.layer.name, f"{e.object}/{e.layer.name}"} for e in entries}
    gone = tuple(layer for layer, own in names.items() if own & {*without})
    known = set().union(*names.values())
    wrong = [name for name in without if name not in known or len(gone) == len(names)]
    expected = "a layer, and another that is left"
    problems = [
        Problem("E_VALUE", expected, None, "--without", name, fix=closest_match(name, known))
        for name in wrong
    ]
    fix = "Bring back what is missing and build again, or leave the layer out: --without "
    problems += [
        Problem(
            *("E_STALE", f"{e.object}/{e.layer.name} is of an earlier build"),
            *(str(database / CATALOGUE), "earlier", e.earlier),
            fix=f"{fix}{e.object}/{e.layer.name}.",
        )
        for e in entries
        if e.earlier and e.layer not in gone
    ]
    if problems:
        raise PublishRefused(*problems)
    return gone


def _files_without(publication: Publication) -> dict[str, Listed]:
    """Return the files that are copied where layers are left out, and write the catalogue of the others.

    Left out with them are the report pages of their objects, and of cameras that have no other layer.
    """
    from levkas.database.catalogue import read_catalogue, write_catalogue

    gone = publication.without
    rest = [e for e in read_catalogue(publication.source) if e.layer not in gone]
    own = {
        start: layer in gone
        for layer in (*gone, *(entry.layer for entry in rest))
        for native in (f"objects/{layer.object}/native/{layer.stem}",)
        for start in (
            f"{layer.path}.",
            f"{layer.group}/",
            f"{layer.record}.",
            f"{native}.",
            f"{native}_",
        )
    }
    own |= {f"cameras/{n}/": True for n in {o.camera for o in gone} - {e.camera for e in rest}}
    for name in {layer.object for layer in gone}:
        own |= dict.fromkeys((f"objects/{name}/report.html", f"zarr/{name}.zarr/zarr.json"), True)
    write_catalogue(publication.folder, rest)
    layers = ", ".join(f"{layer.object}/{layer.name}" for layer in gone)
    publication.left_out.append(
        f"{layers} and the report pages of these objects, as --without asks"
    )

    def is_left_out(name: str) -> bool:
        mine = max((start for start in own if name.startswith(start)), key=len, default="")
        return name == CATALOGUE or own.get(mine, False)

    return {n: file for n, file in publication.manifest.files.items() if not is_left_out(n)}


def _not_whole(path: Path, why: str) -> Problem:
    return Problem(
        "E_DAMAGED",
        f"{path.name} cannot be published: {why}",
        file=str(path),
        fix="Build the database again; `levkas validate` lists all damage.",
    )


def describe_dataset(publication: Publication) -> str:
    """Return the description that was written, else one made from the catalogue."""
    return publication.facts.description or describe_catalogue(publication.entries())


def describe_catalogue(entries: Sequence[Entry]) -> str:
    """Return one sentence on objects, cameras, bands and sampling.

    Examples
    --------
    >>> from levkas.database.catalogue import Entry
    >>> row = Entry("icon1", "vis", "", 33, 640, 480, 2.0, "reflectance", "accept", "")
    >>> describe_catalogue([row])
    'Spectral images of 1 object by 1 camera with 33 bands, registered pixel by pixel; 2 px per mm.'
    """
    objects = {e.object for e in entries}
    cameras = {e.camera: e.bands for e in entries}
    setups = {e.setup for e in entries}
    bands = sorted(set(cameras.values()))
    span = f"{bands[0]}" if len(bands) == 1 else f"{bands[0]} to {bands[-1]}"
    text = (
        f"Spectral images of {counted(len(objects), 'object')} by {counted(len(cameras), 'camera')}"
    )
    text += f" with {span} bands" if bands != [1] else " with 1 band"
    if len(setups) > 1:
        text += f", under {len(setups)} lightings"
    text += ", registered pixel by pixel"
    scales = sorted({e.px_per_mm for e in entries if not isnan(e.px_per_mm)})
    if scales:
        low, high = f"{scales[0]:.3g}", f"{scales[-1]:.3g}"
        text += f"; {low} px per mm" if low == high else f"; {low} to {high} px per mm"
    return text + "."


def require_ours(folder: Path, kind: Kind, *, fix: str) -> None:
    """Refuse to replace a folder unless Levkas wrote all of it, as this kind of folder.

    Parameters
    ----------
    folder : Path
        One that is not there, or is empty, is free.
    kind : "publication"
        It is replaced whole: a file in it that its manifest does not list is
        somebody else's.
    fix : str

    Raises
    ------
    WriteRefused
        ``E_UNWRITABLE`` with what is there.
    """
    require_outside(folder, fix=fix)
    found = stands_in(folder)
    if not found:
        return
    ours = made(folder) if found == "a folder" else None
    foreign = _foreign_files(folder) if ours == kind else []
    if ours == kind and not foreign:
        return
    if foreign:
        found = f"{len(foreign)} files that Levkas did not write, the first: {foreign[0]}"
    elif ours:
        found = f"a {ours} by Levkas"
    elif found == "a folder":
        found = "a folder that Levkas did not write"
    raise refusal(f"the {kind} cannot be written to this folder", folder, kind, found, fix)


def require_earlier(folder: Path, database: Path, facts: PublicationFacts, *, fix: str) -> None:
    """Refuse to replace a publication unless it is an earlier one of this database.

    It is where both hold an object, and this object's raw files in common (the same title or DOI, where a
    database does not list its raw files); objects that would go with it need the same title or DOI as well.

    Parameters
    ----------
    folder : Path
        A publication by Levkas; nothing is refused where there is none.
    database : Path
        What is published.
    facts : PublicationFacts
        Of `database`, as they will be published.
    fix : str

    Raises
    ------
    WriteRefused
        ``E_UNWRITABLE`` with title and objects of what is there.
    """
    from levkas.publish.metadata import read_facts

    kind = made(folder)
    if kind != "publication":
        return
    held, ours = _objects(folder), _objects(database)
    there = read_facts(folder)
    alike = there.title == facts.title or bool(there.doi and there.doi == facts.doi)
    one, other = (_raw_files(root, held & ours) for root in (folder, database))
    related = bool(one & other) if one and other else alike
    if held and ours and not held & ours:
        related = False
    if related and (alike or held <= ours):
        return
    found = f"{there.title!r} with {', '.join(sorted(held)[:3]) or 'no object'}"
    why = (
        f"the {kind} cannot be written to this folder: it holds the publication of another database"
    )
    fix = f"{fix} If it is to go, remove that folder first."
    raise refusal(why, folder, f"new folder, or an earlier {kind} of this database", found, fix)


def _objects(root: Path) -> set[str]:
    """Objects of a database; none where its catalogue cannot be read."""
    from levkas.database.catalogue import DatabaseRefused, read_catalogue

    try:
        return {entry.object for entry in read_catalogue(root)}
    except DatabaseRefused:
        return set()


def _raw_files(root: Path, objects: set[str]) -> set[str]:
    """SHA-256 of the raw files that show objects, as far as a database lists them."""
    hashes: set[str] = set()
    for name in objects:
        with contextlib.suppress(Refused, LookupError, TypeError, AttributeError):
            for step in read_json(root / "objects" / name / PROVENANCE)["steps"]:
                frames = [use for use in step.get("frames", ()) if use["role"] == "object"]
                hashes.update(sha for use in frames for sha in use["files"].values())
    return hashes - {""}


def _foreign_files(folder: Path) -> list[str]:
    """Files that the manifests of a folder do not list."""
    listed = {NAME}
    manifest = read_manifest(folder / NAME)
    if manifest.problems:
        return [NAME]  # what it lists cannot be relied on
    listed |= {plain(name) for name in manifest.files}
    return [name for name in list_files(folder) if plain(name) not in listed]
