"""One trial in a process of its own: told on standard input, answered on standard output."""

from __future__ import annotations

import json
import os
import sys


def main() -> None:
    """Read a trial as JSON, run it, print its row as the last line."""
    out = os.dup(1)
    os.dup2(2, 1)  # what a library prints must not stand in the answer
    from levkas.core.problems import Refused
    from levkas.quality.comparison.trial import Trial, run_trial

    try:
        row = run_trial(Trial(**json.load(sys.stdin)))
    except (Refused, ImportError) as error:
        row = {"failure": f"{type(error).__name__}: {error}"}
    os.write(out, (json.dumps(row) + "\n").encode())


if __name__ == "__main__":
    main()
