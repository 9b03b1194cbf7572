"""The spectral TIFF of the University of Eastern Finland: one page a band, after an RGB render.

Tag 65000 of the first band page holds the centre wavelengths, tag 65111 a text, tag 65001 of each page of a mask file its
label. Float pages are zlib with predictor 3, which every reader knows.
"""

from __future__ import annotations

import contextlib
import errno
import warnings
from collections.abc import Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from levkas import __version__
from levkas.colour.srgb import srgb_profile
from levkas.core.files import replacing, spooling
from levkas.core.machine import count_threads
from levkas.core.problems import Problem
from levkas.core.transpose import transpose
from levkas.database.credits import Credits
from levkas.database.tiff_pages import TiffRefused, open_pages

WAVELENGTHS, METADATA, LABEL, XMP, COPYRIGHT, ARTIST = 65000, 65111, 65001, 700, 33432, 315
STRIP_BYTES = 1 << 18
LEVEL = 1
GROUP = 16
"""Bands that are gathered in one passage over the memory: a line of the cache of float32."""
THREADS = 2
"""That compress."""
CLASSIC_LIMIT = 4_000_000_000
PREDICTORS = {"f": 3, "u": 2, "i": 2}


@dataclass(frozen=True)
class TiffHeader:
    """Facts of a spectral TIFF beside the pixels of its bands.

    `shape` is (height, width). `wavelengths`, tag 65000, nm: centres, centroids of sensitivities, or 0 … n−1 for channels
    without any. `text` is tag 65111, `dtype` that of the pages, `rgb` an sRGB render of any size for page 0, uint8,
    `px_per_mm` the sampling, for the resolution tags.
    """

    shape: tuple[int, int]
    wavelengths: Sequence[float]
    text: str = ""
    dtype: Any = np.float32
    rgb: np.ndarray | None = None
    px_per_mm: float | None = None
    credits: Credits = field(default_factory=Credits)


def write_pages(path: Path, blocks: Iterable[np.ndarray], header: TiffHeader) -> None:
    """Write one page a band from rows of all bands, (rows, width, bands), as they come from top to bottom.

    Raises ValueError where rows are missing, WriteRefused where the disk refuses.
    """
    shape = (*header.shape, len(header.wavelengths))
    with (
        ThreadPoolExecutor(count_threads(THREADS)) as pool,
        spooling(path.parent, path.name) as handle,
    ):
        spool = PageSpool(handle, shape, header.dtype, pool)
        for block in blocks:
            spool.write_rows(block)
        write_encoded_pages(path, spool.pages(), header)


