"""Read a file as the package would, and judge what came of it: a sound value or a refusal, soon and in little memory."""

import contextlib
import json
import resource
import signal
import traceback
from io import BytesIO
from math import inf, prod
from pathlib import Path

import numpy as np

from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.file_index import read_exposures
from levkas.campaign.edits import read_edits
from levkas.core.problems import Refused
from levkas.core.text import read_json, read_text
from levkas.planning.spectra import read_table
from levkas.quality.targets.charts import Chart, parse_reference
from levkas.readers.envi import open_envi
from levkas.readers.frames import read_facts, read_frame
from levkas.readers.images import read_exif
from levkas.registration.control_points import (
    is_table_of_frames,
    read_points,
    read_table_of_frames,
)
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
    if not sound:
        raise WrongAcceptance(str(found)[:200])


def finite(values, low=-inf):
    values = np.asarray(values, float)
    check(np.isfinite(values).all() and (values >= low).all(), values)


def read_picture(path):
    """Read a frame; its facts, its values and its file must agree."""
    facts, values = read_facts(path), read_frame(path)
    check(values.shape == facts.shape and values.dtype.name == facts.dtype, (facts, values.shape))
    check(values.size and values.dtype.isnative and values.flags.writeable, values.shape)
    levels = (facts.black, facts.saturation, facts.exposure_s, facts.iso)
    finite([level for level in levels if level is not None], 0)
    finite(facts.wavelengths or (), 0)


def read_scan(path):
    """Read an ENVI cube whole and by lines; its header and the length of its data must agree."""
    opened = open_envi(path)
    facts, values = opened.facts, opened.read()
    needed = opened.offset + prod(facts.shape) * np.dtype(opened.layout).itemsize
    check(opened.data.stat().st_size == needed, (facts, opened.data.stat().st_size))
    last = facts.shape[0] - 1
    check(opened.read_lines(last, last + 1).tobytes() == values[last:].tobytes(), facts)
    read_picture(path)


def read_corrections(path):
    for edits in read_edits(path).frames.values():
        for pairs in edits.pairs().values():
            finite(pairs)


def read_record(path):
    """Read JSON; Python's own parser must see the same."""
    record = read_json(path)
    check(record == json.loads(path.read_text("utf-8-sig")), record)


def read_pairs(path):
    """Read control points of any dialect."""
    several = is_table_of_frames(path)
    for points in read_table_of_frames(path).values() if several else [read_points(path)]:
        finite(points.reference)
        finite(points.target)
        check(points.reference.shape == points.target.shape == (len(points), 2), points)


def read_csv(path):
    """Read a table by what its name says it is."""
    kind = path.stem
    if kind == "exposures":
        finite(list(read_exposures(path).values()), 0)
        return
    if kind == "chart":
        reference = parse_reference(read_text(path, "a CSV"), CHART, file=str(path))
        wavelengths, values = reference.wavelengths, reference.spectra.T
    elif kind == "sensitivity":
        wavelengths, values = read_sensitivity(path, ["B1", "B2", "B3"])
    elif kind == "light":
        wavelengths, values, _ = read_table(path, field="spectrum", file=str(path))
    else:
        wavelengths, values = read_spectrum(path)
    finite(values)
    finite(wavelengths, 0)
    check(len(wavelengths) == len(values) > 1 and (np.diff(wavelengths) > 0).all(), wavelengths)


def read_shot_facts(path):
    """Read what EXIF tells; what is damaged tells nothing."""
    facts = read_exif(BytesIO(path.read_bytes()))
    finite([facts[name] for name in ("exposure_s", "iso") if facts[name] is not None], 0)


READERS = {
    "tiff": (read_picture, "tif"), "png": (read_picture, "png"), "jpeg": (read_picture, "jpg"),
    "envi": (read_scan, "hdr"), "campaign": (load_campaign, "campaign.toml"),
    "edits": (read_corrections, "edits.toml"), "json": (read_record, "json"),
    "exif": (read_shot_facts, "exif"), "csv": (read_csv, "csv"),
    "points": (read_pairs, ("points.csv", "points", "pto", "txt", "mat", "reference.csv", "frames.csv")),
}  # fmt: skip
"""Function, and how the names of its files end; the more special ones are looked for first."""


def reader_of(name):
    """Return the key of `READERS` for a name."""
    if name.endswith(READERS["points"][1]):
        return "points"
    return next(k for k, (_, ends) in READERS.items() if k != "points" and name.endswith(ends))


def judge(path):
    """Read a file; return ``"read"`` or ``"refused"``, the (code, message) of a refusal, and what is wrong, or nothing."""
    came, ways, wrong = "read", set(), ""
    seconds, bytes_ = processor_s(), peak_bytes()
    signal.signal(signal.SIGPROF, end)
    try:
        signal.setitimer(signal.ITIMER_PROF, ENDLESS_S)
        READERS[reader_of(path.name)][0](path)
    except Refused as refused:
        came, ways = "refused", {(p.code, p.message) for p in refused.problems}
        wrong = "" if ways else "a refusal that says nothing"
    except Exception as error:
        wrong = f"{type(error).__name__}: {str(error)[:80]} {where(error)}"
    except Endless as endless:
        wrong = f"no end {where(endless)}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    seconds, bytes_ = processor_s() - seconds, peak_bytes() - bytes_
    if seconds > SLOW_S or bytes_ > MOST_BYTES:
        wrong = wrong or f"{seconds:.1f} s of processor time, {bytes_ >> 20} MiB"
    return came, ways, wrong


def end(number, frame):
    raise Endless


def where(error):
    """Return file and line of ours that an exception came through last."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "levkas" in f.filename]
    return f"({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""


def processor_s():
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def peak_bytes():
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_maxrss for usage in usages) << 10


def warm(path):
    """Read a file once for all that is imported on the way, which is no fault of the next one."""
    with contextlib.suppress(Exception):
        READERS[reader_of(path.name)][0](path)
