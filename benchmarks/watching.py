"""Does `levkas watch` judge in time, and how often does it raise a false alarm?

    python benchmarks/watching.py alarms FOLDER      ten sound simulated campaigns of unlike cameras
    python benchmarks/watching.py frames FOLDER      seconds from the last byte of a frame to its verdict, 1 to 100 Mpx
    python benchmarks/watching.py many FOLDER        the same in a session of 10 to 10,000 frames, and the memory it takes
    python benchmarks/watching.py builds FOLDER      a build after such a session beside one without: the same bytes (LEVKAS_FRAMES, default 10,000)

Each takes `--results FILE`. FOLDER is a new one for what is simulated.
"""

import argparse
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import tifffile
from results import add_option, record

from levkas.core.digests import hash_tree
from levkas.simulation import simulate_campaign
from levkas.workbench.watching import WatchedSession
from levkas.workbench.watching.cache import MeasureCache

LOOKS_S = 0.3
PRESETS = (("small", None), ("small", 0.14), ("hard", 0.15), ("default", 0.15), ("small", 0.18))
SCALES = (0.1, 0.2, 0.4)
MEGAPIXELS = (1, 10, 50, 100)
FORMS = {
    "TIFF": ("tif", {}),
    "deflate": ("tif", {"compression": "zlib", "predictor": True, "rowsperstrip": 64}),
    "DNG": ("dng", {}),
}
"""Formats: their suffixes, and how tifffile writes them."""
SIZES = (10, 100, 1000, 10000)
ONE_CAMERA = """
[campaign]
reference = { camera = "grey", band = "550 nm" }
[cameras.grey]
kind = "bands"
files = "raw/{target}_{wavelength}nm_{shot}.tif"
bits = 12
[targets]
dark = "dark"
white = { names = "white", reflectance = 0.98 }
"""


def watched(folder):
    """Return the session of a folder, with a cache beside it."""
    return WatchedSession(folder, MeasureCache(folder.parent / f"{folder.name}-cache"))


def wait_for(session, name, before, most_s=12.0):
    """Look as `levkas watch` does until a frame has another verdict; return seconds, findings and verdict."""
    start = time.monotonic()
    while time.monotonic() - start < most_s:
        for _ in session.poll():
            pass
        frame = next((f for f in session.state().frames if f.file.name == name), None)
        if frame and frame.verdict != "waiting" and frame.findings != before:
            break
        time.sleep(LOOKS_S)
    return time.monotonic() - start, frame.findings if frame else ()


def alarms(folder, results):
    """Count findings in ten sound campaigns."""
    count = alarmed = 0
    for seed in range(10):
        preset, scale = PRESETS[seed % len(PRESETS)]
        source = folder / f"whole{seed}"
        list(simulate_campaign(source, preset=preset, scale=scale, seed=10 + seed))
        session = watched(source)
        state = session.settle(300)
        some = [f for f in state.frames if f.findings]
        count, alarmed = count + len(state.frames), alarmed + len(some)
        print(f"seed {10 + seed} {preset} {scale}: {len(some)} of {len(state.frames)}", flush=True)
        for frame in some[:4]:
            print(f"    {frame.what}: {frame.findings[0].text}", flush=True)
    print(f"{alarmed} of {count} sound frames")
    record(results, "watching", {"false alarms, simulated": 100 * alarmed / count})


