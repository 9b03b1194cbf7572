"""Files in a folder of captures: every image with its header's facts, and what is no image."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from levkas.campaign.discovery.file_index import DEEPEST, FolderListings, composed, walk_folders
from levkas.core.problems import Refused
from levkas.readers.envi_header import DATA_SUFFIXES
from levkas.readers.facts import Facts, LibraryMissing
from levkas.readers.frames import ALONE, RENDERED, STACKS

IMAGES = RENDERED | {".hdr"}
MOST_READ = 3000
"""Headers that are read; of more files, and of camera raws, a few of each folder stand for all."""
FEW = 3


@dataclass(frozen=True)
class CaptureFile:
    """One capture: its file, the folders it lies in below the root, their accents composed, and its facts.

    Facts that are `borrowed` are those of a file like it, whose path they have: its header was not read.
    """

    path: Path
    folders: tuple[str, ...]
    facts: Facts
    borrowed: bool = False

    @property
    def name(self) -> str:
        """Its path below the root."""
        return "/".join((*self.folders, self.path.name))

    @property
    def channels(self) -> int:
        """Samples of a pixel."""
        return int(self.facts.shape[2]) if len(self.facts.shape) == 3 else 1

    @property
    def is_stack(self) -> bool:
        """Whether it is of a format that stacks of maps have, and nothing else."""
        return self.facts.kind in STACKS.values()

    @cached_property
    def signature(self) -> tuple[object, ...]:
        """Common facts of one sensor's frames: size (of a scan the width), channels, type of number; of maps their format."""
        shape = self.facts.shape
        if self.is_stack:
            return (self.facts.kind,)
        if self.facts.is_cube:
            return (self.facts.kind, shape[1], shape[2], self.facts.dtype)
        return (shape[:2], self.channels, self.facts.dtype, self.facts.kind == "raw")


@dataclass
class Listing:
    """Everything below a folder.

    Attributes
    ----------
    root : Path
    captures : list of CaptureFile
        In natural order.
    tables : list of str
        CSV files, relative.
    unreadable : dict
        Relative name → why, for images that cannot be opened.
    others : list of str
        Files that are no images, relative.
    """

    root: Path
    captures: list[CaptureFile] = field(default_factory=list)
    tables: list[str] = field(default_factory=list)
    unreadable: dict[str, str] = field(default_factory=dict)
    others: list[str] = field(default_factory=list)


def list_captures(root: str | Path) -> Listing:
    """List the captures below a folder; databases of Levkas, hidden and unfinished files are left out."""
    from levkas.readers.raw import SUFFIXES

    listing = Listing(Path(root))
    paths: list[tuple[tuple[str, ...], Path]] = []
    for above, names in walk_folders(listing.root, FolderListings()):
        if any(name.endswith((".kept", ".removed")) for name in above):
            continue
        if names is None:
            listing.unreadable["/".join(above)] = f"more than {DEEPEST} levels of folders"
            continue
        folder = listing.root.joinpath(*above)
        composed_above = tuple(map(composed, above))
        paths += [(composed_above, folder / name) for name in names]
    headers = {p.with_suffix("") for _, p in paths if p.name.lower().endswith((".hdr", ".rpl"))}
    known: dict[tuple[object, ...], list[Facts]] = {}
    borrowed_facts: dict[tuple[object, ...], Facts] = {}
    for folders, path in paths:
        suffix = path.suffix.lower()
        name = "/".join((*folders, path.name))
        data = suffix in DATA_SUFFIXES and path.with_suffix("") in headers
        if data or (path in headers and suffix not in ALONE):
            continue  # of an ENVI header, or of a Ripple stack
        try:
            stack = _facts_of_stack(path) if suffix in STACKS or suffix == ".mat" else None
        except LibraryMissing as refused:
            listing.unreadable[name] = f"{refused.problems[0].message}. {refused.problems[0].fix}"
            continue
        if stack is not None:
            listing.captures.append(CaptureFile(path, folders, stack))
            continue
        if suffix not in IMAGES and suffix not in SUFFIXES:
            listing.others.append(name)
            listing.tables += [name] if suffix == ".csv" else []
            continue
        alike = known.setdefault((folders, suffix), [])
        spared = len(alike) >= FEW and (suffix in SUFFIXES or len(paths) > MOST_READ)
        if spared and all(f.shape == alike[0].shape for f in alike):
            key = folders, suffix
            if key not in borrowed_facts:
                borrowed_facts[key] = replace(alike[0], exposure_s=None, captured=None)
            listing.captures.append(CaptureFile(path, folders, borrowed_facts[key], borrowed=True))
            continue
        try:
            facts = _facts_of_image(path)
        except Refused as refused:
            problem = refused.problems[0]
            sizes = f" ({problem.found}; {problem.expected})"
            shown = problem.code in ("E_SIZE", "E_MEMORY")
            listing.unreadable[name] = problem.message + (sizes if shown else "")
            continue
        alike.append(facts)
        listing.captures.append(CaptureFile(path, folders, facts))
    return listing


def _facts_of_stack(path: Path) -> Facts | None:
    """Read the facts of a stack of maps, or of a cube in HDF5 or a MAT-file; None of what holds anything else."""
    from levkas.readers.frames import read_facts

    try:
        facts = read_facts(path)
    except LibraryMissing:
        raise
    except Refused:
        return None
    return facts if facts.is_cube or facts.kind in STACKS.values() else None


def _facts_of_image(path: Path) -> Facts:
    """Read the facts of a capture; an ENVI library of spectra is refused as no image."""
    from levkas.readers.envi_header import parse_header
    from levkas.readers.facts import unreadable
    from levkas.readers.frames import read_facts

    if path.suffix.lower() == ".hdr" and "library" in parse_header(path).text("file type").lower():
        raise unreadable(path, "a spectral library, not an image")
    return read_facts(path)
