"""Read one frame of a capture, whatever the format of its file."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from levkas.core.digests import Stamp, stamp_of
from levkas.core.internal_errors import as_refusal
from levkas.core.problems import Refused
from levkas.core.progress import FRAMES
from levkas.core.text import what_stands_at
from levkas.readers import pictures
from levkas.readers.envi_header import DATA_SUFFIXES, find_header
from levkas.readers.facts import WRONG, Facts, UnreadableCapture, refused
from levkas.readers.raw import SUFFIXES as RAW_SUFFIXES
from levkas.readers.raw import read_raw_headers

TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
LARGEST_SAMPLE, BLOCK = 16 << 20, 60
"""Samples of a glimpse of a frame; rows that they are taken by."""
MOST_FACTS = 1 << 15
"""Files whose facts are kept in memory, about 1 kB each."""
EXPECTED = WRONG["format"][3]


class Reader(NamedTuple):
    """The reader of a format: its module, imported when first needed, and the functions of facts and frame in it.

    `signatures`: with which its files begin; none where the name decides. `suffixes`: of files that hold a frame and its
    facts by themselves, lower case.
    """

    module: str
    facts: str
    frame: str
    signatures: tuple[bytes, ...] = ()
    suffixes: tuple[str, ...] = ()


READERS = {
    "tiff": Reader("tiff", "read_tiff_facts", "read_tiff_page", TIFF, (".tif", ".tiff")),
    "png": Reader("pictures", "read_png_facts", "read_png", (pictures.PNG,), (".png",)),
    "jpeg": Reader("pictures", "read_jpeg_facts", "read_jpeg", (pictures.JPEG,), (".jpg", ".jpeg")),
    "raw": Reader("raw", "read_raw_facts", "read_raw"),
    "envi": Reader("envi", "read_envi_facts", "read_envi"),
    "ripple": Reader("containers", "read_ripple_facts", "read_ripple"),
    "hdf5": Reader("containers", "read_hdf5_facts", "read_hdf5_frame"),
    "hdf5-cube": Reader("containers", "read_hdf5_facts", "read_hdf5_frame", (b"MATLAB 7.3 ",)),
    "mat": Reader("containers", "read_mat_facts", "read_mat", (b"MATLAB 5.0 MAT-fil",)),
}
STACKS = {".rpl": "ripple", ".h5": "hdf5", ".hdf5": "hdf5"}
"""Suffixes of stacks of maps, whose first bytes name nothing."""
RENDERED = frozenset(suffix for reader in READERS.values() for suffix in reader.suffixes)
"""Suffixes of files whose first bytes name the format."""
ALONE = (RENDERED | {*RAW_SUFFIXES}) - {*DATA_SUFFIXES}
"""Suffixes of files that hold a frame by themselves."""


def kind_of(path: str | Path) -> str:
    """Return a key of `READERS` by name and first bytes.

    A header beside decides that ``.raw``, ``.dat``, ``.img``, … are ENVI; without one ``.raw`` is taken for a camera raw.
    Raises UnreadableCapture where there is no such file, or it is none of these.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    head = _first_bytes(path)
    if suffix in STACKS:
        return STACKS[suffix]
    named = next((kind for kind, row in READERS.items() if head.startswith(row.signatures)), "")
    if suffix == ".hdr" or (suffix in DATA_SUFFIXES and find_header(path)):
        return "envi"
    if suffix in RAW_SUFFIXES and named in ("", "tiff"):
        return "raw"
    if named:
        return named
    if find_header(path):
        return "envi"
    raise refused(path, "format", f"first bytes {head[:8].hex(' ')}")


