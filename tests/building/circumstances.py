"""A campaign built under other circumstances, in a process of its own, for its bytes to be compared.

One circumstance at a time: numbers of threads, order and dates of the files, folder, locale, time zone and
day. `MATRIX`: 1, 2 and 3 threads x 64, 97 and all rows at a time, each with files in an order of their own, in
a folder, locale and time zone of their own. `INSTRUCTIONS` asks each library for other instructions, which held
libraries do not heed: with ``LEVKAS_INSTRUCTIONS=native`` each changes the bytes. `EMULATED` processors need
``qemu-x86_64-static`` of the package qemu-user-static, or the program that $QEMU names.
"""

import os
import random
import shutil
import subprocess
import sys
from pathlib import Path

from levkas.core.digests import hash_tree

BUILD = """
import datetime, os, random, sys, time

days, how = int(sys.argv[3]), sys.argv[4].split()
if days:
    import pandas  # whose compiled code takes the clock's class for the one that it was compiled with
    clock, true_time, true_ns = datetime.datetime, time.time, time.time_ns
    class Moved(clock):
        @classmethod
        def now(cls, tz=None):
            return clock.now(tz) + datetime.timedelta(days)
        @classmethod
        def today(cls):
            return cls.now()
    datetime.datetime = Moved
    time.time = lambda: true_time() + 86400 * days
    time.time_ns = lambda: true_ns() + 86400 * days * 10**9
if "shuffled" in how:
    listed, scanned = os.listdir, os.scandir
    def mixed(entries):
        entries = list(entries)
        random.Random(7).shuffle(entries)
        return entries
    class Scan:
        def __init__(self, entries):
            self.entries = iter(entries)
        def __iter__(self):
            return self
        def __next__(self):
            return next(self.entries)
        def __enter__(self):
            return self
        def __exit__(self, *error):
            pass
        close = __exit__
    os.listdir = lambda *place: mixed(listed(*place))
    os.scandir = lambda *place: Scan(mixed(scanned(*place)))
from levkas.core.instructions import hold_instructions
hold_instructions()
from levkas.building import build, summarise
report = summarise(build(sys.argv[1], output=sys.argv[2]))
print(report.text)
sys.exit(not report.ok)
"""
ONE_THREAD = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
CIRCUMSTANCES: dict[str, tuple[dict[str, str], int, str]] = {
    "as it comes": ({}, 0, ""),
    "1 thread": ({"LEVKAS_THREADS": "1"}, 0, ""),
    "2 threads": ({"LEVKAS_THREADS": "2"}, 0, ""),
    "3 threads": ({"LEVKAS_THREADS": "3", "NUMBA_NUM_THREADS": "3"}, 0, ""),
    "libraries with 1 thread": (ONE_THREAD, 0, ""),
    "one processor": ({}, 0, "pinned"),
    "files in another order, of other dates, elsewhere": ({}, 0, "shuffled"),
    "Turkish, Kathmandu, 400 days on": (
        {"LC_ALL": "tr_TR.UTF-8", "LANG": "tr_TR.UTF-8", "TZ": "Asia/Kathmandu"},
        400,
        "",
    ),
    "plain C locale, 9000 days ago": ({"LC_ALL": "C", "TZ": "America/Lima"}, -9000, ""),
}
PLACES = (("C", "UTC"), ("tr_TR.UTF-8", "Asia/Kathmandu"), ("C.UTF-8", "America/Lima"))
THREADS, TILES = (1, 2, 3), ("64", "97", "whole")
MATRIX: dict[str, tuple[dict[str, str], int, str]] = {
    f"{threads} threads, {tile} rows": (
        {
            "LEVKAS_THREADS": str(threads),
            "NUMBA_NUM_THREADS": "3",
            "LEVKAS_TILE": tile,
            "LC_ALL": PLACES[(threads + row) % 3][0],
            "TZ": PLACES[(threads + row) % 3][1],
        },
        100 * threads + row,
        "shuffled",
    )
    for threads in THREADS
    for row, tile in enumerate(TILES)
}
INSTRUCTIONS: dict[str, dict[str, str]] = {
    "OpenBLAS for Nehalem": {"OPENBLAS_CORETYPE": "Nehalem"},
    "OpenBLAS for Haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "NumPy without AVX-512": {"NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR"},
    "NumPy without AVX": {"NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR"},
    "OpenCV without AVX-512": {"OPENCV_CPU_DISABLE": "AVX512-SKX"},
    "OpenCV without AVX": {"OPENCV_CPU_DISABLE": "AVX,FP16,AVX2,AVX512-SKX"},
    "IPP for SSE4.2": {"OPENCV_IPP": "sse42"},
    "no IPP": {"OPENCV_IPP": "disabled"},
    "C library without fused multiply-add": {
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2,-AVX512F,-AVX512VL,-AVX512BW,-AVX512DQ"
    },
    "numba for any x86-64": {"NUMBA_CPU_NAME": "generic"},
}
INSTRUCTIONS["the least of all of them"] = {
    variable: value
    for name in INSTRUCTIONS
    if name not in ("OpenBLAS for Haswell", "NumPy without AVX-512", "OpenCV without AVX-512")
    for variable, value in INSTRUCTIONS[name].items()
}
EMULATED = {
    f"emulated {name}": ({"NUMBA_CPU_NAME": "generic"}, 0, f"emulated {name}")
    for name in ("Nehalem", "Haswell")  # without and with AVX2 and fused multiply-add
}
EVERY = {
    **CIRCUMSTANCES,
    **MATRIX,
    **{name: (settings, 0, "") for name, settings in INSTRUCTIONS.items()},
    **EMULATED,
}


def scatter(folder: Path, copy: Path, seed: int) -> None:
    """Copy a campaign file by file in another order, with other dates."""
    files = [p for p in sorted(folder.rglob("*")) if p.is_file()]
    random.Random(seed).shuffle(files)
    for number, path in enumerate(files):
        target = copy / path.relative_to(folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
        os.utime(target, (10**9 + 1000 * number, 10**9 + 1000 * number))


def run(folder: Path, output: Path, name: str) -> dict[str, str]:
    """Build in a process of its own, and return the hashes."""
    more, days, how = EVERY[name]
    if "shuffled" in how:
        elsewhere = output.with_name(f"{output.name} elsewhere")
        scatter(folder, elsewhere, 3 + days)
        folder = elsewhere
    command = [sys.executable, "-c", BUILD, str(folder), str(output), str(days), how]
    if how == "pinned":
        command[2] = "import os; os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])" + BUILD
    if how.startswith("emulated"):
        emulator = os.environ.get("QEMU", "qemu-x86_64-static")
        command = [emulator, "-cpu", how.removeprefix("emulated "), *command]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env={**os.environ, **more})
    return hash_tree(output)
