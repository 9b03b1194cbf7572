"""Read a file as the package would, and judge what it was read as: by other programs, and by the file's size."""

import contextlib
import json
import math
import resource
import signal
import struct
import tomllib
import traceback
from io import BytesIO
from math import prod
from pathlib import Path

import numpy as np
from PIL import Image

from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.file_index import read_exposures
from levkas.campaign.edits import read_edits
from levkas.core.problems import Refused
from levkas.core.text import read_json, read_text
from levkas.planning.loading import read_lobe
from levkas.planning.spectra import read_table
from levkas.planning.tables import LampKeys
from levkas.quality.targets.charts import Chart, parse_reference
from levkas.readers.envi import open_envi
from levkas.readers.frames import read_facts, read_frame
from levkas.readers.images import read_exif
from levkas.registration.control_points.dialects import read_points
from levkas.registration.control_points.layers import is_table_of_frames, read_table_of_frames
from levkas.stages.spectra import read_sensitivity, read_spectrum

SLOW_S = 2.0
"""Of the processor, not of the clock: on a busy machine a file may wait for as long as it likes."""
ENDLESS_S = 30.0
MOST_BYTES = 256 << 20
CHART = Chart("two by two", 2, 2, (0, 1, 2, 3))


class Endless(BaseException):
    """A reader that was still at work after `ENDLESS_S` of processor time."""


class WrongAcceptance(AssertionError):
    """A file that was read as what it is not."""


def check(sound, found):
    """Complain of what was read, unless it is sound."""
    if not sound:
        raise WrongAcceptance(str(found)[:200])


def finite(values, low=-math.inf):
    """Check that all numbers are finite and not below `low`."""
    values = np.asarray(values, float)
    check(np.isfinite(values).all() and (values >= low).all(), values)


def read_picture(path):
    """Read a TIFF, PNG, JPEG or camera raw; its facts, its values and its file must agree."""
    facts, values = read_facts(path), read_frame(path)
    check(values.shape == facts.shape and values.dtype.name == facts.dtype, (facts, values.shape))
    check(values.size and values.dtype.isnative and values.flags.writeable, values.shape)
    levels = (
        facts.black,
        facts.saturation,
        facts.exposure_s,
        facts.iso,
        *(facts.wavelengths or ()),
    )
    finite([level for level in levels if level is not None])
    check(facts.exposure_s is None or facts.exposure_s > 0, facts)
    if facts.kind == "tiff":
        check(tiff_size(path) in (None, values.shape[:2]), (tiff_size(path), values.shape))
    elif facts.kind != "raw":
        check(pillow_agrees(path, values), values.shape)


def tiff_size(path):
    """Return (h, w) that the first directory of a plain TIFF says; None where it says another thing."""
    data = path.read_bytes()
    order = "<" if data[:2] == b"II" else ">"
    if data[2:4] not in (b"*\0", b"\0*"):
        return None
    start = struct.unpack_from(order + "I", data, 4)[0]
    count = struct.unpack_from(order + "H", data, start)[0]
    entries = [struct.unpack_from(order + "HHI", data, start + 2 + 12 * i) for i in range(count)]
    sizes = {}
    for number, (tag, kind, many) in enumerate(entries):
        if tag == 254 or (tag in (256, 257) and (kind not in (3, 4) or many != 1 or tag in sizes)):
            return None
        if tag in (256, 257):
            form = order + ("H" if kind == 3 else "I")
            sizes[tag] = struct.unpack_from(form, data, start + 10 + 12 * number)[0]
    return (sizes[257], sizes[256]) if len(sizes) == 2 else None


def pillow_agrees(path, values):
    """Tell whether Pillow, where it reads a PNG or JPEG, reads the same size, and of a PNG the same numbers."""
    try:
        with Image.open(path, formats=["PNG", "JPEG"]) as picture:
            if (picture.height, picture.width) != values.shape[:2]:
                return False
            if picture.format != "PNG" or picture.mode not in ("L", "RGB", "I;16"):
                return True
            theirs = np.asarray(picture)
    except Exception:  # what Pillow refuses says nothing of us
        return True
    deep = (
        values.dtype == np.uint16 and theirs.dtype == np.uint8
    )  # Pillow halves colours of 16 bits
    ours = values >> 8 if deep else values
    return ours.shape == theirs.shape and np.array_equal(ours, theirs)


def read_scan(path):
    """Read an ENVI cube whole and by lines; its header and the length of its data must agree."""
    opened = open_envi(path)
    facts, values = opened.facts, opened.read()
    needed = opened.offset + prod(facts.shape) * np.dtype(opened.layout).itemsize
    check(opened.data.stat().st_size == needed, (facts, opened.data.stat().st_size))
    check(values.shape == facts.shape and values.dtype.name == facts.dtype, facts)
    last = facts.shape[0] - 1
    check(opened.read_lines(last, last + 1).tobytes() == values[last:].tobytes(), facts)
    for centres in (facts.wavelengths, facts.fwhm):
        finite(centres or ())
    check(read_facts(path) == facts and read_frame(path).tobytes() == values.tobytes(), facts)


def read_campaign(path):
    """Read campaign.toml; no number of it may be NaN or without end."""
    load_campaign(path)
    check_numbers(tomllib.loads(path.read_text("utf-8-sig")))