def files_of(path: str | Path) -> tuple[Path, ...]:
    """Return every file that a frame is read from: of an ENVI cube or a Ripple stack its header and its data.

    A cube that cannot be opened is what is there of it.

    >>> [file.name for file in files_of("raw/icon1.tif")]
    ['icon1.tif']
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".rpl":
        from levkas.readers.containers import ripple_data

        return path, ripple_data(path)
    if suffix != ".hdr" and (suffix in ALONE or find_header(path) is None):
        return (path,)
    from levkas.readers.envi import open_envi

    try:
        cube = open_envi(path)
    except UnreadableCapture:
        return (path,)
    return cube.facts.path, cube.data


def read_facts(path: str | Path) -> Facts:
    """Return what a capture's headers declare, sizes checked; of a file that was not touched since, once a process.

    No pixel is decoded, but for camera raw, whose levels LibRaw has only after. Raises UnreadableCapture with the file,
    what was found and what was expected.
    """
    path = Path(path)
    # An ENVI header's facts hang on its data too; it costs little to read again.
    stamp = _stamp(path) if path.suffix.lower() in ALONE else None
    return _facts_of(path, stamp) if stamp else _call(kind_of(path), "facts", path)


@lru_cache(maxsize=MOST_FACTS)
def _facts_of(path: Path, _stamp: Stamp) -> Facts:
    return _call(kind_of(path), "facts", path)  # type: ignore[no-any-return]


def read_headers(path: str | Path) -> Facts:
    """Return what `read_facts` returns, but of a camera raw its EXIF alone, without a size: nothing is decoded."""
    path = Path(path)
    stamp = _stamp(path) if path.suffix.lower() in RAW_SUFFIXES else None
    return _headers_of(path, stamp) if stamp else read_facts(path)


@lru_cache(maxsize=MOST_FACTS)
def _headers_of(path: Path, _stamp: Stamp) -> Facts:
    return read_raw_headers(path) if kind_of(path) == "raw" else read_facts(path)


def _stamp(path: Path) -> Stamp | None:
    try:
        return stamp_of(path)
    except (OSError, ValueError):  # refused, with its reason, where it is opened
        return None


def read_frame(path: str | Path, *, page: int | None = None) -> np.ndarray:
    """Read one frame in its own dtype; EXIF orientation is ignored.

    `page` is that of a multi-page TIFF, from 0, without previews and masks; the first by default. The frame is (h, w) or
    (h, w, samples) in native byte order, colours red, green, blue; a camera raw is the mosaic of its visible area, a
    linear DNG its colours; of ENVI it is (lines, samples, bands).

    Raises UnreadableCapture whatever is wrong with the file: what is missing never reads as zeros.
    """
    if page is not None and page < 0:
        raise ValueError(f"page {page}; pages count from 0")
    kind = kind_of(path)
    FRAMES.add()
    if kind == "tiff":
        return _call(kind, "frame", Path(path), page)
    if page not in (None, 0):
        raise refused(path, "page", "a file of one frame", page=page)
    return _call(kind, "frame", Path(path))


def read_plane(path: str | Path, *, page: int | None = None) -> np.ndarray:
    """Read a frame of one sample a pixel, (h, w); equal samples of a grey picture saved as colours are one.

    Raises UnreadableCapture as `read_frame`; ``E_BAND_COUNT`` where the samples of a pixel differ.
    """
    values = read_frame(path, page=page)
    if values.ndim == 2:
        return values
    plane = values[..., 0]
    for sample in range(1, values.shape[2]):
        if not np.array_equal(values[..., sample], plane, equal_nan=values.dtype.kind == "f"):
            found = f"{values.shape[2]} samples a pixel that differ"
            raise refused(path, "samples", found)
    return np.ascontiguousarray(plane)


def read_sample(path: str | Path, *, most: int = LARGEST_SAMPLE) -> np.ndarray:
    """Read a frame, or of one of more than `most` samples bands of rows spread over it.

    All samples are decoded. Bands begin at multiples of 60 px and are as high, so that the tiles of a mosaic go on through
    them.
    """
    values = read_frame(path)
    count = max(1, most // (BLOCK * values[0].size))
    if values.size <= most or count * BLOCK >= len(values):
        return values
    starts = np.linspace(0, len(values) // BLOCK - 1, count).astype(int) * BLOCK
    return np.concatenate([values[start : start + BLOCK] for start in starts])


def _call(kind: str, which: Literal["facts", "frame"], path: Path, *page: int | None) -> Any:
    """Call a function of the readers of a kind; an exception that it does not foresee names the file."""
    row = READERS[kind]
    try:
        module = import_module(f"levkas.readers.{row.module}")
        function: Callable[..., Any] = getattr(module, getattr(row, which))
        return function(path, *page)
    except (Refused, MemoryError, OSError):
        raise
    except Exception as error:
        raise as_refusal(error, f"reading {Path(path).name}", path) from error


def _first_bytes(path: Path) -> bytes:
    if (found := what_stands_at(path)) != "a file":
        raise refused(path, "no file", found)
    try:
        with path.open("rb") as handle:
            head = handle.read(32)
    except OSError as error:
        raise refused(path, "closed", error) from error
    if not head:
        raise refused(path, "empty", "0 bytes")
    return head
