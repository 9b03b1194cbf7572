"""Index the files of a campaign: folders listed once, files that fit patterns, frames by camera and setup."""

from __future__ import annotations

import csv
import io
import os
import re
import unicodedata
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from difflib import SequenceMatcher
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.campaign.discovery.captures import CaptureRefused, FrameRef
from levkas.campaign.discovery.patterns import Pattern, natural, ways_to_read
from levkas.core.problems import Problem, Refused
from levkas.core.text import TextRefused, read_text

if TYPE_CHECKING:
    from levkas.campaign.campaign import Camera, Campaign
    from levkas.readers.facts import Facts

PARTIAL = re.compile(r".*\.partial-[0-9a-f]{8}")
"""Names that an interrupted writer leaves behind."""
OWN_FILES = ("campaign.toml", "edits.toml")
DEEPEST = 64
"""Folders in one another below the one that is looked at; captures lie three or four deep."""
CANNOT_LIST = "Check the disk or the share it lies on, and copy it again if it is damaged."
MOST_COMPARED, MOST_SHOWN = 2000, 3
"""Names that are compared with a pattern, and that are shown."""
TYPICAL = {"{wavelength}": "550", "{exposure}": "100", "{shot}": "001"}


class FolderUnreadable(Refused):
    """A folder of raw frames that cannot be listed."""


class FolderListings:
    """Listings by folder, kept while a campaign's files are looked for.

    Parameters
    ----------
    never : iterable of Path
        Folders not to look into, such as the campaign's output.

    Examples
    --------
    >>> FolderListings().files(Path("/no/such/folder"))
    ()
    """

    def __init__(self, *, never: Iterable[Path] = ()) -> None:
        self._never = {os.path.normpath(folder) for folder in never}
        self._known: dict[str, tuple[tuple[str, ...], tuple[str, ...], frozenset[str]]] = {}

    def files(self, folder: Path) -> tuple[str, ...]:
        """Return the names of the files of a folder, sorted; none where there is no folder.

        Raises FolderUnreadable where it is there and cannot be listed.
        """
        return self._listed(folder)[0]

    def folders(self, folder: Path) -> tuple[str, ...]:
        """Return the names of the folders in a folder, sorted; raises as `files`."""
        return self._listed(folder)[1]

    @property
    def listed(self) -> tuple[str, ...]:
        """Every folder that was listed, or looked for, but for those not to look into."""
        return tuple(folder for folder in self._known if folder not in self._never)

    def is_closed(self, folder: Path) -> bool:
        """Return whether a folder is not looked into."""
        return os.path.normpath(folder) in self._never

    def is_link(self, folder: Path, name: str) -> bool:
        """Whether an entry is a symbolic link, which may lead back to where one comes from."""
        return name in self._listed(folder)[2]

    def _listed(self, folder: Path) -> tuple[tuple[str, ...], tuple[str, ...], frozenset[str]]:
        key = os.path.normpath(folder)
        if key not in self._known:
            self._known[key] = ((), (), frozenset()) if key in self._never else _list_folder(folder)
        return self._known[key]


def too_deep(folder: Path) -> FolderUnreadable:
    """Return the refusal of a folder that lies deeper than `DEEPEST`."""
    return FolderUnreadable(
        Problem(
            "E_SIZE",
            "folders are nested too deeply",
            str(folder),
            found=f"more than {DEEPEST} levels",
            expected=f"at most {DEEPEST}",
            fix="Name the folder that holds the frames.",
        )
    )


def walk_folders(
    root: Path, folders: FolderListings
) -> Iterator[tuple[tuple[str, ...], tuple[str, ...] | None]]:
    """Yield (folders below the root, names of the files) of every folder, in natural order, from the top.

    No folder is entered twice, whatever links lead to it. For what is nested deeper than `DEEPEST`
    the names are None, and it is not entered.
    """
    visited: set[tuple[int, int]] = set()
    waiting: list[tuple[str, ...]] = [()]
    while waiting:
        above = waiting.pop()
        folder = root.joinpath(*above)
        found = folder.stat() if folder.is_dir() else None
        if found is None or (found.st_dev, found.st_ino) in visited:
            continue
        visited.add((found.st_dev, found.st_ino))
        if len(above) > DEEPEST:
            yield above, None
            continue
        yield above, tuple(_naturally(folders.files(folder)))
        waiting += [(*above, name) for name in reversed(_naturally(folders.folders(folder)))]