def read_corrections(path):
    """Read edits.toml; every pair is finite."""
    for edits in read_edits(path).frames.values():
        for pairs in edits.pairs().values():
            finite(pairs)


def read_record(path):
    """Read JSON; Python's own parser must see the same, without NaN."""
    record = read_json(path)
    check(record == json.loads(path.read_text("utf-8-sig")), record)
    check_numbers(record)


def check_numbers(record):
    """Check that all numbers of a record, however deep, are finite."""
    if isinstance(record, float):
        check(math.isfinite(record), record)
    for inner in record.values() if isinstance(record, dict) else ():
        check_numbers(inner)
    for inner in record if isinstance(record, list) else ():
        check_numbers(inner)


def read_pairs(path):
    """Read control points of any dialect."""
    if is_table_of_frames(path):
        every = list(read_table_of_frames(path).values())
    else:
        every = [read_points(path)]
    for points in every:
        finite(points.reference)
        finite(points.target)
        finite(points.weights, 0)
        check(points.reference.shape == points.target.shape == (len(points), 2), points)
        check(len(points.names) == len(points.enabled) == len(points.check) == len(points), points)


def read_csv(path):
    """Read a table by what its name says it is."""
    kind = path.stem
    if kind == "exposures":
        seconds = list(read_exposures(path).values())
        finite(seconds, 0)
        check(all(seconds), seconds)
        return
    if kind == "chart":
        reference = parse_reference(read_text(path, "a CSV"), CHART, file=str(path))
        wavelengths, values = reference.wavelengths, reference.spectra.T
    elif kind == "sensitivity":
        wavelengths, values = read_sensitivity(path, ["B1", "B2", "B3"])
    elif kind == "light":
        wavelengths, values, _ = read_table(path, field="spectrum", file=str(path))
    elif kind == "spectrum":
        wavelengths, values = read_spectrum(path)
    else:
        keys = LampKeys.model_construct(lobe=path.name, beam_deg=None, size_mm=None)
        wavelengths, values = read_lobe("lamp", keys, path.parent, file=str(path)).table
    finite(values)
    finite(wavelengths, 0)
    check(len(wavelengths) == len(values) > 1 and (np.diff(wavelengths) > 0).all(), wavelengths)


def read_shot_facts(path):
    """Read what EXIF tells; what is damaged tells nothing."""
    facts = read_exif(BytesIO(path.read_bytes()))
    for name in ("exposure_s", "iso"):
        check(facts[name] is None or (math.isfinite(facts[name]) and facts[name] > 0), facts)


READERS = {
    "tiff": (read_picture, "tif"), "png": (read_picture, "png"), "jpeg": (read_picture, "jpg"),
    "raw": (read_picture, "dng"), "envi": (read_scan, "hdr"), "campaign": (read_campaign, "campaign.toml"),
    "edits": (read_corrections, "edits.toml"), "json": (read_record, "json"),
    "exif": (read_shot_facts, "exif"), "csv": (read_csv, "csv"),
    "points": (read_pairs, ("points.csv", "points", "pto", "txt", "mat", "reference.csv", "frames.csv")),
}  # fmt: skip
"""Function, and how the names of its files end; the more special ones are looked for first."""


def reader_of(name):
    """Return the key of `READERS` for a name."""
    if name.endswith(READERS["points"][1]):
        return "points"
    return next(
        key for key, (_, ends) in READERS.items() if key != "points" and name.endswith(ends)
    )


def judge(path):
    """Read a file; return what it came to and what is wrong with that.

    Returns
    -------
    came : "read" or "refused"
    ways : set of (code, message) of a refusal
    wrong : str
        Empty, or why this is neither a sound value nor a refusal of ours.
    """
    came, ways, wrong = "read", set(), ""
    seconds, bytes_ = processor_s(), peak_bytes()
    signal.signal(signal.SIGPROF, end)
    try:
        signal.setitimer(signal.ITIMER_PROF, ENDLESS_S)
        READERS[reader_of(path.name)][0](path)
    except Refused as refused:
        came, ways = "refused", {(p.code, p.message) for p in refused.problems}
        if not refused.problems or not str(refused):
            wrong = "a refusal that says nothing"
    except Exception as error:
        came, wrong = "read", f"{type(error).__name__}: {str(error)[:80]} {where(error)}"
    except Endless as endless:
        came, wrong = "read", f"no end {where(endless)}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    seconds, bytes_ = processor_s() - seconds, peak_bytes() - bytes_
    if seconds > SLOW_S:
        wrong = wrong or f"slow: {seconds:.1f} s of processor time"
    if bytes_ > MOST_BYTES:
        wrong = wrong or f"large: {bytes_ >> 20} MiB"
    return came, ways, wrong


def end(number, frame):
    """End a reader."""
    raise Endless


def where(error):
    """Return file and line of ours that an exception came through last."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "levkas" in f.filename]
    return f"({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""


def processor_s():
    """Return seconds of processor time of this process and the children that it waited for."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def peak_bytes():
    """Return the most memory that this process ever had, and the largest of its children."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_maxrss for usage in usages) << 10


def warm(path):
    """Read a file once for all that is imported on the way, which is no fault of the next one."""
    with contextlib.suppress(Exception):
        READERS[reader_of(path.name)][0](path)
