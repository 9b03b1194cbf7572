"""Strike a small build at every step on the disk, and run it again: how often all is as it should be.

    python benchmarks/faults.py [EVERY] [KILLS] [PART …]

EVERY takes each so-many-th point only; KILLS is the number of processes that are really ended. Parts are the
scenes (new, over, withdrawn, joint), careless (the writer without temporary files) and power (the loss of it);
all. With full, failing or kill among them the disk, or the build, fails in those ways only.
"""

import importlib.util
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1] / "tests" / "building" / "test_faults.py"


def load():
    """Return the tests as a module: they have the scenes, the faults and the checks."""
    spec = importlib.util.spec_from_file_location("test_faults", TESTS)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def main(every=1, kills=20, parts=()):
    """Print a row for each scene and kind: points, whole after the fault, same bytes at the end."""
    faults, started = load(), time.perf_counter()
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        faults.hasten(patch)
        scenes = faults.make_scenes(Path(folder))
        print(f"{'scene':10} {'kind':8} {'points':>7} {'whole':>7} {'mended':>7} {'share':>7}")
        kinds = [kind for kind in faults.KINDS if kind in parts] or faults.KINDS
        parts = [part for part in parts if part not in kinds]
        chosen = {name: scene for name, scene in scenes.items() if not parts or name in parts}
        for name, scene in chosen.items():
            for kind in kinds:
                _row(name, kind, list(_all(faults, scene, kind, every)))
            share = [(n + 0.5) / kills for n in range(kills)]
            real = [faults.strike_for_real(scene, 1 + int(s * len(scene.steps))) for s in share]
            _row(name, "exit", [outcome for outcome in real if outcome.struck == ("exit", 9)])
        for name in ("new", "over") if not parts or "careless" in parts else ():
            writer = faults.write_carelessly
            struck = _all(faults, scenes[name], "kill", every, writer)
            _row(name, "careless", [o for o in struck if o.struck[0] == "write"], quiet=True)
        for name, scene in scenes.items() if not parts or "power" in parts else ():
            operations, wrong = faults.replay(scene)
            print(
                f"{name}: power lost after each of {operations} operations, {wrong.total()} wrong"
            )
            for missing in ("fsync", "sync", "syncfs"):
                wrong = faults.replay(scene, without=(missing,))[1].total()
                print(f"{name}: the same without {missing}, {wrong} wrong")
    print(f"{time.perf_counter() - started:.0f} s")


def _all(faults, scene, kind, every, writer=None):
    """Strike at each point until a build ends before it is struck."""
    at = 1
    while (outcome := faults.strike(scene, at, kind, writer=writer)).struck:
        yield outcome
        at += every


def _row(name, kind, outcomes, *, quiet=False):
    whole, mended = Counter(not o.torn for o in outcomes), Counter(not o.unmended for o in outcomes)
    share = sum(o.well for o in outcomes) / max(1, len(outcomes))
    print(f"{name:10} {kind:8} {len(outcomes):7} {whole[True]:7} {mended[True]:7} {share:7.1%}")
    for outcome in outcomes:
        if not outcome.well and not quiet:
            print(f"  {outcome}")
    sys.stdout.flush()


if __name__ == "__main__":
    main(*(int(n) for n in sys.argv[1:3]), parts=sys.argv[3:])
