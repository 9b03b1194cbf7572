"""Files made to break a reader: one refusal each, soon, in little memory, and nothing else.

All are read in a process of its own: this script, run with a folder, reads them one by one and tells what came,
after how long, and how much memory the process held at its peak.
"""

import io
import json
import os
import signal
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import pytest

MOST_SECONDS = 2.0
"""Processor time; a loaded machine takes longer by the clock."""
MOST_BYTES = 200 << 20
TYPES = {"B": 1, "H": 3, "I": 4}
DATA = 512


def tiff(width=8, height=8, data=bytes(64), *, following=0, **more):
    """Return a TIFF of one directory and one strip at byte `DATA`; `more` maps t273 … to (type, values)."""
    tags = {256: ("I", [width]), 257: ("I", [height]), 258: ("H", [8]), 259: ("H", [1]), 262: ("H", [1]),
            273: ("I", [DATA]), 277: ("H", [1]), 278: ("I", [height]), 279: ("I", [len(data)])}  # fmt: skip
    tags |= {int(code[1:]): value for code, value in more.items()}
    tags = {code: value for code, value in tags.items() if value}
    entries, outside = b"", b""
    for code, (kind, values) in sorted(tags.items()):
        value = struct.pack(f"<{len(values)}{kind}", *values)
        if len(value) > 4:
            outside += value
            value = struct.pack("<I", DATA + len(data) + len(outside) - len(value))
        entries += struct.pack("<HHI", code, TYPES[kind], len(values)) + value.ljust(4, b"\0")
    head = b"II*\0" + struct.pack("<IH", 8, len(tags))
    whole = head + entries + struct.pack("<I", following)
    return whole.ljust(DATA, b"\0") + data + outside


def packed(code, data, side=8):
    """Return a TIFF of one strip that is compressed."""
    return tiff(side, side, data, t259=("H", [code]))


def many_pages(pages=20_000):
    content, at = bytearray(b"II*\0\x08\0\0\0"), 8
    for _ in range(pages):
        at += 18
        content += struct.pack("<HHHIII", 1, 256, 4, 1, 8, at)
    return bytes(content)


def overlapping(count=4000, pages=6000):
    """Directories that each claim the 4,000 tags behind them: a reader reads 48 kB for every 8 bytes."""
    content = bytearray(8 + 8 * pages + 12 * count + 16)
    content[:8] = b"II*\0\x08\0\0\0"
    for i in range(pages):
        struct.pack_into("<H", content, 8 + 8 * i, count)
    for i in range(pages):
        struct.pack_into("<I", content, 8 + 8 * i + 2 + 12 * count, 16 + 8 * i)
    return bytes(content)


def one_tile_of_a_gigapixel():
    data = zlib.compress(bytes(64))
    size, place = ("I", [32_768]), {"t324": ("I", [DATA]), "t325": ("I", [len(data)])}
    strips = dict.fromkeys(("t273", "t278", "t279"))
    return tiff(data=data, t259=("H", [8]), t322=size, t323=size, **strips, **place)


def zeros(megabytes):
    squeezer, block = zlib.compressobj(9), bytes(1 << 20)
    return b"".join(squeezer.compress(block) for _ in range(megabytes)) + squeezer.flush()