def noise(shape, seed, level):
    """Return a grey frame of 12 bits."""
    rng = np.random.default_rng(seed)
    tile = rng.normal(level, 20, (min(shape[0], 512), min(shape[1], 512)))
    codes = np.resize(tile, (tile.shape[0], shape[1])).round().clip(0, 4095).astype(np.uint16)
    codes = np.tile(codes, (-(-shape[0] // len(codes)), 1))[: shape[0]]
    codes[seed % shape[0], seed % shape[1]] += 1
    return codes


def put(home, name, shape, seed, level=1500.0):
    """Write a grey frame of 12 bits."""
    tifffile.imwrite(home / "raw" / name, noise(shape, seed, level), metadata=None)


def home_of(folder, suffix="tif"):
    """Return a campaign of one camera without a frame."""
    (folder / "raw").mkdir(parents=True)
    (folder / "campaign.toml").write_text(ONE_CAMERA.replace(".tif", f".{suffix}"))
    return folder


def put_dng(path, codes, tile=512):
    """Write a mosaic as a camera does that compresses: a DNG of tiles in lossless JPEG."""
    import imagecodecs

    h, w = codes.shape
    parts = (
        np.pad(part, [(0, tile - n) for n in part.shape], "edge")
        for y in range(0, h, tile)
        for part in (codes[y : y + tile, x : x + tile] for x in range(0, w, tile))
    )
    tags = [
        (50706, "B", 4, (1, 4, 0, 0), True),
        (50708, "s", 0, "Levkas", True),
        (33421, "H", 2, (2, 2), True),
        (33422, "B", 4, (0, 1, 1, 2), True),
        (50714, "H", 1, 64, True),
        (50717, "I", 1, 4095, True),
        (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
        (50778, "H", 1, 21, True),
        (50728, "2I", 3, (1, 1, 1, 1, 1, 1), True),
    ]
    facts = {"shape": codes.shape, "dtype": codes.dtype, "compression": 7, "tile": (tile, tile)}
    encoded = (imagecodecs.ljpeg_encode(part) for part in parts)
    tifffile.imwrite(path, encoded, photometric=32803, extratags=tags, metadata=None, **facts)


def write_frame(path, shape, seed, level, form):
    """Write a grey frame of 12 bits in one of `FORMS`."""
    codes = noise(shape, seed, level)
    if form == "DNG":
        put_dng(path, codes)
    else:
        tifffile.imwrite(path, codes, metadata=None, **FORMS[form][1])


def frames(folder, results):
    """Time the verdict of the third frame of an object by its size and format."""
    found = {}
    for form, (suffix, _) in FORMS.items():
        for megapixels in MEGAPIXELS:
            shape = (
                round(np.sqrt(megapixels * 1e6 * 2 / 3)),
                round(np.sqrt(megapixels * 1e6 * 3 / 2)),
            )
            home = home_of(folder / f"{form}{megapixels}".replace(" ", "-"), suffix)
            session = watched(home)
            for k, (target, level) in enumerate({"dark": 64, "white": 3000, "icon": 1500}.items()):
                write_frame(home / f"raw/{target}_550nm_{k}.{suffix}", shape, k, level, form)
            session.settle()
            aside = folder / "aside"
            write_frame(aside, shape, 9, 1500, form)
            aside.rename(home / f"raw/icon_550nm_9.{suffix}")
            seconds, _ = wait_for(session, f"raw/icon_550nm_9.{suffix}", None, 60)
            found[f"{megapixels} Mpx", form] = seconds
            load = os.getloadavg()[0]
            print(f"{form:20} {megapixels:4} Mpx {seconds:.2f} s, load {load:.1f}", flush=True)
    record(results, "watching-sizes", found)


def many(folder, results):
    """Time the verdict of one frame more in sessions of many, whose frames came in any order and state."""
    found, home = {}, home_of(folder / "many")
    session, rng, there = watched(home), np.random.default_rng(2), 0
    names = [(f"icon{k % 20}", 400 + 10 * (k // 20 % 25), k // 500) for k in range(max(SIZES))]
    order = rng.permutation(len(names))
    for size in SIZES:
        start, before = time.monotonic(), os.times()
        late = []
        for k in order[there:size]:
            late += _come(home, names[k], int(k))
            if k % 100 == 0:
                list(session.poll(most_s=1))
        for path, data in late:
            path.write_bytes(data)
        session.settle(3600)
        spent, frames = os.times().user - before.user, len(session.listing.files)
        there, took = size, time.monotonic() - start
        put(home, f"late{size}_550nm_99.tif", (120, 160), 7)
        seconds, _ = wait_for(session, f"raw/late{size}_550nm_99.tif", None, 60)
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        found[size] = seconds
        print(
            f"{size:6} ({frames} files): one more {seconds:.2f} s; written and judged {took:.0f} s, "
            f"{spent:.0f} s of processor, {memory:.2f} GB",
            flush=True,
        )
    again = WatchedSession(home, MeasureCache(folder / "other-cache"))
    assert again.settle(3600).to_dict() == session.state().to_dict(), "the way of coming shows"
    record(results, "watching", {f"one of {n:,} frames": s for n, s in found.items()})
    record(results, "watching", {"memory of 10,000 frames": memory})


def builds(folder, _results):
    """Build after a disorderly session, watched five times on its way, and without one; print whether the databases are the same."""
    count, home, alone = (
        int(os.environ.get("LEVKAS_FRAMES", "10000")),
        home_of(folder / "watched"),
        folder / "alone",
    )
    targets = ["dark", "white", *(f"icon{n}" for n in range(18))]
    names = [(targets[k % 20], 400 + 10 * (k // 20 % 25), k // 500) for k in range(count)]
    late = []
    for part in np.array_split(np.random.default_rng(2).permutation(count), 5):
        for k in part:
            late += _come(home, names[k], int(k))
        _levkas(folder / "cache", "watch", home, "--once")
    for path, data in late:
        path.write_bytes(data)
    watching = _levkas(folder / "cache", "watch", home, "--once")
    shutil.copytree(home, alone)
    after, without = (
        _levkas(folder / cache, "build", one) for cache, one in (("cache", home), ("none", alone))
    )
    same = hash_tree(home / "database") == hash_tree(alone / "database")
    print(
        f"{count} frames: last look {watching:.0f} s, build {after:.0f} s, without a session {without:.0f} s, the same bytes: {same}"
    )
    if not same:
        raise SystemExit("the databases differ")


def _levkas(cache, *words):
    """Run a command with a cache folder of its own; return its seconds."""
    start = time.monotonic()
    where = {**os.environ, "XDG_CACHE_HOME": str(cache)}
    program = [sys.executable, "-c", "from levkas.cli import main; main()"]
    done = subprocess.run(
        [*program, *map(str, words)], env=where, capture_output=True, text=True, check=False
    )
    if words[0] == "build" and done.returncode:  # a look ends with 1 where a frame says stop
        raise RuntimeError(done.stderr)
    return time.monotonic() - start


def _come(home, name, k):
    """Write a frame: one in fifty half at first, in 50 late, in 50 replaced by another, in 50 twice; return what comes later."""
    target, band, shot = name
    path = home / "raw" / f"{target}_{band}nm_{shot:02}.tif"
    level = {"dark": 64, "white": 3000}.get(target, 1500)
    put(home, path.name, (120, 160), k, level)
    data, fate = path.read_bytes(), k % 50
    if fate == 0:
        path.write_bytes(data[: len(data) // 2])
    elif fate == 1:
        path.unlink()
    elif fate == 2:
        put(home, path.name, (120, 160), k + len(home.name), level)
    elif fate == 3:
        put(home, f"{target}_{band}nm_{50 + shot}.tif", (120, 160), k, level)
    return [(path, data)] if fate < 3 else []


def main():
    """Run one of the four."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["alarms", "frames", "many", "builds"])
    parser.add_argument("folder", type=Path)
    add_option(parser)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    globals()[options.what](options.folder, options.results)


if __name__ == "__main__":
    main()