def strip_rows(width: int, dtype: Any) -> int:
    """Return the rows of a strip."""
    return max(1, STRIP_BYTES // max(1, width * np.dtype(dtype).itemsize))


def write_encoded_pages(
    path: str | Path, pages: Generator[list[bytes], None, None], header: TiffHeader
) -> None:
    """Write pages whose strips `encode_strip` has made; raises WriteRefused where the disk refuses."""
    from tifffile import TiffWriter

    dtype, (height, width) = np.dtype(header.dtype), header.shape
    size = height * width * len(header.wavelengths) * dtype.itemsize
    common: dict[str, Any] = {"metadata": None, "contiguous": False, "compression": "zlib"}
    if px_per_cm := (header.px_per_mm or 0) * 10:
        common |= {"resolution": (px_per_cm, px_per_cm), "resolutionunit": "CENTIMETER"}
    centres, text = tuple(float(w) for w in header.wavelengths), _encode_text(header.text)
    tags = [(WAVELENGTHS, "f", len(centres), centres, True), (METADATA, "s", len(text), text, True)]
    with (
        # Its threads must not wait for the garbage collector.
        contextlib.closing(pages),
        replacing(path) as handle,
        TiffWriter(handle, bigtiff=size > CLASSIC_LIMIT, byteorder="<") as tiff,
    ):
        if header.rgb is not None:
            packet = header.credits.to_xmp()
            xmp = [(XMP, "B", len(packet), packet, True)] if packet else []
            tiff.write(
                np.ascontiguousarray(header.rgb, np.uint8),
                photometric="rgb",
                compressionargs={"level": LEVEL},
                predictor=2,
                iccprofile=srgb_profile(),
                **common,
                **_credit_tags(header.credits, xmp),
            )
        first = _credit_tags(header.credits if header.rgb is None else Credits(), tags)
        for index, encoded in enumerate(pages):
            tiff.write(
                iter(encoded),
                shape=header.shape,
                dtype=dtype,
                photometric="minisblack",
                predictor=PREDICTORS[dtype.kind] if dtype.itemsize > 1 else None,
                rowsperstrip=strip_rows(width, dtype),
                **common,
                **(first if index == 0 else {"software": False}),
            )


def _credit_tags(credits: Credits, extra: list[tuple[Any, ...]]) -> dict[str, Any]:
    for code, fact in ((ARTIST, credits.creator), (COPYRIGHT, credits.rights)):
        if value := fact.replace("\0", "").encode("utf-8", "replace"):
            extra.append((code, "s", len(value), value, True))
    title = " – ".join(part for part in (credits.title, credits.description) if part)
    return {
        "software": f"levkas {__version__}",
        "description": title.replace("\0", "").encode("utf-8", "replace") or None,
        "datetime": credits.moment,
        "extratags": extra,
    }


class RowPieces:
    """Rows as they come, (rows, width, bands), given on in pieces of one height; the last is what is left."""

    def __init__(self, shape: tuple[int, int, int], dtype: Any, height: int) -> None:
        self._shape, self._dtype, self._height = shape, dtype, height
        self._given = self._filled = 0
        self._begun: np.ndarray | None = None

    def take(self, block: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Yield (first row, piece) of the pieces that some rows complete; raises ValueError where rows are too many."""
        if self._given + self._filled + len(block) > self._shape[0]:
            raise ValueError(f"more rows than {self._shape[0]}")
        while len(block):
            height = min(self._height, self._shape[0] - self._given)
            part, block = block[: height - self._filled], block[height - self._filled :]
            if len(part) < height:
                if self._begun is None:
                    self._begun = np.empty((height, *self._shape[1:]), self._dtype)
                self._begun[self._filled : self._filled + len(part)] = part
                self._filled += len(part)
                if self._filled < height:
                    return
                part, self._begun = self._begun, None
            first, self._filled, self._given = self._given, 0, self._given + height
            yield first, part

    def check_whole(self) -> None:
        if self._given != self._shape[0]:
            found = self._given + self._filled
            raise ValueError(f"{found} rows of {self._shape[0]} were written")


class PageSpool:
    """Strips of band pages: taken from rows of all bands, (height, width, bands), given back band by band.

    `handle` is read and written; `pool` compresses, and the bytes are the same for any number of its threads.
    """

    def __init__(
        self, handle: BinaryIO, shape: tuple[int, int, int], dtype: Any, pool: ThreadPoolExecutor
    ) -> None:
        self._handle, self._dtype, self._bands, self._pool = handle, dtype, shape[2], pool
        self._pieces = RowPieces(shape, dtype, strip_rows(shape[1], dtype))
        self._places: list[tuple[int, int]] = []

    def write_rows(self, block: np.ndarray) -> None:
        """Take rows, (rows, width, bands), from top to bottom; some strips are compressed while others are written."""
        strips = [strip for _, strip in self._pieces.take(np.asarray(block, self._dtype))]
        jobs = [(strip, band) for strip in strips for band in range(0, self._bands, GROUP)]
        for group in self._pool.map(_encode_strips, jobs):
            for encoded in group:
                self._places.append((self._handle.tell(), len(encoded)))
                self._handle.write(encoded)

    def pages(self) -> Generator[list[bytes], None, None]:
        """Yield the strips of each band; raises ValueError where rows are missing, OSError where they cannot be read back."""
        self._pieces.check_whole()
        # The strips of a page lie far apart: a buffer would read all between them, for each page anew.
        self._handle.flush()
        plain = getattr(self._handle, "raw", self._handle)
        for band in range(self._bands):
            yield [_read(plain, *place) for place in self._places[band :: self._bands]]

    def drop(self) -> None:
        """Give the disk back what was spooled; no page can be had any more."""
        self._handle.seek(0)
        self._handle.truncate()


def _read(handle: BinaryIO, start: int, size: int) -> bytes:
    handle.seek(start)
    found = handle.read(size)
    if len(found) < size:
        raise OSError(errno.EIO, f"{len(found)} bytes of {size} could be read back")
    return found


def encode_strip(strip: Any) -> bytes:
    """Predict and deflate one strip, (rows, width), as the strips of these files are stored.

    The bytes are those of libdeflate at level 1: ISA-L is faster, but its bytes are not always the same.

    >>> import zlib
    >>> zlib.decompress(encode_strip(np.uint8([[3, 4], [5, 6]])))
    b'\\x03\\x04\\x05\\x06'
    """
    import imagecodecs

    if strip.dtype.itemsize > 1:
        predict = "floatpred_encode" if strip.dtype.kind == "f" else "delta_encode"
        strip = getattr(imagecodecs, predict)(strip, axis=-1)
    data = np.ascontiguousarray(strip).view(np.uint8)
    return bytes(imagecodecs.deflate_encode(data.tobytes(), level=LEVEL))


def _encode_strips(job: tuple[np.ndarray, int]) -> list[bytes]:
    """Return `encode_strip` of `GROUP` bands, from one on, of some rows, (rows, width, bands)."""
    rows, first = job
    group = rows[:, :, first : first + GROUP]
    planes = transpose(group.reshape(-1, group.shape[2]))
    return [encode_strip(plane) for plane in planes.reshape(-1, *rows.shape[:2])]


def write_stiff(
    path: str | Path,
    cube: np.ndarray,
    wavelengths: Sequence[float] | np.ndarray,
    rgb: np.ndarray | None,
    metadata: str = "",
) -> None:
    """Write a spectral TIFF, with the name and the order of arguments that its users know.

    `cube` is (height, width, bands): floats (reflectance or counts) are written as float32, uint16 (reflectance × 65535) and
    uint8 as they are. `wavelengths`, nm, ascend or descend; `rgb` is a render in sRGB, (height, width, 3) uint8, or None;
    `metadata` a text that is kept with the bands, such as JSON. Raises TiffRefused where these do not fit, WriteRefused.

    >>> write_stiff(folder / "a.tif", np.full((2, 3, 2), 0.5), [450.0, 550.0], None, "by hand")
    >>> cube, wavelengths, rgb, text = read_stiff(folder / "a.tif")
    >>> cube.shape, wavelengths.tolist(), rgb, text
    ((2, 3, 2), [450.0, 550.0], None, 'by hand')
    """
    path, cube = Path(path), np.asarray(cube)
    keep = cube.dtype in (np.uint8, np.uint16)
    if cube.ndim != 3 or (cube.dtype.kind != "f" and not keep):
        what, found = "the cube does not fit", f"{cube.shape} {cube.dtype}"
        _refuse("E_SIZE", path, what, found, "(height, width, bands) of floats, uint16 or uint8")
    if rgb is not None and (rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8):
        found = f"{rgb.shape} {rgb.dtype}"
        _refuse("E_SIZE", path, "the RGB render does not fit", found, "(h, w, 3) uint8")
    if len(wavelengths) != cube.shape[2]:
        what = "bands and wavelengths do not fit"
        _refuse("E_BAND_COUNT", path, what, len(wavelengths), cube.shape[2])
    header = TiffHeader(
        *(cube.shape[:2], [float(w) for w in wavelengths], metadata),
        *(cube.dtype if keep else np.float32, rgb),
    )
    write_pages(path, [cube], header)


def read_stiff(
    path: str | Path, silent: bool = False, rgb_only: bool = False
) -> tuple[np.ndarray | None, np.ndarray, np.ndarray | None, str]:
    """Return (cube, wavelengths, rgb, metadata) of a spectral TIFF, with the name and the order of arguments that its users know.

    The cube is (height, width, bands), wavelengths, nm, ascending, 0, 1, 2 … where the file has none; uint16 pages become
    float32 reflectance (÷ 65535). `silent`: no warning where wavelengths or texts are repeated on every page; `rgb_only`: the
    cube is None. Raises TiffRefused of damaged or truncated files, and of lists that differ from page to page.

    >>> path = plates / "database/objects/one/one_photo.tif"
    >>> cube, wavelengths, rgb, text = read_stiff(path)
    >>> cube.shape, cube.dtype.name, rgb.shape
    ((200, 240, 3), 'float32', (200, 240, 3))
    """
    pages = open_pages(path)
    wavelengths = _only(pages.path, pages.tags(WAVELENGTHS), "wavelengths", silent)
    text = _only(pages.path, pages.tags(METADATA), "metadata", silent) or ""
    centres = np.arange(len(pages), dtype=np.float64)
    if wavelengths is not None:
        centres = np.atleast_1d(np.asarray(wavelengths, np.float32))
        if len(centres) != len(pages):
            message = "pages and wavelengths do not fit: pages are missing, or one is not a band"
            _refuse("E_BAND_COUNT", pages.path, message, len(pages), len(centres), WAVELENGTHS)
    cube = None if rgb_only else pages.read()
    if centres[0] > centres[-1]:
        centres = centres[::-1]
        cube = None if cube is None else cube[:, :, ::-1]
    if cube is not None and cube.dtype == np.uint16:
        cube = cube.astype(np.float32) / np.float32(65535)
    return cube, centres, pages.read_render(), decode_text(text)


def read_tiff_pages(path: str | Path) -> np.ndarray:
    """Return the pages of a flags or sigma file as they are stored, (height, width, bands)."""
    return open_pages(path).read()


def _only(path: Path, values: Sequence[Any], what: str, silent: bool) -> Any:
    found = [value for value in values if value is not None and value != ""]
    if any(value != found[0] for value in found):
        _refuse("E_VALUE", path, f"the pages have different {what}", "several", "one")
    if len(found) > 1 and not silent:
        warnings.warn(f"{path}: {what} repeated on {len(found)} pages", stacklevel=3)
    return found[0] if found else None


def _encode_text(text: str) -> bytes:
    # Old readers cannot take an empty text, strip quotes around the whole, and spaces at its ends.
    encoded = text.encode("unicode_escape")
    for end in (b"'", b" "):
        if encoded.startswith(end):
            encoded = b"\\x%02x" % end[0] + encoded[1:]
        if encoded.endswith(end):
            encoded = encoded[:-1] + b"\\x%02x" % end[0]
    return encoded or b" "


def decode_text(stored: str) -> str:
    """Return the text of tag 65111 as it was meant."""
    if not stored.strip():
        return ""
    try:
        text = stored.encode("ascii", "backslashreplace").decode("unicode_escape")
    except UnicodeDecodeError:  # written by others, with backslashes of their own
        return stored
    if len(stored) > 1 and stored[0] == stored[-1] == "'":  # early files of the group
        text = text.strip("'").replace("\\n", "\n")
    return text


def read_mtiff(path: str | Path) -> dict[str, np.ndarray]:
    """Return the masks of a TIFF, a page each, labelled by tag 65001: label → where the page is above 0, (height, width) bool.

    Raises TiffRefused where a page has no label, or two have the same.

    >>> import tifffile
    >>> mask = np.zeros((2, 3), np.uint8)
    >>> mask[0, 1] = 255
    >>> tifffile.imwrite(folder / "m.tif", mask, extratags=[(LABEL, "s", 0, "glare", True)])
    >>> {label: int(mask.sum()) for label, mask in read_mtiff(folder / "m.tif").items()}
    {'glare': 1}
    """
    pages = open_pages(path, uniform=False)
    masks: dict[str, np.ndarray] = {}
    for index, label in enumerate(pages.tags(LABEL)):
        if label is None:
            _refuse("E_KEY", pages.path, f"page {index} has no label", None, "a text", LABEL)
        name = decode_text(str(label))
        if name in masks:
            _refuse("E_BAND_TWICE", pages.path, f"two masks are called {name!r}", name, "one")
        masks[name] = pages.read_page(index) > 0
    return masks


def _refuse(
    code: str, path: Path, message: str, found: Any, expected: Any, tag: int | None = None
) -> None:
    field = None if tag is None else f"tag {tag}"
    raise TiffRefused(Problem(code, message, str(path), field, str(found), str(expected)))
