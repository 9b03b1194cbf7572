"""Write tests/durations.json, seconds of each test file, from what pytest printed: python tests/record_durations.py LOG

LOG is the output of a whole run with `--durations=0 -vv`, of any number of processes. conftest.py starts the longest files
first, so that no process idles at the end; files below a second need no entry.
"""

import json
import re
import sys
from collections import Counter
from pathlib import Path

ROW = re.compile(r"\s*([\d.]+)s (?:call|setup|teardown)\s+(\S+?)::")


def main() -> None:
    """Add up the rows of a log by file."""
    seconds: Counter[str] = Counter()
    for line in Path(sys.argv[1]).read_text(encoding="utf-8").splitlines():
        if found := ROW.match(line):
            seconds[found[2]] += float(found[1])
    kept = {name: round(spent) for name, spent in seconds.most_common() if spent >= 1}
    target = Path(__file__).with_name("durations.json")
    target.write_text(json.dumps(kept, indent=0) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