def _naturally(names: Iterable[str]) -> list[str]:
    return sorted(names, key=lambda name: (natural(name), name))


def _list_folder(folder: Path) -> tuple[tuple[str, ...], tuple[str, ...], frozenset[str]]:
    files, folders, links = [], [], set()
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.name.startswith(".") or PARTIAL.fullmatch(entry.name):
                    continue
                kind = _kind_of_entry(entry)
                if kind == "folder":
                    folders.append(entry.name)
                elif kind == "file" and entry.name not in OWN_FILES:
                    files.append(entry.name)
                if entry.is_symlink():
                    links.add(entry.name)
    except (FileNotFoundError, NotADirectoryError):
        return (), (), frozenset()
    except OSError as error:
        what, fix = "a folder of raw frames cannot be listed", CANNOT_LIST
        if isinstance(error, PermissionError):
            fix = "Set its permissions to reading."
        elif folder.is_symlink():
            fix = "Remove the link, or let it lead to the folder."
        problem = Problem("E_UNREADABLE", what, str(folder), found=error.strerror, fix=fix)
        raise FolderUnreadable(problem) from error
    if "catalogue.csv" in files and "objects" in folders:
        return (), (), frozenset()  # a database of ours, wherever it was written to
    return tuple(sorted(files)), tuple(sorted(folders)), frozenset(links)


def _kind_of_entry(entry: os.DirEntry[str]) -> str:
    """Return ``"folder"``, ``"file"`` or nothing; a link to nothing, or in a circle, is a frame that is missing, and refused when it is read."""
    try:
        if entry.is_dir():
            return "folder"
        if entry.is_file():
            return "file"
        there = os.path.exists(entry.path)  # noqa: PTH110 -- thousands
    except OSError:
        there = False
    return "file" if entry.is_symlink() and not there else ""


def composed(name: str) -> str:
    """Return a name with composed accents, as people type it; some file systems take them apart.

    >>> len("e\\u0301"), len(composed("e\\u0301"))
    (2, 1)
    """
    return unicodedata.normalize("NFC", name)


# --- files that fit patterns ---------------------------------------------------------------------


@dataclass(frozen=True)
class FoundFile:
    """A file that fits a pattern, with the values in its name; units nm and s."""

    path: Path
    pattern: Pattern
    target: str = ""
    setup: str = ""
    band: str = ""
    wavelength: float | None = None
    exposure_s: float | None = None
    shot: str = ""
    sensor: str = ""
    object: str = ""
    tile: str = ""

    @cached_property
    def ref(self) -> FrameRef:
        """The file as a frame; an empty text is a band that is not known."""
        named = self.path, self.target, self.sensor, self.band or None, self.wavelength
        read = self.exposure_s, self.shot, self.setup
        return FrameRef(*named, *read, object=self.object, tile=self.tile)


def find_files(
    root: Path,
    patterns: Sequence[str | Pattern],
    *,
    known: Mapping[str, Collection[str]] | None = None,
    templates: Collection[str] = (),
    folders: FolderListings | None = None,
) -> list[FoundFile]:
    """Find the files that fit one of some patterns, in natural order; the first that fits counts.

    Parameters
    ----------
    root : Path
        What the patterns are relative to.
    patterns : sequence of str or Pattern
    known : dict of field to values, optional
        As `Pattern.read` takes it.
    templates : collection of str
        Targets that are darks, whites or a chart in place of one: patterns with {object} find no others.
    folders : Folders, optional
        Listings that are already there.

    Raises
    ------
    ValueError
        For a pattern that cannot be read.
    FolderUnreadable
        For a folder that cannot be listed.
    """
    folders = folders or FolderListings()
    ways = ways_to_read(known or {})
    by_path: dict[Path, FoundFile] = {}
    for pattern in patterns:
        parsed = Pattern.parse(pattern) if isinstance(pattern, str) else pattern
        for path, text in _walk(parsed, folders, _start(root, parsed), 0, "", set()):
            values = None if path in by_path else parsed.read(text, ways)
            if values is not None and ("object" not in values or values["target"] in templates):
                by_path[path] = FoundFile(path, parsed, **values)
    return _without_data_of_headers(in_natural_order(by_path.values()))