def jpeg(width, height, scans=1):
    """Return a gray JPEG of another size than its pixels, whose further scans are empty."""
    from PIL import Image

    stream = io.BytesIO()
    Image.new("L", (16, 16), 90).save(stream, "JPEG", progressive=scans > 1)
    data = bytearray(stream.getvalue())
    at = data.index(b"\xff\xc2" if scans > 1 else b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    if scans > 1:
        data[-2:] = bytes(data[data.rindex(b"\xff\xda") : -2]) * scans + b"\xff\xd9"
    return bytes(data)


def exif_of(count):
    """Return EXIF of `count` directories at one place, each of as many numbers: their product is walked."""
    start = 8 + 2 + 12 * count + 4
    outer, inner = (struct.pack("<HHII", tag, 4, 1, start) * count for tag in (0x8769, 0xA005))
    length = struct.pack("<H", count)
    return b"II*\0" + struct.pack("<I", 8) + length + outer + bytes(4) + length + inner + bytes(4)


def png(width, height, *, extra=b"", name=b""):
    def chunk(name, data):
        crc = struct.pack(">I", zlib.crc32(name + data))
        return struct.pack(">I", len(data)) + name + data + crc

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    more = chunk(name, extra) if name else b""
    body = chunk(b"IDAT", zlib.compress(bytes(72))) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + head + more + body


def envi(text="", **changes):
    fields = {"samples": 4, "lines": 3, "bands": 2, "data type": 12, "interleave": "bil"} | changes
    return "\n".join(["ENVI", *(f"{key} = {value}" for key, value in fields.items()), text])


def dng(side, code):
    raw = {"t259": ("H", [code]), "t262": ("H", [32803]), "t50706": ("B", [1, 4, 0, 0])}
    mosaic = {"t33421": ("H", [2, 2]), "t33422": ("B", [0, 1, 1, 2])}
    return tiff(side, side, t258=("H", [16]), **raw, **mosaic)


def ring():
    second = struct.pack("<HHHIII", 1, 256, 4, 1, 8, 8)
    return tiff(following=2048).ljust(2048, b"\0") + second


NOISE = bytes((i * i * 31 >> 4) & 255 for i in range(5000))
SAME = {"t273": ("I", [DATA] * 2000), "t279": ("I", [4096] * 2000), "t278": ("I", [1])}
ZSTD = b"\x28\xb5\x2f\xfd\x00\x48" + (struct.pack("<I", (1 << 17) << 3 | 2)[:3] + b"\0") * 8192
BOMBS = {
    "tiff of 4,000 million columns": ("E_SIZE", "a.tif", lambda: tiff(0xFFFFFFFF, 0xFFFFFFFF)),
    "tiff without height": ("E_SIZE", "a.tif", lambda: tiff(8, 0)),
    "tiff in a ring": ("E_UNREADABLE", "a.tif", ring),
    "tiff whose next page is behind its end": ("E_TRUNCATED", "a.tif", lambda: tiff(following=0xFFFFFFF0)),
    "tiff of 20,000 pages": ("E_SIZE", "a.tif", many_pages),
    "tiff of pages over one another": ("E_UNREADABLE", "a.tif", overlapping),
    "tiff of 60,000 tags": ("E_UNREADABLE", "a.tif", lambda: b"II*\0\x08\0\0\0" + struct.pack("<H", 60_000) + bytes(900)),
    "tiff whose strip lies behind its end": ("E_TRUNCATED", "a.tif", lambda: tiff(t273=("I", [1 << 30]))),
    "tiff whose strips are all the same bytes": ("E_UNREADABLE", "a.tif", lambda: tiff(4096, 2000, bytes(4096), **SAME)),
    "tiff of an impossible ratio": ("E_SIZE", "a.tif", lambda: packed(8, zlib.compress(bytes(40_000)), 40_000)),
    "deflate of 300 MB in 8 pixels": ("E_UNREADABLE", "a.tif", lambda: packed(8, zeros(300))),
    "zstandard of a gigabyte in 8 pixels": ("E_UNREADABLE", "a.tif", lambda: packed(50000, ZSTD)),
    "jpeg of 65,000 in 8 pixels of a tiff": ("E_SIZE", "a.tif", lambda: packed(7, jpeg(65_000, 65_000))),
    "tiff of an unknown codec": ("E_UNREADABLE", "a.tif", lambda: packed(777, bytes(64))),
    "tiff of a tile of a gigapixel": ("E_SIZE", "a.tif", one_tile_of_a_gigapixel),
    "png that its bytes cannot hold": ("E_SIZE", "a.png", lambda: png(30_000, 30_000)),
    "png of a profile of 50 MB": (None, "a.png", lambda: png(8, 8, name=b"iCCP", extra=b"icc\0\0" + zeros(50))),
    "png of exif walked 10 million times": (None, "a.png", lambda: png(8, 8, name=b"eXIf", extra=exif_of(3200))),
    "jpeg of 65,000 columns": ("E_SIZE", "a.jpg", lambda: jpeg(65_000, 65_000)),
    "jpeg of 400 scans": ("E_SIZE", "a.jpg", lambda: jpeg(5000, 5000, 400)),
    "cube of 10^12 lines": ("E_SIZE", "a.hdr", lambda: envi(lines=10**12)),
    "header of 10 MB": ("E_SIZE", "a.hdr", lambda: envi("description = {" + "a" * (10 << 20) + "}")),
    "header of semicolons": ("E_UNREADABLE", "a.hdr", lambda: envi('a = {"' + " ;}" * 300_000 + "}", samples="none")),
    "raw of noise": ("E_UNREADABLE", "a.nef", lambda: NOISE),
    "dng of lossless jpeg that is none": ("E_TRUNCATED", "a.dng", lambda: dng(30_000, 7)),
    "empty file": ("E_TRUNCATED", "a.tif", lambda: b""),
    "device": ("E_UNREADABLE", "a.tif", lambda: lambda path: path.symlink_to("/dev/zero")),
    "hdf5 of noise": ("E_UNREADABLE", "a.h5", lambda: b"\x89HDF\r\n\x1a\n" + NOISE),
    "matlab of noise": ("E_UNREADABLE", "a.mat", lambda: b"MATLAB 5.0 MAT-file, Platform".ljust(128) + NOISE),
    "toml of more than a megabyte": ("E_SIZE", "a.toml", lambda: "a = 1\n" * 200_000),
    "toml of 10,000 levels": ("E_SIZE", "a.toml", lambda: "a = " + "[" * 10_000 + "]" * 10_000),
    "toml of a key of 20,000 parts": ("E_SIZE", "a.toml", lambda: ".".join("a" * 20_000) + " = 1"),
    "manifest of 20 MB": ("E_SIZE", "a.csv", lambda: "file,exposure_s\n" + "a.tif,1\n" * 2_500_000),
    "manifest of a cell of a megabyte": ("E_UNREADABLE", "a.csv", lambda: "file,exposure_s\n" + "a" * 1_000_000 + ",1\n"),
    "json of 100,000 levels": ("E_SIZE", "a.json", lambda: "[" * 100_000 + "]" * 100_000),
}  # fmt: skip
"""Code, name and content; a code of None: what is hostile is no part of the image, which is read or refused."""


def lay(folder, number, name, data):
    """Write a hostile file; a cube has its data beside it, and what is no file is made by a function."""
    path = folder / str(number) / name
    path.parent.mkdir()
    if callable(data):
        data(path)
    else:
        path.write_bytes(data if isinstance(data, bytes) else data.encode())
        path.with_suffix(".raw").write_bytes(bytes(48))
    return path


def readers(path):
    from levkas.campaign.discovery.file_index import read_exposures
    from levkas.campaign.schema.toml import read_toml
    from levkas.core.text import read_json
    from levkas.readers.frames import read_facts, read_frame

    special = {".toml": read_toml, ".csv": read_exposures, ".json": read_json}
    return [special[path.suffix]] if path.suffix in special else [read_facts, read_frame]


def tell(read, path):
    """Read one file; return what came of it as plain values."""
    from levkas.core.problems import Refused

    before, started = peak(), sum(os.times()[:4])
    try:
        signal.alarm(180)
        read(path)
        found = {"came": "read"}
    except Refused as refused:
        found = {"came": "refused", "problems": [p.to_dict() for p in refused.problems]}
    except BaseException as error:
        found = {"came": f"{type(error).__name__}: {error}"[:300]}
    finally:
        signal.alarm(0)
    return found | {"seconds": sum(os.times()[:4]) - started, "growth": peak() - before}


def peak():
    """Peak resident bytes since the last call, where the kernel tells; else of the whole process."""
    import resource

    try:
        rows = Path("/proc/self/status").read_text().splitlines()
        found = next(int(row.split()[1]) for row in rows if row.startswith("VmHWM"))
        Path("/proc/self/clear_refs").write_text("5")
        return found << 10
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


def main(folder):
    import tifffile  # noqa: F401  what readers import is no growth

    for number, read in ((n, r) for n in range(2) for r in readers(Path("a.tif"))):
        path = folder / f"{number}.tif"
        path.write_bytes(packed(8, zlib.compress(bytes(64))))
        read(path)
    signal.signal(signal.SIGALRM, lambda *_: (_ for _ in ()).throw(TimeoutError("180 s")))
    found = {}
    for number, (name, (_, file, make)) in enumerate(BOMBS.items(), 10):
        path = lay(folder, number, file, make())
        found[name] = [tell(read, path) for read in readers(path)]
    print(json.dumps(found))


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    command = [sys.executable, __file__, str(tmp_path_factory.mktemp("bombs"))]
    done = subprocess.run(command, capture_output=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr.decode()[-2000:]
    return json.loads(done.stdout)


@pytest.mark.skipif(sys.platform == "win32", reason="pipes, devices and alarms of Unix")
@pytest.mark.parametrize("name", BOMBS)
def test_a_hostile_file_is_refused_once_soon_and_in_little_memory(results, name):
    code = BOMBS[name][0]
    for found in results[name]:
        assert found["came"] in ("read", "refused"), found
        assert found["seconds"] < MOST_SECONDS and found["growth"] < MOST_BYTES, found
    if code:
        (problem,) = results[name][-1]["problems"]
        assert problem["code"] == code, problem
        assert all(problem[key] for key in ("file", "found", "expected", "fix")), problem


if __name__ == "__main__":
    main(Path(sys.argv[1]))
