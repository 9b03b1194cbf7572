"""The first `levkas demo` on a machine: processor time, and what of it compiles the loops.

    python benchmarks/cold_start.py [--results benchmarks/results.json]

Runs `levkas demo` twice with a cache of compiled code that is empty at first, one thread. A loop counts
once for every kind of arguments that it is compiled for, those of numba's own library included.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from results import add_option, record

TIMED = """
import json, sys, threading, time
from numba.core import event

seconds, names, began = [], [], {}

class Listener(event.Listener):
    def on_start(self, happening):
        began.setdefault(threading.get_ident(), []).append(time.thread_time())

    def on_end(self, happening):
        function = happening.data["dispatcher"].py_func
        names.append(f"{function.__module__}.{function.__qualname__}")
        stack = began[threading.get_ident()]
        start = stack.pop()
        if not stack:  # what others are compiled within counts once
            seconds.append(time.thread_time() - start)

event.register("numba:compile", Listener())
from levkas.cli import main
try:
    main()
except SystemExit as ending:
    if ending.code:
        raise
found = {"compiling": sum(seconds), "names": names, "processor": time.process_time()}
open(sys.argv[-1] + ".json", "w").write(json.dumps(found))
"""


def run_demo(folder: Path, cache: Path) -> dict:
    """Return processor time, time to compile and names of what was compiled, of `levkas demo`."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "LEVKAS_THREADS": "1"}
    command = [sys.executable, "-c", TIMED, "demo", str(folder)]
    subprocess.run(
        command, env=environment, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    return json.loads(folder.with_name(folder.name + ".json").read_text())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    add_option(parser)
    results = parser.parse_args().results
    with tempfile.TemporaryDirectory() as place:
        cache = Path(place) / "cache"
        first, second = (run_demo(Path(place) / name, cache) for name in ("first", "second"))
    own = sum(name.startswith("levkas.") for name in first["names"])
    print(
        f"first  {first['processor']:6.1f} s of processor time, {first['compiling']:.1f} s compiling"
    )
    print(f"       {len(first['names'])} compilations, {own} of them of Levkas's own functions")
    print(f"second {second['processor']:6.1f} s, {len(second['names'])} compilations")
    record(
        results,
        "speed",
        {
            "first demo, compiling": first["compiling"],
            "first demo, CPU": first["processor"],
            "second demo, CPU": second["processor"],
        },
    )


if __name__ == "__main__":
    main()