def with_exposures(
    frames: Sequence[FoundFile], exposures: dict[str, float], root: Path
) -> list[FoundFile]:
    """Give frames the exposure that the manifest has for their path from `root`, or for their name."""
    exposed = []
    for frame in frames:
        try:
            name = frame.path.relative_to(root).as_posix()
        except ValueError:
            name = frame.path.name
        seconds = exposures.get(name, exposures.get(frame.path.name))
        exposed.append(frame if seconds is None else replace(frame, exposure_s=seconds))
    return exposed


def in_natural_order(found: Iterable[FoundFile]) -> list[FoundFile]:
    """Return files by their paths, 9 before 10."""
    return sorted(found, key=lambda f: (natural(f.path.as_posix()), f.path.as_posix()))


def nearest(
    root: Path, pattern: Pattern, *, folders: FolderListings | None = None
) -> tuple[Path, list[str]]:
    """Return where a pattern leads no further, and the names there that are nearest to it.

    Examples
    --------
    >>> nearest(Path("/no/such/folder"), Pattern.parse("raw/{target}.tif"))
    (PosixPath('/no/such/folder'), [])
    """
    folders = folders or FolderListings()
    here = [_start(root, pattern)]
    segment = pattern.segments[0]
    for i, segment in enumerate(pattern.segments):
        last = i == len(pattern.segments) - 1
        if segment == "**":
            break
        if segment == "..":
            here = [folder.parent for folder in here]
            continue
        listed = folders.files if last else folders.folders
        there = [f / n for f in here for n in listed(f) if pattern.fits_segment(i, composed(n))]
        if last or not there:
            break
        here = there
    entries = [f / n for f in here for n in (*folders.folders(f), *folders.files(f))]
    # Not the database, which the next build would find and this one not.
    names = [entry.name for entry in entries if not folders.is_closed(entry)][:MOST_COMPARED]
    wanted = re.sub(r"\{[a-z]+\}|\*", lambda m: TYPICAL.get(m.group(), ""), segment).lower()
    ranked = sorted(
        dict.fromkeys(names),
        key=lambda n: (-SequenceMatcher(None, wanted, n.lower()).ratio(), natural(n), n),
    )
    return here[0], ranked[:MOST_SHOWN]


def _start(root: Path, pattern: Pattern) -> Path:
    return Path("/") if pattern.absolute else root


def _walk(
    pattern: Pattern,
    folders: FolderListings,
    folder: Path,
    index: int,
    text: str,
    been: set[tuple[int, str]],
    spelled: Callable[[str], str] = composed,
) -> Iterator[tuple[Path, str]]:
    """Yield (path, its part that the pattern describes), one folder level a segment; no way is gone twice.

    Names are compared, and described, as `spelled` gives them.
    """
    if (index, text) in been:
        return
    been.add((index, text))
    segment = pattern.segments[index]
    if segment == "**" and text.count("/") > DEEPEST:
        raise too_deep(folder)
    if segment == "..":
        yield from _walk(pattern, folders, folder.parent, index + 1, f"{text}../", been, spelled)
    elif segment == "**":
        yield from _walk(pattern, folders, folder, index + 1, text, been, spelled)
        for name in folders.folders(folder):
            if not folders.is_link(folder, name):
                deeper = f"{text}{spelled(name)}/"
                yield from _walk(pattern, folders, folder / name, index, deeper, been, spelled)
    elif index == len(pattern.segments) - 1:
        for name in folders.files(folder):
            if pattern.fits_segment(index, described := spelled(name)):
                yield folder / name, text + described
    else:
        plain = spelled is composed and not re.search(r"[{*]", segment)
        for name in (segment,) if plain else folders.folders(folder):
            if plain or pattern.fits_segment(index, spelled(name)):
                deeper = f"{text}{name if plain else spelled(name)}/"
                yield from _walk(pattern, folders, folder / name, index + 1, deeper, been, spelled)


