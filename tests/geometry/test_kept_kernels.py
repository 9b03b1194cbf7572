"""Numba's cache sees only the file of a kernel; a digest of the others that it inlines stands there."""

import hashlib
import re
from pathlib import Path

import levkas

FOLDER = Path(levkas.__file__).parent
INLINED = ("double_lanes", "lanes", "squares", "taps", "words")
IMPORTS = re.compile(rf"^from levkas\.({'|'.join(INLINED)}) import", re.M)


def inlined(path: Path) -> set[str]:
    """The files of `INLINED` that a module imports, and what these import."""
    found = set(IMPORTS.findall(path.read_text(encoding="utf-8")))
    return found.union(*(inlined(FOLDER / f"{name}.py") for name in found))


def test_kept_machine_code_is_dropped_where_what_it_inlines_changed():
    modules = [p for p in sorted(FOLDER.rglob("*.py")) if p.stem not in INLINED and inlined(p)]
    assert {p.stem for p in modules} >= {"warping_kernels", "wide_kernels", "deflating"}
    for path in modules:
        files = [(FOLDER / f"{name}.py").read_bytes() for name in sorted(inlined(path))]
        digest = hashlib.sha256(b"".join(files)).hexdigest()[:16]
        assert f'\nHELPERS = "{digest}"\n' in path.read_text(encoding="utf-8"), (path.name, digest)
