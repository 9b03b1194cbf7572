"""What do the uncertainty budget and the comparison of cameras cost? CPU time of their functions over that of a build in one process.

    python benchmarks/budget_cost.py CAMPAIGN OUTPUT [--results FILE]

At most so much: what other threads compute while a function runs counts as its time, too.
"""

import argparse
import functools
import time
from collections import Counter
from pathlib import Path

from results import add_option, record

import levkas.building.report_pages as report_pages
import levkas.stages.exposures as exposures
from levkas.building.run import build

WATCHED = {
    exposures: ("_with_lamp", "_note_shares"),
    report_pages: ("_agreement", "_budget_of", "describe_agreement"),
}


def watch(module, name, spent):
    """Add the CPU time of a function of a module to what is spent."""
    function = getattr(module, name)

    @functools.wraps(function)
    def watched(*given, **options):
        start = time.process_time()
        try:
            return function(*given, **options)
        finally:
            spent[name] += time.process_time() - start

    setattr(module, name, watched)


def main():
    """Build a campaign into a new folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("campaign", type=Path)
    parser.add_argument("output", type=Path)
    add_option(parser)
    options = parser.parse_args()
    spent = Counter()
    for module, names in WATCHED.items():
        for name in names:
            watch(module, name, spent)
    for step in build(options.campaign, output=options.output, workers=0):
        if step.state in ("refused", "failed"):
            raise SystemExit("\n".join(map(str, step.problems)))
    total = time.process_time()
    for name, seconds in spent.most_common():
        print(f"{name:20} {seconds:7.2f} s {100 * seconds / total:6.2f} %")
    share = 100 * sum(spent.values()) / total
    print(f"of {total:.1f} s: {share:.2f} %")
    record(
        options.results,
        "speed",
        {"budget, share of CPU": share},
    )


if __name__ == "__main__":
    main()
