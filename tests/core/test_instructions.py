"""Libraries held to one instruction set: bits, what is refused, what is recorded."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from importlib.metadata import version

import pytest

from levkas.core import instructions

WIDE = {
    "OPENBLAS_CORETYPE": "Haswell",
    "NPY_DISABLE_CPU_FEATURES": "AVX512_SPR",
    "OPENCV_IPP": "sse42",
    "OPENCV_CPU_DISABLE": "",
}
NO_FMA = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2,-AVX512F,-AVX512VL"}
COMPUTE = """
import hashlib, json
from levkas.core.instructions import describe_instructions, hold_instructions
held = hold_instructions()
import cv2
import numpy as np
import scipy.linalg
cv2.setNumThreads(1)
draw = np.random.default_rng(1)
a = draw.normal(0, 3, (211, 307))
b = np.float32(cv2.resize(np.float32(a), None, fx=2.3, fy=1.9, interpolation=cv2.INTER_CUBIC))
made = {
    "product": a @ a.T,
    "fit": np.linalg.lstsq(a[:, :10], a[:, 11:13], rcond=None)[0],
    "solved": scipy.linalg.solve(a[:40, :40], a[:40, 50]),
    "complex": (a + 2j * a[::-1]) * (a[:, ::-1] - 1j),
    "order of ties": np.argsort(np.round(a.ravel())),
    "exp": np.exp(np.float32(a)),
    "resized": b,
    "blurred": cv2.GaussianBlur(b, (0, 0), 2.5),
    "matched": cv2.matchTemplate(b, b[50:90, 60:110].copy(), cv2.TM_CCOEFF_NORMED),
}
bits = {k: hashlib.sha256(np.ascontiguousarray(v).tobytes()).hexdigest()[:8] for k, v in made.items()}
print(json.dumps({"held": held, "bits": bits, "record": describe_instructions()}))
"""
VERSIONS = {"numpy": "2.4.6", "scipy": "1.17.1", "opencv-python-headless": "5.0.0.93"}
BITS = {
    "product": "a921a3e8",
    "fit": "3baf98ea",
    "solved": "aa9fbd37",
    "complex": "132eefde",
    "order of ties": "f867e9b3",
    "exp": "a0c9bb75",
    "resized": "9ccca993",
    "blurred": "2a0b4aa1",
    "matched": "9808ff43",
}
"""Of these versions on Zen 5, and on Nehalem and Haswell as QEMU emulates them."""

x86_64 = pytest.mark.skipif(
    platform.machine().lower() not in ("x86_64", "amd64"), reason="instruction sets of x86-64"
)


def compute(**settings: str) -> dict:
    """Run `COMPUTE` in a process of its own, with no settings but these."""
    ours = (*instructions.HELD, "OPENCV_CPU_DISABLE", instructions.INSTRUCTIONS)
    env = {k: v for k, v in os.environ.items() if k not in ours}
    env |= {"PYTHONPATH": os.pathsep.join(sys.path)} | settings
    done = subprocess.run(
        [sys.executable, "-c", COMPUTE], capture_output=True, text=True, check=True, env=env
    )
    assert "OPENCV" not in done.stderr and "IPP" not in done.stderr
    return json.loads(done.stdout)


@x86_64
def test_held_libraries_give_the_same_bits_whatever_they_are_asked_for():
    plain = compute()
    assert plain["held"] and plain["record"]["level"] == instructions.BASELINE
    for settings in (WIDE, NO_FMA):
        assert compute(**settings) == plain


@x86_64
def test_held_libraries_give_the_bits_of_other_processors():
    if {name: version(name) for name in VERSIONS} != VERSIONS:
        pytest.skip("other versions than those of which the bits are known")
    assert compute()["bits"] == BITS


@x86_64
@pytest.mark.skipif(os.environ.get(instructions.INSTRUCTIONS) == "native", reason="not held")
def test_the_process_of_the_tests_is_held():
    assert instructions.describe_instructions()["level"] == instructions.BASELINE


def test_the_command_line_loads_no_library_before_it_is_held():
    code = "import sys, levkas.cli; sys.exit(len({'numpy', 'cv2', 'numba'} & {*sys.modules}))"
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    assert subprocess.run([sys.executable, "-c", code], env=env).returncode == 0
