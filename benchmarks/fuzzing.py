"""Change bytes of small files at random and read them: whatever comes must be a value or a refusal.

    python benchmarks/fuzzing.py [SECONDS] [SEED]

TIFF, PNG and JPEG frames, ENVI headers, campaign.toml and a JSON record, each with its data; then, for as
long again, camera raw: DNGs, whose decoder runs in a process of its own, forked here from one that has
loaded LibRaw, and sometimes started as a build starts it. Where atheris can be imported it drives the same readers by coverage (`python benchmarks/fuzzing.py atheris`); else, and
by default, a seeded loop of our own. Prints runs, distinct refusals, the slowest run, and everything that
was neither a value nor a refusal.
"""

import contextlib
import io
import json
import logging
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import tifffile

from levkas.campaign import load_campaign
from levkas.problems import Refused
from levkas.readers import raw
from levkas.readers.frames import read_facts, read_frame
from levkas.readers.texts import read_json

SLOW_S = 2.0
STARTED_WHOLE = 50
"""Every so-many-th camera raw is decoded by a new process."""
FORKING = """
import os, runpy, signal, struct, sys, tempfile
import numpy, rawpy
program = sys.argv[1]
for line in sys.stdin:
    path, what = line.rstrip("\\n").rsplit("|", 1)
    with tempfile.TemporaryFile() as answer:
        child = os.fork()
        if not child:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            sys.argv = [program, path, what]
            class Output:
                class buffer:
                    write = staticmethod(lambda data: answer.write(data))
            sys.stdout = Output
            import resource
            limited = resource.setrlimit
            resource.setrlimit = lambda kind, most: kind == resource.RLIMIT_FSIZE or limited(kind, most)
            runpy.run_path(program, run_name="__main__")
            answer.flush()
            os._exit(0)
        _, status = os.waitpid(child, 0)
        answer.seek(0)
        data = answer.read()
        sys.__stdout__.buffer.write(struct.pack(">iI", os.waitstatus_to_exitcode(status), len(data)))
        sys.__stdout__.buffer.write(data)
        sys.__stdout__.buffer.flush()
"""
CAMPAIGN = b"""[campaign]
title = "Two paintings"
date = 2024-05-31
reference = { camera = "vis", band = "550" }
[grid]
mirror = true
region = [0, 0, 40, 30]
[cameras.vis]
kind = "bands"
files = "vis/{target}/{wavelength}nm.tif"
wavelengths = { start = 400, stop = 720, step = 10 }
bits = 12
[cameras.msfa]
kind = "mosaic"
files = ["msfa/{target}_{shot}.tif"]
pattern = [["B1", "B2"], ["B3", "B4"]]
exposures = "merge"
[targets]
dark = "dark"
white = { names = ["white"], reflectance = 0.98 }
[objects.icon1]
size_mm = [300, 400]
"""
TOKENS = [
    *(b"\0", b"\xff", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\x80\0\0\0", b"-1", b"0", b"nan"),
    *(b"inf", b"1e999", b"99999999999999999999", b"{", b"}", b"[", b"]", b'"', b'"""', b"=", b"\n"),
    *(b",", b";", b".", b"\\u0000", b"\xc3", b" ", b"{target}", b"[[", b"'''", b"NaN", b"true"),
]


def seeds():
    """Return (name of the file, its bytes, files beside it) of every kind."""
    codes = (np.arange(15 * 13, dtype=np.uint16) * 21).reshape(15, 13)
    for name, options in {
        "plain": {}, "deflate": {"compression": "zlib", "predictor": True}, "big": {"bigtiff": True},
        "lzw": {"compression": "lzw", "rowsperstrip": 4}, "tiles": {"tile": (16, 16)},
        "zstd": {"compression": "zstd"}, "order": {"byteorder": ">"},
        "tags": {"extratags": [(33434, "2I", 1, (1, 4), True), (270, "s", 0, "a frame", True)]},
    }.items():  # fmt: skip
        stream = io.BytesIO()
        tifffile.imwrite(stream, codes, **options)
        yield f"{name}.tif", stream.getvalue(), {}
    stream = io.BytesIO()
    tifffile.imwrite(stream, np.stack([codes] * 3), photometric="minisblack", metadata=None)
    yield "pages.tif", stream.getvalue(), {}
    stream = io.BytesIO()
    tifffile.imwrite(stream, (codes >> 4).astype(np.uint8), compression="jpeg")
    yield "jpeg.tif", stream.getvalue(), {}
    import imagecodecs

    yield "gray.png", bytes(imagecodecs.png_encode(codes)), {}
    yield "colour.png", bytes(imagecodecs.png_encode(np.dstack([codes >> 4] * 3).astype("u1"))), {}
    yield "photo.jpg", bytes(imagecodecs.jpeg8_encode((codes >> 4).astype(np.uint8))), {}
    header = (
        "ENVI\n; from a scanner\nsamples = 5\nlines = 4\nbands = 3\ndata type = 12\ninterleave = bil\n"
        "header offset = 0\nbyte order = 0\nwavelength units = nm\nwavelength = {400.1, 500,\n 600}\n"
        'band names = {"a", b, c}\nreflectance scale factor = 1\ndata ignore value = -1\n'
    )
    yield "scan.hdr", header.encode(), {"scan.raw": bytes(range(120))}
    yield "campaign.toml", CAMPAIGN, {}
    record = {"campaign": "x", "cameras": {"vis": {"bands": ["a"], "size": [1.5, 2e3]}}, "n": None}
    yield "record.json", json.dumps(record).encode(), {}


def raw_seeds():
    """Return DNGs as `seeds` does, written with tifffile."""
    codes = (np.arange(32 * 48, dtype=np.uint16) * 21 % 4096).reshape(32, 48)
    levels = tuple(int(c) for c in np.round(np.linspace(0, 1, 200) ** 2 * 4095))
    for name, mosaic, extra, options in (
        ("plain", codes, [], {}),
        ("strips", codes, [(33434, "2I", 1, (1, 4), True)], {"rowsperstrip": 8}),
        ("tiles", codes, [], {"tile": (16, 16)}),
        ("curve", codes % 200, [(50712, "H", 200, levels, True)], {}),
        ("area", codes, [(50829, "I", 4, (2, 4, 30, 44), True)], {}),
        ("order", codes, [], {"byteorder": ">"}),
    ):
        tags = [
            (50706, "B", 4, (1, 4, 0, 0), True),
            (50708, "s", 0, "Levkas test", True),
            (33421, "H", 2, (2, 2), True),
            (33422, "B", 4, (0, 1, 1, 2), True),
            (50714, "H", 1, 64, True),
            (50717, "I", 1, 4095, True),
            (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
            (50778, "H", 1, 21, True),
            (50728, "2I", 3, (1, 1, 1, 1, 1, 1), True),
            *extra,
        ]
        stream = io.BytesIO()
        tifffile.imwrite(
            stream, mosaic, photometric=32803, extratags=tags, metadata=None, **options
        )
        yield f"{name}.dng", stream.getvalue(), {}


class Forking:
    """In place of `subprocess` in `levkas.readers.raw`: the decoder without its second of starting."""

    DEVNULL, PIPE = subprocess.DEVNULL, subprocess.PIPE
    TimeoutExpired, count = subprocess.TimeoutExpired, 0

    def __init__(self):
        command = [sys.executable, "-c", FORKING, str(raw.PROGRAM)]
        self.server = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def run(self, command, **options):
        self.count += 1
        if self.count % STARTED_WHOLE == 0:
            return subprocess.run(command, **options)
        self.server.stdin.write(f"{command[-2]}|{command[-1]}\n".encode())
        self.server.stdin.flush()
        status, length = struct.unpack(">iI", self.server.stdout.read(8))
        return subprocess.CompletedProcess(command, status, self.server.stdout.read(length))


def read(path):
    """Read a file as the package would; raises Refused."""
    if path.suffix == ".toml":
        load_campaign(path)
    elif path.suffix == ".json":
        read_json(path)
    else:
        read_facts(path)
        values = read_frame(path)
        if values.size == 0 or not values.dtype.isnative:
            raise AssertionError(f"read as {values.shape} {values.dtype}")


def changed(data, rng):
    """Return bytes with one to six changes: bits, tokens, cuts, repeats, numbers of 2, 4 or 8 bytes."""
    data = bytearray(data)
    for _ in range(int(rng.integers(1, 7))):
        at = int(rng.integers(len(data) + 1)) if data else 0
        if rng.random() < 0.6:
            at = min(at, int(rng.integers(0, 400)))  # headers stand at the front
        what = int(rng.integers(6))
        if what == 0 and at < len(data):
            data[at] ^= 1 << int(rng.integers(8))
        elif what == 1 and at < len(data):
            data[at] = int(rng.integers(256))
        elif what == 2:
            data[at:at] = TOKENS[int(rng.integers(len(TOKENS)))]
        elif what == 3:
            token = TOKENS[int(rng.integers(len(TOKENS)))]
            data[at : at + len(token)] = token
        elif what == 4:
            size = int(rng.choice([2, 4, 8]))
            number = int(rng.choice([0, 1, 8, 255, 65535, 2**31, 2**32 - 1, 2**63])) % 256**size
            data[at : at + size] = number.to_bytes(size, str(rng.choice(["little", "big"])))
        else:
            end = at + int(rng.integers(1, 64))
            data[at:end] = data[at:end] * int(rng.integers(0, 4))
    return bytes(data[: int(rng.integers(len(data) + 1))] if rng.random() < 0.05 else data)


def main(seconds, seed):
    """Run for some seconds a round; return how many runs ended otherwise than they should."""
    odd = fuzz(list(seeds()), seconds, seed)
    raw.subprocess = Forking()
    try:
        return odd + fuzz(list(raw_seeds()), seconds, seed)
    finally:
        raw.subprocess.server.stdin.close()
        raw.subprocess.server.wait()


def fuzz(corpus, seconds, seed):
    """Change and read files of a corpus in turn, and print what came of it."""
    rng = np.random.default_rng(seed)
    runs, read_well, refusals, kinds = Counter(), Counter(), Counter(), {}
    odd, slowest = {}, (0.0, "")
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        for number in range(sys.maxsize):
            if time.perf_counter() - started > seconds:
                break
            name, data, beside = corpus[number % len(corpus)]
            path = Path(folder) / name
            for other, content in beside.items():
                (Path(folder) / other).write_bytes(content)
            made = changed(data, rng)
            path.write_bytes(made)
            runs[path.suffix] += 1
            begun = time.perf_counter()
            try:
                read(path)
                read_well[path.suffix] += 1
            except Refused as refused:
                refusals[path.suffix] += 1
                kinds.setdefault(path.suffix, set()).update(
                    (p.code, p.message) for p in refused.problems
                )
                if not all(p.file and p.fix for p in refused.problems):
                    for p in refused.problems:
                        kinds.setdefault("without a file or a fix", set()).add((p.code, p.message))
            except Exception as error:
                odd.setdefault(
                    (name, f"{type(error).__name__}: {str(error)[:80]}"),
                    (made[:300], "".join(traceback.format_exc()[-600:])),
                )
            took = time.perf_counter() - begun
            slowest = max(slowest, (took, name))
            if took > SLOW_S:
                odd.setdefault((name, "slow"), (made[:300], f"{took:.1f} s"))
    for suffix in runs:
        print(
            f"{suffix:6} {runs[suffix]:7} runs, {read_well[suffix]:7} read, {refusals[suffix]:7} refused "
            f"in {len(kinds.get(suffix, ()))} ways"
        )
    for code, message in sorted(kinds.get("without a file or a fix", ())):
        print(f"without a file or a fix: {code} {message}")
    print(
        f"{runs.total()} runs in {seconds:g} s from seed {seed}; slowest {slowest[0]:.2f} s "
        f"({slowest[1]}); {len(odd)} that were no refusal"
    )
    for (name, error), (made, trace) in odd.items():
        print(f"--- {name}: {error}\n{made!r}\n{trace}")
    return len(odd)


def main_atheris():
    """Let atheris choose the bytes: the first picks the kind, the rest is the file."""
    import atheris

    corpus = list(seeds())
    folder = Path(tempfile.mkdtemp())
    for _, _, beside in corpus:
        for other, content in beside.items():
            (folder / other).write_bytes(content)

    def once(data):
        if not data:
            return
        path = folder / corpus[data[0] % len(corpus)][0]
        path.write_bytes(data[1:])
        with contextlib.suppress(Refused):
            read(path)

    atheris.instrument_all()
    atheris.Setup(sys.argv[:1], once)
    atheris.Fuzz()


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    logging.disable(logging.ERROR)  # tifffile tells of every tag that it leaves out
    if sys.argv[1:] == ["atheris"]:
        main_atheris()
    else:
        given = [float(n) for n in sys.argv[1:]] + [180.0, 0][len(sys.argv) - 1 :]
        sys.exit(1 if main(given[0], int(given[1])) else 0)