def _without_data_of_headers(found: list[FoundFile]) -> list[FoundFile]:
    """Leave out the data file of an ENVI header that was found too: it is one capture."""
    headers = {f.path for f in found if str(f.path).lower().endswith(".hdr")}
    if not headers:
        return found
    stems = {path.with_suffix("") for path in headers}
    return [
        f
        for f in found
        if f.path in headers or not (f.path in stems or f.path.with_suffix("") in stems)
    ]


# --- all frames of a campaign --------------------------------------------------------------------


@dataclass
class FileIndex:
    """Frames of a campaign by camera and setup, with facts, targets, bands and templates that are looked up once."""

    campaign: Campaign
    folders: FolderListings
    frames: dict[tuple[str, str], list[FoundFile]] = field(default_factory=dict)
    broken: dict[tuple[str, str], Refused] = field(default_factory=dict)
    objects: list[str] = field(default_factory=list)
    templates: dict[tuple[object, ...], list[list[FoundFile]]] = field(default_factory=dict)
    _facts: dict[Path, Facts] = field(default_factory=dict)
    _by_target: dict[tuple[str, str], dict[tuple[str, str], list[FoundFile]]] = field(
        default_factory=dict
    )
    _has_objects: dict[tuple[str, str], bool] = field(default_factory=dict)
    _bands: dict[tuple[str, str, str], set[float | str]] = field(default_factory=dict)

    def of(self, name: str, camera: str, setup: str, *, serving: str = "") -> list[FoundFile]:
        """Return the frames of one target by a camera under a setup, in natural order.

        Of a dark, white or chart those that serve the object `serving` alone, or those that serve all.
        """
        return self._targets(camera, setup).get((name, serving), [])

    def served(self, names: Sequence[str], camera: str, setup: str) -> list[str]:
        """Return the objects that have a dark, white or chart of these names of their own."""
        own = {one for name, one in self._targets(camera, setup) if one and name in names}
        return sorted(own, key=natural)

    def _targets(self, camera: str, setup: str) -> dict[tuple[str, str], list[FoundFile]]:
        """Return frames by target and by the object that they serve."""
        key = camera, setup
        if key not in self._by_target:
            self._by_target[key] = {}
            for found in self.frames[key]:
                self._by_target[key].setdefault((found.target, found.object), []).append(found)
        return self._by_target[key]

    def has_objects(self, camera: str, setup: str) -> bool:
        """Whether any object was taken by a camera under a setup."""
        key = camera, setup
        if key not in self._has_objects:
            self._has_objects[key] = any(self.of(name, *key) for name in self.objects)
        return self._has_objects[key]

    def bands(self, camera: Camera, sensor: str, setup: str) -> set[float | str]:
        """Return the bands that one sensor's frames of objects and whites show, whichever."""
        key = camera.name, setup, sensor
        if key not in self._bands:
            targets = {*self.objects, *self.campaign.whites_of(camera)}
            self._bands[key] = {
                f.band if f.wavelength is None else f.wavelength
                for f in self.frames[camera.name, setup]
                if f.sensor == sensor and f.target in targets
            } - {""}
        return self._bands[key]

    def facts(self, path: Path) -> Facts:
        """Return the facts of a file's header, read once."""
        from levkas.readers.frames import read_facts

        if path not in self._facts:
            self._facts[path] = read_facts(path)
        return self._facts[path]


def scan_folders(campaign: Campaign) -> FileIndex:
    """Find the frames of every camera under every setup, whatever their targets."""
    output = campaign.output
    beside = [
        output.with_name(f"{output.name}.{what}") for what in ("kept", "removed", "published")
    ]
    folders = FolderListings(never=(output, *beside))
    index = FileIndex(campaign, folders)
    for name, camera in campaign.cameras.items():
        _scan_camera(index, name, camera)
    return index


