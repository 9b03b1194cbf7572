"""Facts of a file's headers, and the refusals of files that cannot be what they declare."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.core.machine import MEMORY, chosen_memory, memory_bound
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from levkas.readers.black_levels import BlackLevels

MOST_SAMPLES = 2_000_000_000
"""Samples of one frame; a file that declares more is damaged or not an image."""
LONGEST_SIDE = 500_000
FREE_BYTES = 64 << 20
"""Bytes that a file may expand to at any ratio: constant dark frames compress very well."""
SMALL_SAMPLES = 32 << 20
"""Samples that may have any ratio: darks of 32 megapixels can be nothing but zeros."""
LARGEST_EXPANSION = 50
"""Bytes of a larger frame from one stored byte; noise of one code compresses to a tenth, and PackBits goes to 64 to 1."""
IN_WORK = 8
"""Bytes of a sample in work, beside the frame as it was read: a float64, or several smaller arrays."""
Settings = tuple[tuple[str, str], ...]
"""Fields of a header by which one setting of a camera is stated, and their values: ``(("binning", "1, 2"),)``."""
COPY_AGAIN = "Copy the file again from the camera, or remove it from the campaign."


class UnreadableCapture(Refused):
    """A file that is not what it should be; nothing of it was used."""


class LibraryMissing(UnreadableCapture):
    """A file whose library, of an extra of the package, is not installed."""


@dataclass(frozen=True)
class Facts:
    """Declared by a capture's headers; None where it does not say, of `…_unclear` what it states that cannot be understood."""

    path: Path
    kind: str
    """A key of `frames.READERS`, or ``"raw-colours"``, of a linear DNG."""
    shape: tuple[int, ...]
    """(h, w) or (h, w, samples) of one page; for ENVI and stacks of maps (lines, samples, bands)."""
    dtype: str
    pages: int = 1
    """Full-size pages of a TIFF; previews and masks are not counted."""
    bits: int | None = None
    """Significant bits of a sample."""
    black: float | None = None
    """Counts; the mean where sensels differ: `blacks` has that of each then."""
    saturation: float | None = None
    blacks: BlackLevels | None = None
    black_unclear: str | None = None
    pattern: str | None = None
    """Letters of the tile that repeats over the visible area, row by row: ``"RGGB"``; 36 of X-Trans."""
    exposure_s: float | None = None
    band_times_s: tuple[float, ...] | None = None
    """Exposures band by band, where an ENVI header lists several; `exposure_s` is None then."""
    exposure_unclear: str | None = None
    iso: float | None = None
    captured: str | None = None
    """ISO 8601, local time of the camera unless the file states an offset."""
    make: str | None = None
    model: str | None = None
    serial: str | None = None
    f_number: float | None = None
    focal_mm: float | None = None
    lens: str | None = None
    white_balance: str | None = None
    """EXIF's ``"auto"`` or ``"manual"``."""
    orientation: int | None = None
    """EXIF's, 2 to 8, of a file that viewers turn or mirror; pixels are never turned."""
    gain: Settings | None = None
    binning: Settings | None = None
    region: Settings | None = None
    wavelengths: tuple[float, ...] | None = None
    """nm, as `fwhm`."""
    fwhm: tuple[float, ...] | None = None
    wavelengths_unclear: str | None = None
    nodata: float | None = None
    """Value of samples that hold nothing; NaN where the file says so."""
    reflectance_scale: tuple[float, ...] | None = None
    """Value of reflectance 1.0 in every band, of a file of reflectance."""
    bad_bands: tuple[int, ...] | None = None
    """Indices of bands that the file calls bad."""
    band_names: tuple[str, ...] | None = None
    page_labels: tuple[str, ...] | None = None
    """Labels of pages that may be names of bands: those of files, as ImageJ writes them."""
    interleave: str | None = None
    encoded: str | None = None
    """Tone curve that the file states of its codes, which are not proportional to light then."""
    notes: tuple[str, ...] = ()
    """What of the file is not used, or taken otherwise than it states."""

    @property
    def is_cube(self) -> bool:
        """Whether the file is of a format of cubes: lines, samples and bands, as a scan has them."""
        return self.kind in ("envi", "hdf5-cube", "mat")


LISTS = (
    *("wavelengths", "fwhm", "band_names", "page_labels"),
    *("band_times_s", "reflectance_scale"),
)
"""Fields of one item a band."""


def facts_of_bands(facts: Facts, places: Sequence[int]) -> Facts:
    """Return facts whose lists are of some bands of the file, in the order of `places`, from 0.

    A list of another length than the file has bands is of none of them.

    >>> cube = Facts(Path("a.hdr"), "envi", (1, 1, 3), "uint16", wavelengths=(450.0, 550.0, 650.0))
    >>> facts_of_bands(cube, (2, 0)).wavelengths
    (650.0, 450.0)
    """
    count = facts.shape[2] if len(facts.shape) == 3 else facts.pages
    picked: dict[str, Any] = dict.fromkeys(LISTS)
    for name in LISTS:
        values = getattr(facts, name) or ()
        if len(values) == count:
            picked[name] = tuple(values[i] for i in places)
    return replace(facts, **picked)


