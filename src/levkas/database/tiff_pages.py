"""Pages of a TIFF read as planes; what is missing, cut off or damaged is refused, never zeros."""

from __future__ import annotations

import struct
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from levkas.core.machine import count_threads
from levkas.core.problems import Problem, Refused
from levkas.core.text import missing_path
from levkas.core.threads import each
from levkas.readers.facts import COPY_AGAIN, UnreadableCapture, check_ratio
from levkas.readers.tiff import LARGEST_RATIO, check_strips
from levkas.readers.tiff_directories import directories_of

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator, Sequence

    from tifffile import TiffPage

DAMAGE = (
    *(RuntimeError, ValueError, IndexError, KeyError, TypeError, AttributeError),
    *(struct.error, OverflowError, ZeroDivisionError, MemoryError, AssertionError, OSError),
)
"""What damaged files lead tifffile and zarr to."""
FIRST_PRIVATE = 65000
FIX = "The file is damaged or not a TIFF: copy it again, or build it again."


class TiffRefused(Refused):
    """A TIFF cannot be read as what it should be."""


class TiffPages:
    """The band pages of one file, each (height, width), and the render before them; opened by `open_pages`.

    `shape` is (height, width, bands). The file is opened anew for each reading, so that any number of these can be held,
    and read from several threads.
    """

    def __init__(
        self, path: Path, render: TiffPage | None, bands: list[TiffPage], tags: list[dict[int, Any]]
    ) -> None:
        self.path, self._render, self._bands, self._tags = path, render, bands, tags
        height, width = bands[0].shape
        self.shape = (int(height), int(width), len(bands))
        self.dtype = np.dtype(bands[0].dtype)

    def __len__(self) -> int:
        return len(self._bands)

    def tags(self, code: int) -> list[Any]:
        """Return the value of a private tag (>= 65000) on every band page, None where it is not."""
        return [tags.get(code) for tags in self._tags]

    def read_render(self) -> np.ndarray | None:
        """Return the RGB page, (height, width, 3), or None."""
        if self._render is None:
            return None
        from tifffile import TiffFile

        try:
            with self.path.open("rb") as handle, TiffFile(handle, name=self.path.name) as tiff:
                return tiff.pages[0].asarray()
        except DAMAGE as error:
            raise TiffRefused(_unreadable(self.path, error)) from error

    def read_page(self, index: int, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Return rows `start` to `stop` of one page; only the strips that hold them are read."""
        page = self._bands[index]
        stop = page.shape[0] if stop is None else min(stop, page.shape[0])
        plane = np.empty((max(0, stop - start), page.shape[1]), page.dtype)
        high = int(page.tilelength if page.is_tiled else min(page.rowsperstrip, page.shape[0]))
        across = page.chunked[-1]
        wanted = range(start // high * across, -(-stop // high) * across)
        try:
            with self.path.open("rb") as handle:
                for number in wanted if len(plane) else ():
                    _place(handle, page, number, plane, start)
        except DAMAGE as error:
            raise TiffRefused(_unreadable(self.path, error, index)) from error
        return plane

    def strips(self) -> Generator[list[bytes], None, None]:
        with self.path.open("rb") as handle:
            for page in self._bands:
                yield [_stored(handle, page, number) for number in range(len(page.dataoffsets))]

    def read(
        self, start: int = 0, stop: int | None = None, bands: Sequence[int] | None = None
    ) -> np.ndarray:
        """Return some rows of some bands, (rows, width, bands), bands innermost in memory."""
        chosen = range(len(self)) if bands is None else bands
        stop = self.shape[0] if stop is None else min(stop, self.shape[0])
        cube = np.empty((max(0, stop - start), self.shape[1], len(chosen)), self.dtype)

        def fetch(place: int) -> None:
            cube[:, :, place] = self.read_page(chosen[place], start, stop)

        each(fetch, range(len(chosen)))
        return cube

    def planes(
        self, start: int = 0, stop: int | None = None, bands: Sequence[int] | None = None
    ) -> Iterator[np.ndarray]:
        """Yield some rows of some bands in turn, (rows, width): for sums over bands, which need no cube."""
        chosen = range(len(self)) if bands is None else bands
        with ThreadPoolExecutor(count_threads(2)) as pool:
            yield from pool.map(lambda band: self.read_page(band, start, stop), chosen)


def open_pages(path: str | Path, *, uniform: bool = True) -> TiffPages:
    """Read the directory of a TIFF and check it against the file's size.

    `uniform`: all band pages must have one size and type, and page 0 may be an RGB render. Raises TiffRefused:
    ``E_UNREADABLE``, ``E_TRUNCATED`` (data or pages missing), ``E_SIZE`` (pages that differ).
    """
    path = Path(path) if isinstance(path, str) else path
    with _opening(path) as pages:
        tags = [{t.code: t.value for t in p.tags if t.code >= FIRST_PRIVATE} for p in pages]
        first = int(uniform and pages[0].ndim == 3)
        _check_bands(path, pages[first:], uniform)
        return TiffPages(path, pages[0] if first else None, pages[first:], tags[first:])


@contextmanager
def _opening(path: Path) -> Iterator[list[TiffPage]]:
    """Open all pages of a TIFF whose directories and strips lie in the file; errors of the block are refusals too."""
    from tifffile import TiffFile

    try:
        if path.exists() and not path.is_file():  # to open a pipe waits for ever
            raise ValueError("it is not a file")
        count = len(directories_of(path))
        with path.open("rb") as handle, TiffFile(handle, name=path.name) as tiff:
            pages: list[Any] = list(tiff.pages)
            if len(pages) != count or not pages:
                raise ValueError(f"{len(pages)} of its {count} pages can be read")
            for index, page in enumerate(pages):
                if not prod(page.chunked):
                    raise ValueError(f"page {index} declares no pixels")
                check_strips(path, tiff, page, f"page {index}")
                check_ratio(path, page.nbytes, sum(page.databytecounts), ratio=LARGEST_RATIO)
            yield pages
    except UnreadableCapture as refused:
        again = (replace(p, fix=FIX) if p.fix == COPY_AGAIN else p for p in refused.problems)
        raise TiffRefused(*again) from None
    except DAMAGE as error:
        raise TiffRefused(_unreadable(path, error)) from error


def _check_bands(path: Path, pages: list[TiffPage], uniform: bool) -> None:
    wrong = [p for p in pages if p.ndim != 2]
    if uniform:
        wrong += [p for p in pages if (p.shape, p.dtype) != (pages[0].shape, pages[0].dtype)]
    if wrong or not pages:
        what = "pages are not bands of one size and type" if wrong else "there are no bands"
        found = f"page {wrong[0].index}: {wrong[0].shape} {wrong[0].dtype}" if wrong else "0"
        expected = f"{pages[0].shape} {pages[0].dtype}" if pages else "one page a band"
        raise TiffRefused(Problem("E_SIZE", what, str(path), found=found, expected=expected))


def _stored(handle: BinaryIO, page: TiffPage, number: int) -> bytes:
    """Return one strip or tile as it is stored; raises ValueError where the file ends in it."""
    handle.seek(page.dataoffsets[number])
    data = handle.read(page.databytecounts[number])
    if len(data) != page.databytecounts[number]:
        raise ValueError(f"strip {number} is truncated")
    return data


def _place(handle: BinaryIO, page: TiffPage, number: int, plane: np.ndarray, start: int) -> None:
    """Read one strip or tile and copy what of it lies in `plane`, whose first row is `start`."""
    decoded, (_, _, top, left, _), _ = page.decode(_stored(handle, page, number), number)
    pixels = np.asarray(decoded)[0, :, :, 0]
    skip = max(0, start - top)
    rows = pixels[skip : start + len(plane) - top]
    row = top + skip - start
    part = plane[row : row + len(rows), left : left + pixels.shape[1]]
    part[...] = rows[: part.shape[0], : part.shape[1]]


def _unreadable(path: Path, error: BaseException, index: int | None = None) -> Problem:
    if isinstance(error, FileNotFoundError) and (absent := missing_path(path, "file")) is not None:
        return absent
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    where = "" if index is None else f" in band page {index}"
    what = f"{path.name} cannot be read{where}: {reason}"
    return Problem("E_UNREADABLE", what, str(path), expected="a TIFF, whole", fix=FIX)
