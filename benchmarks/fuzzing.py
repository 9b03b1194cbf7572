"""Change bytes of small files at random and read them: whatever comes must be a sound value or a refusal.

    python benchmarks/fuzzing.py [SECONDS] [SEED]

Frames, scans, campaign.toml, records, tables and control points (`small_files.py`), each judged by
`judging.py`; then, for as long again, camera raw: DNGs, whose decoder runs in a process of its own, forked
here from one that has loaded LibRaw, and sometimes started as a build starts it. A seeded loop without
coverage guidance; `guided_fuzzing.py` has it. Prints runs, distinct refusals, the run that took most
processor time, and everything that was neither a sound value nor a refusal.
"""

import logging
import struct
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

import judging
import numpy as np
from small_files import TOKENS, raw_seeds, seeds

from levkas.readers import raw

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
        _, status, used = os.wait4(child, 0)
        answer.seek(0)
        data = answer.read()
        told = os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, len(data)
        sys.__stdout__.buffer.write(struct.pack(">idI", *told))
        sys.__stdout__.buffer.write(data)
        sys.__stdout__.buffer.flush()
"""


class Forking:
    """In place of `subprocess` in `levkas.readers.raw`: the decoder without its second of starting."""

    DEVNULL, PIPE = subprocess.DEVNULL, subprocess.PIPE
    TimeoutExpired, count, seconds = subprocess.TimeoutExpired, 0, 0.0

    def __init__(self):
        command = [sys.executable, "-c", FORKING, str(raw.PROGRAM)]
        self.server = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def run(self, command, **options):
        self.count += 1
        if self.count % STARTED_WHOLE == 0:
            return subprocess.run(command, **options)
        self.server.stdin.write(f"{command[-2]}|{command[-1]}\n".encode())
        self.server.stdin.flush()
        status, used, length = struct.unpack(">idI", self.server.stdout.read(16))
        self.seconds += used
        return subprocess.CompletedProcess(command, status, self.server.stdout.read(length))


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
        raw.subprocess = subprocess


def fuzz(corpus, seconds, seed):
    """Change and read files of a corpus in turn, and print what came of it."""
    rng = np.random.default_rng(seed)
    runs, came, ways, odd, most = Counter(), Counter(), {}, {}, (0.0, "")
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        for number in range(sys.maxsize):
            if time.perf_counter() - started > seconds:
                break
            name, data, beside = corpus[number % len(corpus)]
            path, made, kind = Path(folder) / name, changed(data, rng), judging.reader_of(name)
            for other, content in beside.items():
                (Path(folder) / other).write_bytes(content)
            path.write_bytes(made)
            what, refusals, wrong, used = timed(path)
            runs[kind] += 1
            came[kind, what] += 1
            ways.setdefault(kind, set()).update(refusals)
            most = max(most, (used, name))
            if wrong:
                odd.setdefault((name, wrong), made[:300])
    for kind in runs:
        print(
            f"{kind:9} {runs[kind]:7} runs, {came[kind, 'read']:7} read, "
            f"{came[kind, 'refused']:7} refused in {len(ways[kind])} ways"
        )
    print(
        f"{runs.total()} runs in {seconds:g} s from seed {seed}; most processor time {most[0]:.2f} s "
        f"({most[1]}); {len(odd)} that were neither"
    )
    for (name, wrong), made in odd.items():
        print(f"--- {name}: {wrong}\n{made!r}")
    return len(odd)


def timed(path):
    """Judge a file, with the processor time that it took, that of forked decoders too."""
    before = judging.processor_s(), getattr(raw.subprocess, "seconds", 0.0)
    what, refusals, wrong = judging.judge(path)
    forked = getattr(raw.subprocess, "seconds", 0.0) - before[1]
    used = judging.processor_s() - before[0] + forked
    if not wrong and used > judging.SLOW_S:
        wrong = "slow"
        print(f"slow: {path.name}, {used:.1f} s of processor time", flush=True)
    return what, refusals, wrong, used


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    logging.disable(logging.ERROR)  # tifffile tells of every tag that it leaves out
    given = [float(n) for n in sys.argv[1:]] + [180.0, 0][len(sys.argv) - 1 :]
    sys.exit(1 if main(given[0], int(given[1])) else 0)
