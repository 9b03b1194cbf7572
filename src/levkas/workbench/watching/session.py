"""A session as a function of its folder: every frame that is whole, its findings, and what is missing.

Nothing hangs on when or in which order a frame came: of the same files the state is the same, after a restart or in a
second window.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from levkas.building.hashes import HASHES, Hashes, session_folder
from levkas.calibration.codes import stated_full_scale
from levkas.campaign.campaign import Camera, Campaign
from levkas.campaign.discovery.patterns import natural
from levkas.core.digests import Stamp, stamp_of
from levkas.core.internal_errors import InternalError
from levkas.core.problems import Refused
from levkas.planning.loading import load_setup
from levkas.quality.frame_checks import (
    FrameFinding,
    FrameJudge,
    FrameMeasures,
    FrameOfSet,
    SetRules,
    measure_frame,
    worst,
)
from levkas.readers.envi import open_envi
from levkas.readers.facts import Facts, LibraryMissing
from levkas.readers.frames import kind_of, read_facts, read_frame
from levkas.workbench.watching.cache import MeasureCache
from levkas.workbench.watching.files import (
    FolderListing,
    FolderWatch,
    FrameState,
    WatchedFile,
    fresh_of,
    moments_of,
)
from levkas.workbench.watching.missing import Missing, find_missing

PLAN = "bench.toml"
"""A setup file that names the cameras of the session."""
WHOLE_S = 5.0
"""How long a file rests before one that cannot be read counts as broken: until then it may be half written."""
RETRY_S = 1.0
READ_S = 0.5
"""How long frames are read before they are judged, and shown; longer where judging takes more than half of it."""
MOST_LINES, SIDE_BY_SIDE = 256, 128
"""Lines of a scan that are read, spread over it; and those in its middle, for the focus."""
MOST_SAMPLES = 1 << 28
"""Of pages of a file, which are thinned to it."""


@dataclass(frozen=True)
class SessionState:
    """The whole session.

    Parameters
    ----------
    frames : tuple of FrameState
        In natural order of their names.
    missing : tuple of Missing
        What is to be captured, or captured again, before the object leaves.
    guessed : bool
        Whether there is no campaign.toml.
    strays : tuple of str
        Pictures that no pattern fits.
    problems : tuple of str
    away : bool
        Whether the folder cannot be reached.
    """

    frames: tuple[FrameState, ...] = ()
    missing: tuple[Missing, ...] = ()
    guessed: bool = False
    strays: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    away: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Return the session, JSON-ready."""
        counts = {v: 0 for v in ("green", "look", "stop", "waiting")}
        for frame in self.frames:
            counts[frame.verdict] += 1
        return {
            "counts": counts,
            "frames": [frame.to_dict() for frame in self.frames],
            "missing": [asdict(item) for item in self.missing],
            "guessed": self.guessed,
            "strays": list(self.strays[:20]),
            "problems": list(self.problems),
            "away": self.away,
        }


@dataclass(eq=False)
class _Known:
    """A frame that was read: its stamp, facts and measures; or why it could not be."""

    stamp: Stamp | None
    key: str = ""
    facts: Facts | None = None
    measures: FrameMeasures | None = None
    refused: str = ""
    tried: float = 0.0
    hashed: bool = False
    judged: tuple[object, FrameOfSet] | None = None
    """The frame as it is judged, and what it was made of: the same one is not judged again."""


_Found = tuple[dict[Path, list[FrameFinding]], dict[Path, float]]
"""Findings and moments of frames."""