def unreadable(
    path: str | Path,
    message: str,
    *,
    code: str = "E_UNREADABLE",
    expected: Any = "a complete file of its format",
    fix: str | None = COPY_AGAIN,
    **more: Any,
) -> UnreadableCapture:
    """Return the refusal of a file, ready to raise.

    >>> print(unreadable("a.tif", "no page 3", found="2 pages", expected="4", fix="Check the name."))
    no page 3 (file: a.tif; found: 2 pages; expected: 4). Check the name.
    """
    more.setdefault("found", "no such data")
    return UnreadableCapture(
        Problem(code, message, file=str(path), expected=expected, fix=fix, **more)
    )


WRONG = {
    "size": ("E_SIZE", "{field}", "the declared size is not plausible", "1 to {most} samples, sides up to {side}", "{fix}"),
    "expansion": ("E_SIZE", "width, height", "the file is far smaller than its decoded frame, unlike any capture", "at most {most} to 1 where there are over {free} Mi samples", "Check that this is the correct file. If it is, save it again without compression, or set {variable} to the memory in GB that a command may use."),
    "memory": ("E_MEMORY", "width, height", "the frame does not fit in memory", "at most {bound} MB, as `levkas doctor` reports", "Use a machine with more memory, close other programs, or set {variable} to the memory in GB that a command may use."),
    "ratio": ("E_SIZE", "width, height", "the image is larger than its stored bytes allow", "at most {ratio} to 1", COPY_AGAIN),
    "format": ("E_UNREADABLE", "format", "the file format is not supported", "TIFF, PNG, JPEG, camera raw, ENVI with its header, or a cube in HDF5 or MATLAB", "Save it as a TIFF, a page a band, or as ENVI with its header beside it, and name that file in `files`."),
    "no file": ("E_UNREADABLE", "file", "the file cannot be opened", "a file", "Add the frame, or correct the pattern in `files`."),
    "closed": ("E_UNREADABLE", "file", "the file cannot be opened", "a readable file", "Change its permissions, or copy it again."),
    "empty": ("E_TRUNCATED", "file", "the file is empty", "an image", COPY_AGAIN),
    "page": ("E_BAND_MISSING", "page", "the file has no page {page}", "a page of that number, from 0", COPY_AGAIN),
    "samples": ("E_BAND_COUNT", "samples", "one sample a pixel is expected here", "one, or samples that are equal", 'Export the frame as grey; where its samples are bands, write kind = "cube", and kind = "image" for a photograph.'),
    "cut": ("E_TRUNCATED", "{field}", "the file is truncated", "{expected}", COPY_AGAIN),
    "PNG": ("E_UNREADABLE", "IHDR", "the PNG header is damaged", "1, 2, 4, 8 or 16 bits of type 0, 2, 3, 4 or 6", COPY_AGAIN),
    "JPEG": ("E_UNREADABLE", "frame header", "this kind of JPEG is not supported", "gray or three colours of 8 bits", "Export it again as an RGB JPEG or a TIFF."),
    "loop": ("E_UNREADABLE", "next directory", "the pages of the TIFF form a loop or overlap", "an unused part of the file", COPY_AGAIN),
    "pages": ("E_SIZE", "pages", "the TIFF has too many pages", "at most {most}", "Save the frames in several files."),
    "tags": ("E_UNREADABLE", "number of tags", "a directory of the TIFF is damaged", "1 to {most}", COPY_AGAIN),
    "no image": ("E_UNREADABLE", "NewSubfileType", "the TIFF holds no image", "at least one full-size page", COPY_AGAIN),
    "kind of page": ("E_UNREADABLE", "{field}", "page {page} is of a kind that is not read", "{expected}", "Export it again as gray or RGB, with deflate or uncompressed."),
    "strips": ("E_TRUNCATED", "StripOffsets, StripByteCounts", "{name} lacks a strip or tile, or a part of one", "{expected}", COPY_AGAIN),
    "overlap": ("E_UNREADABLE", "StripOffsets, StripByteCounts", "the strips or tiles overlap", "strips that do not overlap", COPY_AGAIN),
    "stack": ("E_UNREADABLE", "ImageDescription", "the pages of this stack have no separate tags", "a page a frame", "Save it again with one page per frame."),
    "no header": ("E_UNREADABLE", "header", "the cube has no header", "{stem}.hdr beside it", "Put the header beside its data, under the same name."),
    "long header": ("E_SIZE", "header", "the header is too long", "at most {most} bytes", "This may be the data under the name of the header: a header is a short text."),
    "key": ("E_UNREADABLE", "{key}", "the header has no {key}", "a whole number from {least}", "Write `{key} = …` with the value from the camera's software."),
    "no data": ("E_UNREADABLE", "data file", "the header has no data file beside it", "{stem} with one of {suffixes}, or no suffix", "Put the data beside their header, with the same name."),
    "several data": ("E_UNREADABLE", "data file", "several files may hold the data of this header", "one of {needed} bytes", "Move the other files, or open the data file by its own name."),
    "no ENVI": ("E_UNREADABLE", "header", "this is not an ENVI header", "a first line ENVI, at most {most} keys", "Name the header of an ENVI cube, or remove the file from `files`."),
    "twice": ("E_UNREADABLE", "{key}", "the header gives its {key} twice", "one value", "Delete the line that is wrong."),
    "open list": ("E_UNREADABLE", "{key}", "a list in the header is not closed", "a closing }}", "Write the }} where the list ends."),
    "layout": ("E_UNREADABLE", "{key}", "this {key} is not read", "{expected}", "Correct `{key}` in the header, or save the cube again."),
    "length": ("{code}", "{field}", "the data do not match their header", "{expected}", "{fix}"),
    "Ripple": ("E_UNREADABLE", "{key}", "`{key}` is not understood", "{expected}", "Correct the .rpl."),
    "cube": ("E_UNREADABLE", "format", "the cube of the file is not known", "{expected}", "Save it as ENVI, or with one array of three axes and its wavelengths as `wavelengths`."),
    "array": ("{code}", None, "the array is not as it should be", "{expected}", "Write the file again with its original program."),
    "list": ("E_BAND_COUNT", "{key}", "the list of {key} does not match the bands", "{bands} numbers", "Write one number per band, or remove the list."),
}  # fmt: skip
"""What is wrong with a file: code, field, message, what is expected, what to do."""


