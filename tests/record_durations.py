"""Write tests/durations.json, seconds of each test file, by which conftest.py starts the longest first.

    python -m pytest -n 2 --dist loadfile -m "not exhaustive" --junitxml times.xml
    python tests/record_durations.py times.xml

Prints the longest files and tests. Files below a second need no entry.
"""

import json
import sys
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]


def file_of(classname: str) -> str:
    """Return the file of a test's dotted name, that of its class left off."""
    parts = classname.split(".")
    while parts and not (ROOT / "/".join(parts)).with_suffix(".py").is_file():
        parts.pop()
    return "/".join(parts) + ".py"


if __name__ == "__main__":
    files: Counter[str] = Counter()
    tests: Counter[str] = Counter()
    for case in ElementTree.parse(sys.argv[1]).iter("testcase"):
        took, file = float(case.get("time", 0)), file_of(case.get("classname", ""))
        files[file] += took
        tests[f"{file}::{case.get('name', '')[:60]}"] += took
    kept = {name: round(took) for name, took in files.most_common() if took >= 1}
    target = ROOT / "tests/durations.json"
    target.write_text(json.dumps(kept, indent=0) + "\n", encoding="utf-8")
    for name, took in [*files.most_common(30), *tests.most_common(40)]:
        print(f"{took:7.1f} s  {name}")