@dataclass
class WatchedSession:
    """Follows a folder; `poll` takes in what changed, `state` says what it is.

    Parameters
    ----------
    folder : Path
        Of a campaign, or of frames alone.
    cache : MeasureCache, optional
        By default the user's for this folder.
    """

    folder: Path
    cache: MeasureCache | None = None
    _known: dict[Path, _Known] = field(default_factory=dict)
    _judges: dict[tuple[str, str, str], tuple[Camera, FrameJudge]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.watch = FolderWatch(Path(self.folder))
        self.cache = self.cache or MeasureCache(session_folder(self.watch.root))
        self.hashes = Hashes(self.cache.folder / HASHES)
        self.listing = FolderListing()
        self._now = 0.0
        self._plan: tuple[Stamp | None, tuple[str, ...]] = (None, ())

    @property
    def campaign(self) -> Campaign | None:
        """The campaign, or what was guessed of it."""
        return self.listing.campaign

    def poll(self, now: float | None = None, most_s: float = np.inf) -> Iterator[WatchedFile]:
        """Look at the folder and read the frames that came to rest, yielding each as it is read.

        Parameters
        ----------
        now : float, optional
            s, of a clock that does not jump.
        most_s : float
            After which no other frame is begun.
        """
        now = time.monotonic() if now is None else now
        before, self._now = self.listing.campaign, now
        self.listing = listing = self.watch.look(now)
        if listing.campaign is not before:
            self._forget_others()
        if self.watch.away_since is not None:
            return
        for gone in self._known.keys() - listing.files.keys():
            del self._known[gone]
        end = time.monotonic() + most_s
        for path, file in listing.files.items():
            if self._is_due(path, now):
                self._read(file, now)
                yield file
                if time.monotonic() > end:
                    return

    def hash_frames(self, most_s: float = np.inf) -> int:
        """Hash frames that were read, and keep that for a build, which reads none of them again for it; return how many."""
        end, done = time.monotonic() + most_s, 0
        for path in self.listing.files:
            known = self._known.get(path)
            if known is None or known.hashed or known.measures is None or not self._is_read(path):
                continue
            with suppress(OSError, Refused):
                self.hashes.of_frame(path)
            known.hashed, done = True, done + 1
            if time.monotonic() > end:
                break
        if done:
            self.hashes.save()
        return done

    def settle(self, patience_s: float = 60.0) -> SessionState:
        """Poll until every file was read, or is broken, and return the state."""
        end = time.monotonic() + patience_s
        while True:
            while any([True for _ in self.poll()]):
                pass
            state = self.state()
            waiting = any(frame.verdict == "waiting" for frame in state.frames)
            done = self.watch.is_in_vain if self.campaign is None else not waiting
            if done or time.monotonic() > end:
                return state
            time.sleep(0.1)

    def state(self) -> SessionState:
        """Return the session as the folder is now."""
        listing, campaign = self.listing, self.listing.campaign
        if campaign is None:
            return SessionState(problems=listing.problems, away=self.watch.away_since is not None)
        findings, moments = self._findings(campaign, listing)
        frames = [self._shown(file, findings, moments) for file in listing.files.values()]
        frames.sort(key=lambda f: (natural(f.file.name), f.file.name))
        planned = [name for name in self._planned() if name not in campaign.cameras]
        missing = find_missing(campaign, frames, planned) if frames else ()
        away = self.watch.away_since is not None
        return SessionState(
            tuple(frames), tuple(missing), listing.guessed, listing.strays, listing.problems, away
        )

    def picture_of(self, name: str) -> bytes | None:
        """Return the small picture of a frame as PNG, brightened so that its brightest hundredth is white; None of none."""
        import cv2

        path = next((p for p, file in self.listing.files.items() if file.name == name), None)
        known = self._known.get(path) if path is not None else None
        if known is None or known.measures is None:
            return None
        picture = known.measures.picture
        low, high = np.quantile(picture, (0.002, 0.99))
        light = np.clip((picture - low) / max(float(high - low), 1.0), 0, 1) ** (1 / 2.2)
        done, data = cv2.imencode(".png", np.round(255 * light).astype(np.uint8))
        return data.tobytes() if done else None

    def follow(self, interval_s: float = 0.3) -> Iterator[tuple[SessionState, list[FrameState]]]:
        """Yield the state and what of it is new, for ever: a frame that came, or whose findings changed.

        Parameters
        ----------
        interval_s : float
            Between two looks; longer where a look takes longer than half of it, so that a core is never held.
        """
        known: dict[str, FrameState] = {}
        last: object = None
        took = 0.0
        while True:
            start = time.monotonic()
            read = sum(1 for _ in self.poll(most_s=max(READ_S, 2 * took)))
            waiting = any(frame.verdict == "waiting" for frame in known.values())
            now = (self.listing.stamps, self.listing.problems, self.watch.away_since, self.campaign)
            if read or waiting or now != last:
                judged = time.monotonic()
                last, state = now, self.state()
                fresh = fresh_of(state.frames, known)
                known = {frame.file.name: frame for frame in state.frames}
                took = time.monotonic() - judged
                yield state, fresh
            if not read and not self.listing.guessed:
                self.hash_frames(READ_S)
            if not read:
                time.sleep(max(interval_s, 2 * (time.monotonic() - start)))

    def _planned(self) -> tuple[str, ...]:
        """Return the cameras of a setup file that lies beside the frames."""
        path = self.watch.root / PLAN
        try:
            stamp = stamp_of(path)
        except OSError:
            return ()
        if self._plan[0] != stamp:
            try:
                self._plan = stamp, tuple(load_setup(path).cameras)
            except Refused:
                self._plan = stamp, ()
        return self._plan[1]

    def _forget_others(self) -> None:
        """Let frames be measured anew whose pattern, full scale or role a changed campaign declares otherwise."""
        for path, known in self._known.items():
            file = self.listing.files.get(path)
            if file and known.facts and known.stamp and known.key != self._key(file, known):
                known.stamp = None

    def _key(self, file: WatchedFile, known: _Known) -> str:
        """Return the key of a frame's measures: everything that they depend on."""
        assert self.listing.campaign is not None and known.facts is not None
        camera = self.listing.campaign.cameras[file.camera]
        pattern, full = _pattern_of(camera, file, known.facts), _full_of(camera, known.facts)
        text = repr((known.stamp, file.role == "white", pattern, full, camera.kind))
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def _is_due(self, path: Path, now: float) -> bool:
        known = self._known.get(path)
        if not self.watch.is_at_rest(path, now):
            return False
        if known is None or known.stamp != self.listing.stamps[path]:
            return True
        return (
            bool(known.refused) and now - known.tried >= RETRY_S and not self._is_broken(path, now)
        )

    def _is_read(self, path: Path) -> bool:
        """Whether what is known of a file is of the file as it is now."""
        return path in self._known and self._known[path].stamp == self.listing.stamps.get(path)

    def _is_broken(self, path: Path, now: float) -> bool:
        return self.watch.rest_s(path, now) >= WHOLE_S + RETRY_S

    def _read(self, file: WatchedFile, now: float) -> None:
        assert self.cache is not None and self.listing.campaign is not None
        stamp = self.listing.stamps[file.path]
        camera = self.listing.campaign.cameras[file.camera]
        known = _Known(stamp, tried=now)
        try:
            # A camera raw has its levels only when it is decoded: read first, it is decoded once.
            raw = read_frame(file.path) if kind_of(file.path) == "raw" else None
            known.facts = read_facts(file.path)
            known.key = self._key(file, known)
            known.measures = self.cache.get(known.key)
            if known.measures is None:
                known.measures = self.cache.put(known.key, _measure(file, camera, known.facts, raw))
        except (InternalError, LibraryMissing):
            raise
        except (Refused, OSError) as refused:
            known.refused = _why(refused)
        self._known[file.path] = known

    def _findings(self, campaign: Campaign, listing: FolderListing) -> _Found:
        groups: dict[tuple[str, str, str], dict[Path, WatchedFile]] = {}
        for path, file in listing.files.items():
            known = self._known.get(path)
            if known is not None and known.measures is not None and self._is_read(path):
                groups.setdefault((file.camera, file.setup, file.sensor), {})[path] = file
        found: dict[Path, list[FrameFinding]] = {}
        moments: dict[Path, float] = {}
        for key, files in groups.items():
            camera = campaign.cameras[key[0]]
            if key[1] and not _darks(files):  # a setup without darks of its own takes the camera's
                files = {**files, **_darks(groups.get((key[0], "", key[2]), {}))}
            captured = {path: _moment(self._facts(path)) for path in files}
            at = moments_of(files, captured, listing.stamps)
            frames = [self._of_set(file, camera, at.get(path, 0.0)) for path, file in files.items()]
            if key not in self._judges or self._judges[key][0] != camera:
                self._judges[key] = camera, FrameJudge(_rules(camera))
            judged = self._judges[key][1].judge(frames)
            for path, file in files.items():
                if (file.camera, file.setup, file.sensor) == key:
                    found[path], moments[path] = judged[file.name], at.get(path, 0.0)
        return found, moments

    def _facts(self, path: Path) -> Facts:
        facts = self._known[path].facts
        assert facts is not None
        return facts

    def _of_set(self, file: WatchedFile, camera: Camera, at: float) -> FrameOfSet:
        known, facts = self._known[file.path], self._facts(file.path)
        assert known.measures is not None
        made_of = file, at, camera, facts, known.measures
        if known.judged is not None and known.judged[0] == made_of:
            return known.judged[1]
        pattern = _pattern_of(camera, file, facts)
        black = camera.black if camera.black is not None else facts.black
        frame = FrameOfSet(
            file.name, file.role, file.target, facts, known.measures,
            band=file.band, shot=file.shot, tile=file.tile, at=at,
            exposure_s=file.exposure_s or facts.exposure_s,
            names=_names_of(pattern, facts, len(known.measures.level)),
            full=_full_of(camera, facts), black=black,
        )  # fmt: skip
        known.judged = made_of, frame
        return frame

    def _shown(
        self,
        file: WatchedFile,
        findings: Mapping[Path, list[FrameFinding]],
        moments: Mapping[Path, float],
    ) -> FrameState:
        known = self._known.get(file.path)
        if (
            not self._is_read(file.path)
            or known is None
            or (known.refused and not self._is_broken(file.path, self._now))
        ):
            return FrameState(file, "waiting", exposure_s=file.exposure_s)
        if known.measures is None or known.facts is None:
            advice = "capture it again, or copy it again from the camera's card"
            broken = FrameFinding("file", "stop", f"the file is not whole: {known.refused}", advice)
            return FrameState(file, "stop", (broken,), exposure_s=file.exposure_s)
        own, at = findings.get(file.path, []), moments.get(file.path, 0.0)
        exposure_s = file.exposure_s or known.facts.exposure_s
        size = tuple(map(int, known.measures.shape))
        return FrameState(file, worst(own), tuple(own), at, exposure_s, size)


def _darks(files: Mapping[Path, WatchedFile]) -> dict[Path, WatchedFile]:
    return {path: file for path, file in files.items() if file.role == "dark"}


def _rules(camera: Camera) -> SetRules:
    return SetRules(
        overrule=tuple(camera.overrule),
        brackets=camera.exposures != "one",
        scanned=camera.traits.is_scanned,
        plain=not camera.traits.is_calibrated,
    )


def _pattern_of(camera: Camera, file: WatchedFile, facts: Facts) -> Any:
    """Return the mosaic of a frame: of its sensor, else of its camera, else what its file states."""
    if len(facts.shape) == 3:
        return None
    sensor = next((s for s in camera.sensors if s.name == file.sensor), None)
    declared = sensor.pattern if sensor else camera.pattern
    return declared or (facts.pattern if camera.traits.is_calibrated else None)


def _names_of(pattern: Any, facts: Facts, channels: int) -> tuple[str, ...]:
    from levkas.quality.frame_checks.measures import names_of

    names = names_of(pattern, facts.band_names or ())
    return (
        tuple(names) if len(names) == channels else tuple(f"band {k + 1}" for k in range(channels))
    )


def _full_of(camera: Camera, facts: Facts) -> float | None:
    """Return the full scale; None where only the size of the words is known, as of 12 bits in words of 16."""
    found = stated_full_scale(facts, saturation=camera.saturation, bits=camera.bits)
    words = found is not None and found.counts == 65535 and not (camera.saturation or camera.bits)
    return None if found is None or (words and not facts.saturation) else found.counts


@lru_cache(maxsize=1 << 15)
def _seconds(captured: str) -> float | None:
    try:
        moment = datetime.fromisoformat(captured)
    except ValueError:
        return None
    return moment.replace(tzinfo=moment.tzinfo or UTC).timestamp()


def _moment(facts: Facts) -> float | None:
    return None if facts.captured is None else _seconds(facts.captured)


def _why(refused: Exception) -> str:
    if isinstance(refused, Refused) and refused.problems:
        problem = refused.problems[0]
        return f"{problem.message}" + (f" ({problem.found})" if problem.found else "")
    return str(refused)


def _measure(
    file: WatchedFile, camera: Camera, facts: Facts, values: np.ndarray | None
) -> FrameMeasures:
    """Read a frame that was not read yet, of a scan some lines, and measure it."""
    pattern, full = _pattern_of(camera, file, facts), _full_of(camera, facts)
    if facts.kind == "envi":
        cube = open_envi(file.path)
        lines = facts.shape[0]
        chosen = np.unique(np.linspace(0, lines - 1, min(lines, MOST_LINES)).astype(int))
        values = np.concatenate([cube.read_lines(int(k), int(k) + 1) for k in chosen])
        middle = max(0, (lines - SIDE_BY_SIDE) // 2)
        detail = cube.read_lines(middle, min(lines, middle + SIDE_BY_SIDE)).mean(2)
        found = measure_frame(values, full=full, detail=detail)
        return _with_height(found, lines)
    if facts.pages > 1 and (camera.traits.reads_pages or not file.band):
        thin = max(1, -(-prod(facts.shape) * facts.pages // MOST_SAMPLES))
        pages = [read_frame(file.path, page=k)[::thin] for k in range(facts.pages)]
        values = np.stack([page if page.ndim == 2 else page[..., 0] for page in pages], -1)
        return _with_height(measure_frame(values, full=full), facts.shape[0])
    values = read_frame(file.path) if values is None else values
    return measure_frame(values, full=full, pattern=pattern)


def _with_height(measures: FrameMeasures, height: int) -> FrameMeasures:
    from dataclasses import replace

    return replace(measures, shape=np.array([height, measures.shape[1]]))
