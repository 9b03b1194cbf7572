"""The bench of the paper, and ways to write it differently."""

from pathlib import Path

import pytest

BENCH = Path(__file__).resolve().parents[2] / "examples" / "plan"


@pytest.fixture(scope="session")
def bench():
    from levkas.planning import load_setup

    return load_setup(BENCH)


@pytest.fixture
def rewritten(tmp_path):
    """Return a function that writes the bench with texts replaced, and returns its path."""

    def write(*changes, cut_cameras=False):
        text = (BENCH / "bench.toml").read_text(encoding="utf-8")
        for old, new in changes:
            assert old in text, old
            text = text.replace(old, new, 1)
        if cut_cameras:
            start = text.index("[cameras.d80]")
            text = text[:start]
        for table in BENCH.glob("*.csv"):
            (tmp_path / table.name).write_bytes(table.read_bytes())
        path = tmp_path / "bench.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def refusal(path):
    """Return the problems with which a setup file is refused."""
    from levkas.planning import PlanRefused, load_setup

    with pytest.raises(PlanRefused) as refused:
        load_setup(path)
    return refused.value.problems
