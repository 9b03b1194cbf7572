"""The frames of a folder: which files are there, what each is by campaign.toml or a guess, and whether it is at rest."""

from __future__ import annotations

import os
import time
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from levkas.campaign.campaign import Campaign, CampaignInvalid, campaign_of, load_campaign
from levkas.campaign.discovery.darks_and_whites import times_in_names
from levkas.campaign.discovery.file_index import (
    FileIndex,
    FolderListings,
    FoundFile,
    declared_targets,
    scan_folders,
    walk_folders,
)
from levkas.campaign.guess import LookRefused, look
from levkas.campaign.schema.tables import Document
from levkas.core.digests import Stamp, stamp_of
from levkas.core.problems import Refused
from levkas.core.text import missing_path
from levkas.quality.frame_checks import FrameFinding
from levkas.readers.frames import ALONE, files_of

REST_S, OLD_S = 0.5, 10.0
"""How long a file must not have changed before it is read; and after which age it is taken to rest already."""
RESCAN_S = 5.0
"""After which folders are listed again though none changed: some shares do not tell."""
GUESS_S, GUESS_SHARE = 2.0, 4.0
"""How long names must rest before a folder is guessed again; and times what the guess took."""
PAUSE_S = 1.0
"""Between files whose own times order them."""
FILE = "campaign.toml"


@dataclass(frozen=True)
class WatchedFile:
    """A file of the folder, and what it is.

    Parameters
    ----------
    path : Path
    name : str
        As it is shown: relative to the folder.
    camera, setup, sensor : str
    role : {"object", "white", "dark", "chart"}
    target : str
    band, shot, tile : str
        Empty where its name has none.
    exposure_s : float, optional
        By its name.
    """

    path: Path
    name: str
    camera: str
    setup: str
    sensor: str
    role: str
    target: str
    band: str = ""
    shot: str = ""
    exposure_s: float | None = None
    tile: str = ""