def refused(path: str | Path, row: str, found: Any, **words: Any) -> UnreadableCapture:
    """Return the refusal of a file by a row of `WRONG`, ready to raise; `words` fill its gaps.

    >>> print(refused("a.tif", "pages", "over 4096", most=4096))
    the TIFF has too many pages (file: a.tif; field: pages; found: over 4096; expected: at most 4096). Save the frames in several files.
    """
    filled = ((text or "").format(**words) or None for text in WRONG[row])
    code, field, message, expected, fix = filled
    return UnreadableCapture(
        Problem(str(code), str(message), str(path), field, str(found), expected, fix)
    )


@contextmanager
def decoding(path: Path, what: str) -> Iterator[None]:
    """Turn whatever a decoder raises on a damaged file into UnreadableCapture."""
    try:
        yield
    except Refused:
        raise
    except Exception as error:
        # Damaged headers lead tifffile, Pillow and exifread to any class there is: struct, zlib, key, type, recursion and
        # memory errors were all met. Programs still end on Ctrl-C.
        found = f"{type(error).__name__}: {error}"[:300]
        message, expected = f"the {what} cannot be read", f"a whole {what}"
        raise unreadable(path, message, found=found, expected=expected) from error


def check_size(
    path: Path,
    shape: tuple[int, ...],
    *,
    most: int = MOST_SAMPLES,
    field: str = "width, height",
    fix: str = COPY_AGAIN,
) -> None:
    """Refuse absurd declared sizes before anything is allocated."""
    sides = [int(side) for side in shape]
    if min(sides) > 0 and prod(sides) <= most and max(sides) <= LONGEST_SIDE:
        return
    found = " x ".join(map(str, sides))
    raise refused(path, "size", found, field=field, most=most, side=LONGEST_SIDE, fix=fix)


def check_expansion(
    path: Path, samples: int, itemsize: int, stored: int, *, most: int = LARGEST_EXPANSION
) -> None:
    """Refuse a large frame of `samples`, all pages together, from a file of `stored` bytes that would each become over `most`.

    $LEVKAS_MEMORY allows for it.
    """
    needed = samples * itemsize
    if samples <= SMALL_SAMPLES or needed <= most * stored or chosen_memory() is not None:
        return
    found, free = f"{needed / 1e6:.0f} MB from {stored / 1e6:.2g} MB", SMALL_SAMPLES >> 20
    raise refused(path, "expansion", found, most=most, free=free, variable=MEMORY)


def check_memory(path: Path, samples: int, itemsize: int) -> None:
    """Refuse a frame that does not fit in memory, before it is decoded: ``E_MEMORY`` with the decoded size and the bound."""
    needed = samples * (itemsize + IN_WORK)
    if samples <= SMALL_SAMPLES // 2 or needed <= (bound := memory_bound()):
        return
    found = f"{samples * itemsize / 1e6:.0f} MB decoded, {needed / 1e6:.0f} MB in work"
    raise refused(path, "memory", found, bound=f"{bound / 1e6:.0f}", variable=MEMORY)


def check_ratio(path: Path, needed: int, stored: int, *, ratio: int) -> None:
    """Refuse an image of `needed` bytes that `stored` bytes cannot hold at `ratio` to 1."""
    if needed > FREE_BYTES and needed > ratio * stored:
        raise refused(path, "ratio", f"{needed} bytes from {stored}", ratio=ratio)
