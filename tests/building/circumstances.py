"""A campaign built under other circumstances, in a process of its own, for its bytes to be compared.

Numbers of threads x rows at a time, each with files in an order and of dates of their own, in a folder, locale, time
zone and on a day of their own; and instructions that libraries are asked for, which held ones do not heed: with
``LEVKAS_INSTRUCTIONS=native`` each changes the bytes.
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

days, shuffled = int(sys.argv[3]), sys.argv[4] == "shuffled"
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
if shuffled:
    listed = os.listdir
    def mixed(*place):
        entries = list(listed(*place))
        random.Random(7).shuffle(entries)
        return entries
    os.listdir = mixed
from levkas.core.instructions import hold_instructions
hold_instructions()
from levkas.building import build, summarise
report = summarise(build(sys.argv[1], output=sys.argv[2]))
print(report.text)
sys.exit(not report.ok)
"""
PLACES = (("C", "UTC"), ("tr_TR.UTF-8", "Asia/Kathmandu"), ("C.UTF-8", "America/Lima"))
EVERY: dict[str, tuple[dict[str, str], int, str]] = {
    f"{threads} threads, {tile} rows": (
        {
            "LEVKAS_THREADS": str(threads),
            "NUMBA_NUM_THREADS": "3",
            "LEVKAS_TILE": tile,
            "LC_ALL": PLACES[(threads + row) % 3][0],
            "TZ": PLACES[(threads + row) % 3][1],
        },
        (400 * threads + row) * (-1) ** row,
        "shuffled",
    )
    for threads in (1, 2, 3)
    for row, tile in enumerate(("64", "97", "whole"))
}
INSTRUCTIONS = {
    "OPENBLAS_CORETYPE": "Haswell",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "OPENCV_CPU_DISABLE": "AVX512-SKX",
    "OPENCV_IPP": "sse42",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2,-AVX512F,-AVX512VL,-AVX512BW,-AVX512DQ",
    "NUMBA_CPU_NAME": "generic",
}
EVERY |= {f"{name} = {value}": ({name: value}, 0, "") for name, value in INSTRUCTIONS.items()}


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
    if how:
        elsewhere = output.with_name(f"{output.name} elsewhere")
        scatter(folder, elsewhere, 3 + days)
        folder = elsewhere
    command = [sys.executable, "-c", BUILD, str(folder), str(output), str(days), how]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env={**os.environ, **more})
    return hash_tree(output)