def _scan_camera(index: FileIndex, name: str, camera: Camera) -> None:
    """Find the frames of one camera under every setup."""
    campaign, default = index.campaign, (name, "")
    index.frames[default] = _find_frames(index, default, camera, None, "")
    by_setup: dict[str, list[FoundFile]] = {}
    for found in index.frames[default]:
        by_setup.setdefault(found.setup, []).append(found)
    for setup, keys in campaign.setups.items():
        if setup == campaign.campaign.setup:  # the default one, described and no more
            continue
        own = keys.cameras.get(name)
        if own is not None and own.files:
            index.frames[name, setup] = _find_frames(index, (name, setup), camera, own.files, setup)
        elif own is not None or by_setup.get(setup):
            index.frames[name, setup] = by_setup.get(setup, [])
        by_setup.pop(setup, None)
    index.frames[default] = [f for f in index.frames[default] if f.setup in by_setup]
    unnamed = sorted(value for value in by_setup if value)
    if len(unnamed) > 1:
        index.broken[default] = CaptureRefused(
            Problem(
                "E_VALUE",
                f"{name}: several setups, and none is declared as the default",
                str(campaign.path),
                f"cameras.{name}.files",
                ", ".join(unnamed),
                "one value of {setup} that is not declared under [setups]",
                f"Declare the others: [setups.{unnamed[-1]}.cameras.{name}].",
            )
        )


def _find_frames(
    index: FileIndex, key: tuple[str, str], camera: Camera, files: Sequence[str] | None, setup: str
) -> list[FoundFile]:
    """Find the frames of one camera, sensor by sensor; a folder that cannot be read is kept for later."""
    known: dict[str, Collection[str]] = {
        "target": declared_targets(index.campaign),
        "band": camera.bands or (),
        "setup": tuple(index.campaign.setups),
    }
    campaign, chart = index.campaign, camera.white_chart
    templates = {*campaign.darks_of(camera), *campaign.whites_of(camera)}
    templates |= {chart.chart} if chart else set()
    frames: list[FoundFile] = []
    try:
        for sensor in [s.name for s in camera.sensors] or [""]:
            patterns = _patterns_of_sensor(camera, sensor, files, setup)
            find = partial(find_files, campaign.root, templates=templates, folders=index.folders)
            own = [p for p in patterns if "object" in p.fields]
            plain = [p for p in patterns if p not in own]
            if own:  # whose darks and whites these are is read by the objects' names
                known["object"] = tuple({f.target for f in find(plain, known=known)} - templates)
            found = find([*own, *plain], known=known)
            frames += [replace(f, sensor=sensor) for f in found] if sensor else found
        if camera.manifest:
            exposures = read_exposures(index.campaign.root / camera.manifest)
            frames = with_exposures(frames, exposures, index.campaign.root)
    except Refused as refused:
        index.broken[key] = refused
    return frames


def _patterns_of_sensor(
    camera: Camera, sensor: str, files: Sequence[str] | None = None, setup: str = ""
) -> list[Pattern]:
    """Return the patterns of one sensor: a setup's `files`, else its own, else the camera's."""
    own = next((s.files for s in camera.sensors if s.name == sensor), ())
    patterns = [Pattern.parse(text) for text in files or own or camera.files]
    if sensor:
        patterns = [p.with_value("sensor", sensor) for p in patterns]
    return [p.with_value("setup", setup) if setup else p for p in patterns]


def declared_targets(campaign: Campaign) -> tuple[str, ...]:
    """Return every value of {target} that campaign.toml declares."""
    targets = campaign.targets
    own = [n for c in campaign.cameras.values() for n in (*(c.dark or ()), *(c.white_names or ()))]
    white = targets.white.names if targets.white else ()
    named = (*targets.dark, *white, *targets.charts, *(targets.objects or ()), *campaign.objects)
    return tuple(dict.fromkeys((*named, *own)))


def patterns_of(
    index: FileIndex, camera: str, setup: str = "", *, sensor: str | None = None
) -> list[Pattern]:
    """Return every pattern of a camera under a setup, or of one of its sensors."""
    keys = index.campaign.cameras[camera]
    own = index.campaign.setups[setup].cameras.get(camera) if setup else None
    files = own.files if own and own.files else None
    sensors = [sensor] if sensor is not None else [s.name for s in keys.sensors] or [""]
    return [p for name in sensors for p in _patterns_of_sensor(keys, name, files, setup)]


