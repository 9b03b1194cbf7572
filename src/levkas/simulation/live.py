"""A simulated session: the frames of a campaign written one by one, as cameras write them, with faults among them."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from io import BytesIO
from pathlib import Path

import numpy as np

from levkas.campaign.campaign import Campaign, load_campaign
from levkas.campaign.discovery.file_index import FoundFile, scan_folders
from levkas.readers.frames import files_of, read_frame
from levkas.simulation.session_faults import FAULTS, FrameLevels, PlantedFault, plant_fault

START = datetime(2019, 5, 6, 9, 0)
APART = timedelta(seconds=20)
EXPOSURE_S, ISO, F_NUMBER = 0.1, 100, 8.0
AUTO, MANUAL = 0, 1
"""White balance of EXIF."""
PIECES = 4
"""In which a frame is written, as a slow cable would."""


@dataclass(frozen=True)
class SessionFrame:
    """A frame of a session, before it is captured.

    Parameters
    ----------
    path : Path
        In the campaign that was simulated whole.
    camera, role, target : str
    scene : tuple of str
        Camera, setup, target and band: frames of one scene are shots of it.
    """

    path: Path
    camera: str
    role: str
    target: str
    scene: tuple[str, ...]


@dataclass(frozen=True)
class PlayedFrame:
    """A frame as it was written.

    Parameters
    ----------
    path : Path
    fault : PlantedFault or None
    size : float
    done, total : int
    """

    path: Path
    fault: PlantedFault | None
    size: float
    done: int
    total: int

    @property
    def line(self) -> str:
        """The frame as a line of a log, its fault named."""
        fault = f"  planted: {self.fault.kind} {self.size:g}" if self.fault else ""
        return f"{self.done}/{self.total} {self.path.name}{fault}"


def session_frames(campaign: Campaign) -> list[SessionFrame]:
    """Return the frames in the order of a session: a camera after the other; darks, half of the whites, objects, whites."""
    frames = []
    for (name, setup), found in sorted(scan_folders(campaign).frames.items()):
        camera = campaign.cameras[name]
        roles = dict.fromkeys(campaign.whites_of(camera), "white")
        roles |= dict.fromkeys(campaign.darks_of(camera), "dark")
        roles |= dict.fromkeys(campaign.targets.charts, "chart")
        own = [_frame(f, name, setup, roles.get(f.target, "object")) for f in found]
        whites = [f for f in own if f.role == "white"]
        late = {id(f) for f in _later_half(whites)}
        frames += [f for f in own if f.role == "dark"]
        frames += [f for f in whites if id(f) not in late]
        frames += [f for f in own if f.role in ("object", "chart")]
        frames += [f for f in whites if id(f) in late]
    return frames


def play_session(
    source: Path,
    folder: Path,
    *,
    interval_s: float = 1.0,
    share: float = 0.1,
    rng: np.random.Generator,
) -> Iterator[PlayedFrame]:
    """Write the frames of a campaign into a folder, one by one, a share of them with a fault.

    Parameters
    ----------
    source, folder : Path
        The campaign, and a folder that has its campaign.toml and tables already.
    interval_s : float
        From one frame to the next.
    share : float
        Of frames into which a fault is planted; a frame with one is followed by the sound one after it.
    rng : Generator

    Yields
    ------
    frame : PlayedFrame
        As soon as its last byte is written.
    """
    campaign = load_campaign(source)
    frames = session_frames(campaign)
    for k, frame in enumerate(frames):
        start = time.monotonic()
        fault, size = None, 0.0
        able = [f for f in FAULTS if f.role == frame.role] if is_plantable(frame) else []
        if able and rng.random() < share:
            fault = able[int(rng.integers(len(able)))]
            size = fault.sizes[int(rng.integers(2))]
        contents = contents_of(campaign, frames, k, rng, fault, size)
        for path, data in contents.items():
            write_slowly(folder / path.relative_to(source), data, 0.2 * interval_s)
        yield PlayedFrame(frame.path, fault, size, k + 1, len(frames))
        time.sleep(max(0.0, interval_s - (time.monotonic() - start)))


def is_plantable(frame: SessionFrame) -> bool:
    """Whether faults are planted into a frame: into TIFF frames, not into scans."""
    return frame.path.suffix == ".tif" and frame.role != "chart"


def contents_of(
    campaign: Campaign,
    frames: Sequence[SessionFrame],
    number: int,
    rng: np.random.Generator,
    fault: PlantedFault | None = None,
    size: float = 0.0,
) -> dict[Path, bytes]:
    """Return the files of a frame and their bytes, with exposure, ISO and time in EXIF, and with a fault."""
    frame = frames[number]
    if not is_plantable(frame) and frame.path.suffix != ".tif":
        return {path: path.read_bytes() for path in files_of(frame.path)}
    codes, kind = read_frame(frame.path), "" if fault is None else fault.kind
    if fault is not None:
        beside = _beside(frames, frame)
        if fault.check == "twice":
            codes = read_frame(
                next(f.path for f in frames if f.scene == frame.scene and f != frame)
            )
        else:
            codes = plant_fault(fault, size, codes, levels_of(campaign, frame), rng, beside=beside)
    exposure_s = EXPOSURE_S * (size if kind.startswith("dark of another time") else 1)
    iso = int(ISO * (size if kind.startswith("another ISO") else 1))
    f_number = F_NUMBER * (size if kind.startswith("another f-number") else 1)
    balance = AUTO if kind.startswith("another white balance") else MANUAL
    data = _tiff(codes, exposure_s, iso, f_number, balance, START + number * APART)
    if kind.startswith("file cut short"):
        data = data[: max(1, int(len(data) * (1 - size)))]
    return {frame.path: data}


def levels_of(campaign: Campaign, frame: SessionFrame) -> FrameLevels:
    """Return black level, full scale and period of a frame's camera."""
    camera = campaign.cameras[frame.camera]
    sensor = next((s for s in camera.sensors if s.name == frame.scene[-1]), None)
    pattern = sensor.pattern if sensor else camera.pattern
    period = 1
    if pattern is not None:
        period = int(len(pattern) ** 0.5) if isinstance(pattern, str) else len(pattern)
    return FrameLevels(float(camera.black or 0), float(camera.saturation or 65535), period)


