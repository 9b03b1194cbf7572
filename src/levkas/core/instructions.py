"""Instruction sets: numerical libraries held to x86-64-v2, so that unlike processors write the same bytes.

NumPy, OpenBLAS, OpenCV and IPP choose the widest instructions of a processor when they are loaded. Wider ones add in
another order and fuse multiply and add, which shows in the last bits of a fitted map. Held to what every x86-64 processor
has on which the locked NumPy runs (SSE4.2, since 2008), they give the same bits on all with fused multiply-add (x86-64-v3,
since 2013); on older ones the C library's exp, log and sin still round otherwise now and then. Kernels of numba are
compiled for the processor at hand: without fast-math their bits are the same.
"""

from __future__ import annotations

import os
import platform
import re
import sys
from functools import cache
from pathlib import Path

INSTRUCTIONS = "LEVKAS_INSTRUCTIONS"
BASELINE = "x86-64-v2"
HELD = {
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",  # all that NumPy 2.4 dispatches
    "OPENBLAS_CORETYPE": "Nehalem",
    "OPENCV_IPP": "disabled",
    "OPENCV_LOG_LEVEL": "ERROR",  # OpenCV warns at every start that IPP is disabled
}
OPENCV_SETS = {
    "AVX": {"avx"},
    "FP16": {"f16c"},
    "AVX2": {"avx2"},
    "AVX512-SKX": {"avx512f", "avx512cd", "avx512bw", "avx512dq", "avx512vl"},
}
"""Sets beyond x86-64-v2 that OpenCV dispatches → flags of the processor that make one up."""


def hold_instructions() -> bool:
    """Hold the libraries of this process, and of those that it starts, to x86-64-v2.

    It returns whether they are held, and raises nothing. ``LEVKAS_INSTRUCTIONS=native`` leaves them as they are: False then,
    on other processors than x86-64, and where NumPy or OpenCV are loaded already: they do not choose again.

    >>> import numpy
    >>> hold_instructions()
    False
    """
    native = os.environ.get(INSTRUCTIONS, "").strip() == "native"
    ours = platform.machine().lower() in ("x86_64", "amd64")
    if native or not ours or {"numpy", "cv2"} & sys.modules.keys():
        return False
    os.environ.update(_held())
    return True


def describe_instructions() -> dict[str, str]:
    """Return what the libraries compute with, which this loads: `level`, `numpy`, `blas` (version and kernel of each) and `opencv`.

    The level is ``x86-64-v2`` where all are held to it, else ``native``.

    >>> sorted(describe_instructions())
    ['blas', 'level', 'numpy', 'opencv']
    """
    import cv2
    import numpy as np
    import scipy.linalg  # noqa: F401  its BLAS, that of the kernels, is another one than NumPy's
    from threadpoolctl import threadpool_info

    sets = np.show_config(mode="dicts")["SIMD Extensions"]
    beyond = sets.get("found", [])
    blas = [one for one in threadpool_info() if one["user_api"] == "blas"]
    kernels = {one.get("architecture", "") for one in blas}
    named = {f"{b['internal_api']} {b['version']} {b.get('architecture', '')}" for b in blas}
    opencv = [word.strip("*") for word in cv2.getCPUFeaturesLine().split() if "?" not in word]
    ipp = bool(cv2.ipp.useIPP())
    wide = beyond or kernels != {HELD["OPENBLAS_CORETYPE"]} or OPENCV_SETS.keys() & opencv or ipp
    return {
        "level": "native" if wide else BASELINE,
        "numpy": " ".join([*sets.get("baseline", []), *beyond]),
        "blas": ", ".join(sorted(named)),
        "opencv": " ".join([*opencv, *(["IPP"] if ipp else [])]),
    }


@cache
def instructions_in_use() -> str:
    """Return in one line what the libraries compute with; loads them only where they are not held."""
    if _held().items() <= os.environ.items():
        return BASELINE
    found = describe_instructions()
    if found["level"] == BASELINE:
        return BASELINE
    return f"{found['level']}: numpy {found['numpy']}; {found['blas']}; opencv {found['opencv']}"


def _held() -> dict[str, str]:
    """Return the variables that hold the libraries; of OpenCV's sets those that the processor has: of another one it complains."""
    try:
        processor = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):  # Windows, macOS
        processor = ""
    flags = re.search(r"^flags\s*:(.*)$", processor, re.MULTILINE)
    here = set(flags[1].split()) if flags else set[str]().union(*OPENCV_SETS.values())
    sets = [name for name, needed in OPENCV_SETS.items() if needed <= here]
    return {**HELD, "OPENCV_CPU_DISABLE": ",".join(sets)}