# --- names that differ in upper and lower case ---------------------------------------------------


def files_of_other_case(index: FileIndex) -> dict[tuple[str, str, str], tuple[Path, Pattern]]:
    """Return files that fit a pattern, or name a target, only where upper and lower case are alike.

    Returns
    -------
    files : dict
        (object, camera, setup) → the first such file, and the pattern that it nearly fits. The
        object is spelled as in campaign.toml, else as the file does.
    """
    campaign = index.campaign
    targets = dict.fromkeys((*declared_targets(campaign), *index.objects))
    setups = {name.lower() for name in campaign.setups}
    ways = ways_to_read({"target": {name.lower() for name in targets}, "setup": setups})
    fitting = {f.path for frames in index.frames.values() for f in frames if f.target in targets}
    spelling = {name.lower(): name for name in targets}
    found: dict[tuple[str, str, str], tuple[Path, Pattern]] = {}
    for camera, setup in sorted(index.frames, key=lambda key: (not key[1], key)):
        for pattern in patterns_of(index, camera, setup):
            if "object" in pattern.fields:
                continue  # of darks and whites: refused by the captures that lack them
            lower = Pattern.parse(pattern.text.lower())
            if pattern.absolute:  # others' folders above the frames may not be listed
                continue
            for path, text in _walk_readable(lower, index.folders, campaign.root):
                values = None if path in fitting else lower.read(text, ways)
                if values is not None and (setup or values.get("setup", "") not in setups):
                    target = values.get("target", "")
                    start = text.find(target)
                    own = path.as_posix()[-len(text) :][start : start + len(target)]
                    key = (spelling.get(target, own), camera, setup)
                    found.setdefault(key, (path, pattern))
    return found


def _walk_readable(
    lower: Pattern, folders: FolderListings, root: Path
) -> Iterator[tuple[Path, str]]:
    """Yield what `_walk` does of names in lower case, up to a folder that cannot be listed: whose frames lie in it refuses it."""
    with suppress(FolderUnreadable):
        yield from _walk(lower, folders, root, 0, "", set(), lambda n: composed(n).lower())


# --- exposures from a table, where neither names nor EXIF have them --------------------------------

EXPECTED = "a CSV with the columns file and exposure_s, in UTF-8"


def read_exposures(path: Path) -> dict[str, float]:
    """Read a CSV with the columns file and exposure_s.

    Returns
    -------
    exposures : dict of str to float, s
        By the file's name as the table has it, with ``/``.

    Raises
    ------
    CaptureRefused
        Where it cannot be read; every row without an exposure > 0 is listed, at most ten.
    """
    exposures: dict[str, float] = {}
    problems = []
    try:
        lines = io.StringIO(read_text(path, EXPECTED), newline="")
        for number, row in enumerate(csv.DictReader(lines), start=2):
            try:
                name, seconds = str(row["file"]).strip(), float(row["exposure_s"])
            except (KeyError, TypeError, ValueError):
                name, seconds = "", 0.0
            if not name or not 0 < seconds < 1e6:
                problems.append(_bad_row(path, number, row))
            exposures[name.replace("\\", "/")] = seconds
    except TextRefused as refused:
        problems = list(refused.problems)
    except csv.Error as error:
        problems = [
            Problem(
                "E_UNREADABLE",
                "the manifest cannot be read",
                str(path),
                found=str(error),
                expected=EXPECTED,
                fix="Save it again as a table of two columns.",
            )
        ]
    if problems:
        raise CaptureRefused(*problems[:10])
    return exposures


def _bad_row(path: Path, number: int, row: dict[str, str]) -> Problem:
    return Problem(
        "E_VALUE",
        f"line {number} of the manifest has no exposure",
        str(path),
        "exposure_s",
        ", ".join(str(v) for v in row.values())[:80],
        "columns file and exposure_s, in seconds",
        "Write the exposure in seconds, a number above 0.",
    )