def write_slowly(path: Path, data: bytes, seconds: float) -> None:
    """Write a file under its own name in pieces: who looks meanwhile finds it half written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    step = max(1, -(-len(data) // PIECES))
    with path.open("wb") as handle:
        for start in range(0, len(data), step):
            handle.write(data[start : start + step])
            handle.flush()
            if seconds:
                time.sleep(seconds / PIECES)


def copy_declarations(source: Path, folder: Path) -> None:
    """Copy campaign.toml and its tables, without a frame."""
    for path in sorted(source.iterdir()):
        if path.is_file():
            shutil.copyfile(path, folder / path.name)


def _frame(found: FoundFile, camera: str, setup: str, role: str) -> SessionFrame:
    band = found.band or ("" if found.wavelength is None else f"{found.wavelength:g}")
    scene = (camera, setup, found.target, band, found.sensor)
    return SessionFrame(found.path, camera, role, found.target, scene)


def _later_half(whites: Sequence[SessionFrame]) -> list[SessionFrame]:
    """Return the later half of the shots of each band."""
    scenes: dict[tuple[str, ...], list[SessionFrame]] = {}
    for frame in whites:
        scenes.setdefault(frame.scene, []).append(frame)
    return [f for some in scenes.values() for f in some[(len(some) + 1) // 2 :]]


def _beside(frames: Sequence[SessionFrame], frame: SessionFrame) -> np.ndarray | None:
    """Return the codes of the white of an object's band, or of an object of a white's band."""
    role = {"object": "white", "white": "object"}.get(frame.role)
    camera, setup, _, band, sensor = frame.scene
    for other in frames:
        if other.role == role and (other.scene[:2], other.scene[3:]) == (
            (camera, setup),
            (band, sensor),
        ):
            return read_frame(other.path)
    return None


def _tiff(
    codes: np.ndarray, exposure_s: float, iso: int, f_number: float, balance: int, moment: datetime
) -> bytes:
    import tifffile

    buffer = BytesIO()
    tags = [
        (33434, "2I", 1, (round(exposure_s * 1000), 1000), True),
        (33437, "2I", 1, (round(f_number * 10), 10), True),
        (34855, "H", 1, iso, True),
        (41987, "H", 1, balance, True),
        (36867, "s", 0, moment.strftime("%Y:%m:%d %H:%M:%S"), True),
    ]
    tifffile.imwrite(buffer, codes, photometric="minisblack", metadata=None, extratags=tags)
    return buffer.getvalue()