@dataclass(frozen=True)
class FrameState:
    """One frame as it is shown.

    Parameters
    ----------
    file : WatchedFile
    verdict : {"green", "look", "stop", "waiting"}
        Waiting while it is being written.
    findings : tuple of FrameFinding
    at : float
        s, on the clock that orders the frames of its camera.
    exposure_s : float, optional
    size : tuple of int
        Height and width, px; empty while it waits.
    """

    file: WatchedFile
    verdict: str
    findings: tuple[FrameFinding, ...] = ()
    at: float = 0.0
    exposure_s: float | None = None
    size: tuple[int, ...] = ()

    @property
    def what(self) -> str:
        """Camera, setup, role or object, band and exposure in words."""
        file = self.file
        who = file.camera + (f"@{file.setup}" if file.setup else "")
        who += f" {file.sensor}" if file.sensor else ""
        target = file.target if file.role in ("object", "chart") else file.role
        time_ = f"{self.exposure_s:g} s" if self.exposure_s else ""
        return " · ".join(
            part for part in (who, target, file.tile, file.band, time_, file.shot) if part
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the frame, JSON-ready."""
        return {
            "name": self.file.name,
            "what": self.what,
            "camera": self.file.camera,
            "setup": self.file.setup,
            "role": self.file.role,
            "target": self.file.target,
            "band": self.file.band,
            "verdict": self.verdict,
            "findings": [finding.to_dict() for finding in self.findings],
            "at": self.at,
        }


def fresh_of(frames: Iterable[FrameState], shown: Mapping[str, FrameState]) -> list[FrameState]:
    """Return the frames that differ from those that were shown by their names."""
    pairs = ((frame, shown.get(frame.file.name)) for frame in frames)
    return [frame for frame, before in pairs if frame is not before and frame != before]


@dataclass(frozen=True)
class FolderListing:
    """What of a folder is known without reading a pixel.

    Parameters
    ----------
    campaign : Campaign or None
        None of a folder in which nothing could be guessed yet.
    guessed : bool
    files : mapping of Path to WatchedFile
    stamps : mapping of Path to Stamp
        Of the files that could be looked at.
    strays : tuple of str
        Pictures that fit no pattern.
    problems : tuple of str
        Why frames cannot be found.
    """

    campaign: Campaign | None = None
    guessed: bool = False
    files: Mapping[Path, WatchedFile] = field(default_factory=dict)
    stamps: Mapping[Path, Stamp] = field(default_factory=dict)
    strays: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()


def watched_files(campaign: Campaign, index: FileIndex) -> dict[Path, WatchedFile]:
    """Return what every file is that fits a pattern of the campaign; the first camera whose pattern fits has it."""
    files: dict[Path, WatchedFile] = {}
    declared = set(campaign.targets.objects or ())
    known = set(declared_targets(campaign))
    for (name, setup), frames in index.frames.items():
        camera = campaign.cameras[name]
        roles = dict.fromkeys(campaign.targets.charts, "chart")
        roles |= dict.fromkeys(campaign.whites_of(camera), "white")
        roles |= dict.fromkeys(campaign.darks_of(camera), "dark")
        for found in frames:
            role = roles.get(found.target, "object")
            if role == "object" and declared and found.target not in declared | known:
                continue
            files.setdefault(found.path, _watched(campaign.root, name, setup, role, found))
    return files


def _watched(root: Path, camera: str, setup: str, role: str, found: FoundFile) -> WatchedFile:
    band = found.band or ("" if found.wavelength is None else f"{found.wavelength:g} nm")
    return WatchedFile(
        found.path, _shown(found.path, root), camera, setup, found.sensor, role,
        found.target, band, found.shot, found.exposure_s, found.tile,
    )  # fmt: skip


def _shown(path: Path, root: Path) -> str:
    inside, name = f"{root.as_posix().rstrip('/')}/", path.as_posix()
    if name.startswith(inside):
        return name[len(inside) :]
    return Path(os.path.relpath(path, root)).as_posix()


def stamps_of(path: Path) -> Stamp | None:
    """Return the stamp of a frame, of header and data together; None where one of them cannot be looked at."""
    try:
        every = [stamp_of(path)]
        if path.suffix.lower() not in ALONE:
            every = [stamp_of(file) for file in files_of(path)]
    except (OSError, Refused):
        return None
    if len(every) == 1:
        return every[0]
    sizes, modified, changed, inodes = zip(*every, strict=True)
    return sum(sizes), max(modified), max(changed), hash(inodes)


class FolderWatch:
    """Looks at a folder again and again; holds nothing open.

    Parameters
    ----------
    folder : path
        With campaign.toml, or to be guessed.

    Raises
    ------
    Refused
        Where there is no such folder.
    CampaignInvalid
        Where there is a campaign.toml and it cannot be used.
    """

    def __init__(self, folder: Path) -> None:
        if absent := missing_path(folder):
            raise Refused(absent)
        self.root = folder.resolve()
        self.listing = FolderListing()
        self.away_since: float | None = None
        self._index: FileIndex | None = None
        self._signature: object = None
        self._scanned = -RESCAN_S
        self._rest: dict[Path, tuple[Stamp, float]] = {}
        self._guess: tuple[object, float, float] = (None, 0.0, 0.0)
        self._campaign_stamp: Stamp | None = None
        self._invalid: tuple[str, ...] = ()
        self._load()

    def look(self, now: float | None = None) -> FolderListing:
        """Return the folder as it is; as it was while it cannot be reached.

        Parameters
        ----------
        now : float, optional
            s of a clock that never jumps.
        """
        now = time.monotonic() if now is None else now
        if not _is_reachable(self.root):
            self.away_since = self.away_since or time.time()
            return self.listing
        if self.away_since is not None:
            self.away_since, self._signature = None, None
        self._load()
        if now - self._scanned >= RESCAN_S or self._signature != self._folders():
            self._scan(now)
        stamps = {path: stamp for path in self.listing.files if (stamp := stamps_of(path))}
        files = {path: file for path, file in self.listing.files.items() if path in stamps}
        self.listing = replace(self.listing, files=files, stamps=stamps)
        self._note_rest(stamps, now)
        return self.listing

    @property
    def is_in_vain(self) -> bool:
        """Whether no campaign could be guessed from what is there now, or nothing there can be listed."""
        tried = self._guess[1] < 0 or self.away_since is not None
        return self.listing.campaign is None and tried

    def is_at_rest(self, path: Path, now: float) -> bool:
        """Whether a file has not changed for half a second, as seen here: no clock but this one counts."""
        return path in self._rest and now - self._rest[path][1] >= REST_S

    def rest_s(self, path: Path, now: float) -> float:
        """Return how long a file has not changed."""
        return now - self._rest[path][1] if path in self._rest else 0.0

    def _note_rest(self, stamps: Mapping[Path, Stamp], now: float) -> None:
        clock = time.time_ns()
        for path, stamp in stamps.items():
            if (known := self._rest.get(path)) is None:
                # What was there long before is read at once. The clock of a share may be behind, so that a frame which
                # is being written looks old: it counts as broken only after it was seen to rest.
                old = clock - max(stamp[1], stamp[2]) > OLD_S * 1e9
                self._rest[path] = stamp, now - (2 * REST_S if old else 0.0)
            elif known[0] != stamp:
                self._rest[path] = stamp, now
        for gone in self._rest.keys() - stamps.keys():
            del self._rest[gone]

    def _load(self) -> None:
        """Read campaign.toml where there is one, anew when it changed; a broken one keeps the last that was sound."""
        path = self.root / FILE
        try:
            stamp = stamp_of(path)
        except OSError:
            return
        if stamp == self._campaign_stamp:
            return
        first, self._campaign_stamp = self._campaign_stamp is None, stamp
        try:
            campaign = load_campaign(self.root)
        except CampaignInvalid as invalid:
            if first:
                raise
            self._invalid = tuple(str(problem) for problem in invalid.problems)
            self._signature = None
            return
        self._invalid = ()
        self.listing = FolderListing(campaign, False, self.listing.files)
        self._signature = None

    def _folders(self) -> object:
        """Return the times of change of all folders that were listed: names in them came or went when these differ."""
        if self._index is None:
            return None
        found = []
        for folder in self._index.folders.listed:
            with suppress(OSError):
                found.append((folder, os.stat(folder).st_mtime_ns))  # noqa: PTH116
        return tuple(found)

    def _scan(self, now: float) -> None:
        self._scanned = now
        if self.listing.campaign is None or self.listing.guessed:
            self._guess_again(now)
        campaign = self.listing.campaign
        if campaign is None:
            return
        self._index = index = scan_folders(campaign)
        problems = self._invalid + tuple(
            str(p) for refused in index.broken.values() for p in refused.problems
        )
        files = _kept(watched_files(campaign, index), self.listing.files)
        strays = () if self.listing.guessed else tuple(_strays(campaign, index, files))
        self._signature = self._folders()
        self.listing = FolderListing(campaign, self.listing.guessed, files, {}, strays, problems)

    def _guess_again(self, now: float) -> None:
        """Guess the campaign from names, headers and pixels, when names have come to rest and it is worth its time."""
        names = tuple(_names_and_sizes(self.root))
        named, since, took = self._guess
        if names != named:
            self._guess = names, now if names else -1.0, took
            if self.listing.campaign is not None or not names:
                self._scanned = -RESCAN_S
                return
        elif self.listing.campaign is not None and since < 0:
            return  # guessed already
        elif now - since < max(GUESS_S, GUESS_SHARE * took):
            self._scanned = -RESCAN_S
            return
        start = time.monotonic()
        with suppress(LookRefused, CampaignInvalid, ValueError):
            document = Document.model_validate(tomllib.loads(look(self.root).text))
            campaign = campaign_of(document, self.root / FILE)
            self.listing = FolderListing(campaign, True, self.listing.files)
        self._guess = names, -1.0, time.monotonic() - start


def _kept(
    files: Mapping[Path, WatchedFile], before: Mapping[Path, WatchedFile]
) -> dict[Path, WatchedFile]:
    """Return files with the objects that stood for them before: paths are compared by identity first, a tenth of the time."""
    kept = ((file, before.get(path)) for path, file in files.items())
    every = [file if was is None or was != file else was for file, was in kept]
    return {file.path: file for file in every}


def _names_and_sizes(root: Path) -> Iterator[tuple[str, int]]:
    for above, names in walk_folders(root, FolderListings()):
        for name in names or ():
            path = root.joinpath(*above, name)
            with suppress(OSError):
                yield str(path), path.stat().st_size


def _is_reachable(folder: Path) -> bool:
    try:
        with os.scandir(folder):
            return True
    except OSError:
        return False


def _strays(campaign: Campaign, index: FileIndex, files: Mapping[Path, WatchedFile]) -> list[str]:
    """Return pictures below the campaign that no pattern fits."""
    found = []
    known = {str(path) for path in files}
    headers = [path for path in known if path.lower().endswith(".hdr")]
    known |= {str(file) for path in headers for file in _beside(Path(path))}
    for above, names in walk_folders(campaign.root, index.folders):
        folder = str(campaign.root.joinpath(*above))
        for name in names or ():
            path = os.path.join(folder, name)  # noqa: PTH118 -- ten thousand at every new frame
            if os.path.splitext(name)[1].lower() in ALONE and path not in known:  # noqa: PTH122
                found.append(_shown(Path(path), campaign.root))
    return found


def _beside(path: Path) -> tuple[Path, ...]:
    try:
        return files_of(path)
    except Refused:
        return (path,)


def moments_of(
    files: Mapping[Path, WatchedFile],
    captured: Mapping[Path, float | None],
    stamps: Mapping[Path, Stamp],
) -> dict[Path, float]:
    """Return when the frames of one sensor were captured, s: by their headers where all state it, by their names, else by the files.

    Files that were written without a pause of a second have the time of the first, so that their names order them: a copied
    folder has the times of copying.
    """
    stated = {path: moment for path in files if (moment := captured.get(path)) is not None}
    if not files or len(stated) < len(files):
        stated = times_in_names(files)
    if files and len(stated) == len(files):
        return stated
    return _by_pauses({path: stamps[path][1] / 1e9 for path in files if path in stamps})


def _by_pauses(written: Mapping[Path, float]) -> dict[Path, float]:
    found: dict[Path, float] = {}
    start = last = -PAUSE_S
    for path, at in sorted(written.items(), key=lambda item: item[1]):
        start, last = (at if at - last >= PAUSE_S else start), at
        found[path] = start
    return found
