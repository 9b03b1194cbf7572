"""Run every benchmark; each prints its own table. Long: the full-size build simulates 2.4 GB first."""

import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent

if __name__ == "__main__":
    failed = []
    for script in sorted(HERE.glob("*.py")):
        if script.name in ("run.py", "unchanged.py"):  # the latter compares two states of the code
            continue
        if "__main__" in script.read_text(encoding="utf-8"):
            print(f"== {script.stem}", flush=True)
            if subprocess.run([sys.executable, script], check=False).returncode:
                failed.append(script.name)
    sys.exit(f"failed: {', '.join(failed)}" if failed else 0)
