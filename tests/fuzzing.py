"""Let coverage choose the bytes: atheris spoils small files, each reader in a process of its own.

    python tests/fuzzing.py [SECONDS] [READER …]

SECONDS (20) a reader; files and readers are those of tests/readers/small_files.py and judging.py (all but camera
raw, whose decoder is another program). atheris is the extra `fuzz`, `make fuzz` makes an environment of it; where it
is not there this is said, and nothing fails. What a run complains of is judged once more in a process
without atheris, which slows a reader several times, and printed if it is still so.
"""

import contextlib
import importlib
import json
import logging
import pkgutil
import re
import subprocess
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path

HERE = Path(__file__).resolve().parent / "readers"
sys.path.insert(0, str(HERE))
SECONDS, SEED, LONGEST = 20, 1, 1 << 16
MODULES = (
    "levkas.readers", "levkas.registration.control_points", "levkas.campaign.schema", "levkas.campaign.discovery",
    "levkas.campaign.campaign", "levkas.campaign.edits", "levkas.stages.spectra", "levkas.planning.spectra",
    "levkas.planning.setup", "levkas.quality.targets.charts", "tifffile.tifffile", "exifread", "tomllib._parser",
    "json.decoder",
)  # fmt: skip
"""Those whose branches count."""
FLAGS = ("-timeout=1200", "-rss_limit_mb=4096", f"-max_len={LONGEST}", "-print_final_stats=1")
"""`judging` counts processor time; a process that only had to wait is no finding."""


def spoil(reader, folder):
    """Fuzz one reader for ever; what came is written to the folder, libFuzzer ends the process."""
    import atheris

    with atheris.instrument_imports(include=[name.split(".")[0] for name in MODULES]):
        for name in MODULES:
            import_all(name)
    import judging
    from small_files import seeds

    names = [(n, beside) for n, _, beside in seeds() if judging.reader_of(n) == reader]
    came, ways, found = Counter(), set(), {}
    for _, beside in names:
        for other, content in beside.items():
            (folder / other).write_bytes(content)

    def once(data):
        # The last byte picks the name, where one reader has several kinds of files.
        path = folder / names[data[-1] % len(names) if data and len(names) > 1 else 0][0]
        path.write_bytes(data[:-1] if len(names) > 1 else data)
        what, refusals, wrong = judging.judge(path)
        came[what] += 1
        ways.update(refusals)
        if wrong and (kind := re.sub(r"\d+", "0", f"{path.name} {wrong}")) not in found:
            found[kind] = wrong
            (folder / f"found-{len(found)}").mkdir()
            keep(folder / f"found-{len(found)}" / path.name, path, names)
        if came.total() % 100 == 0 or wrong:
            record = {"came": came, "ways": len(ways), "found": len(found)}
            (folder / "record.json").write_text(json.dumps(record))

    atheris.Setup([sys.argv[0], *sys.argv[4:]], once)
    atheris.Fuzz()


def import_all(name):
    """Import a module, or a package with all that is in it."""
    module = importlib.import_module(name)
    for inner in pkgutil.iter_modules(getattr(module, "__path__", ()), f"{name}."):
        with contextlib.suppress(ImportError):
            importlib.import_module(inner.name)


def keep(to, path, names):
    """Keep a file with those that belong to it."""
    to.write_bytes(path.read_bytes())
    for name, beside in names:
        for other in beside if name == path.name else ():
            (to.parent / other).write_bytes(path.with_name(other).read_bytes())


def run(reader, seconds):
    """Fuzz one reader for some seconds; print a row, and return how many files are judged wrong."""
    import judging
    from small_files import seeds

    with tempfile.TemporaryDirectory() as room:
        folder, corpus = Path(room) / "files", Path(room) / "corpus"
        folder.mkdir()
        corpus.mkdir()
        every = [(n, data) for n, data, _ in seeds() if judging.reader_of(n) == reader]
        for number, (_, data) in enumerate(every):
            tail = bytes([number]) if len(every) > 1 else b""
            (corpus / str(number)).write_bytes(data + tail)
        limits = [
            "-seed=" + str(SEED),
            f"-max_total_time={seconds}",
            f"-artifact_prefix={room}/died-",
        ]
        command = [sys.executable, __file__, "--one", reader, str(folder), *FLAGS, *limits]
        done = subprocess.run([*command, str(corpus)], capture_output=True, text=True, check=False)
        record = {"came": {}, "ways": 0}
        with contextlib.suppress(OSError, ValueError):
            record = json.loads((folder / "record.json").read_text())
        covered = re.findall(r"cov: (\d+)", done.stderr)
        ran = re.findall(r"number_of_executed_units: (\d+)", done.stderr)
        came = record["came"]
        row = [
            *ran[-1:],
            came.get("read", 0),
            came.get("refused", 0),
            record["ways"],
            *covered[-1:],
        ]
        wrong = [line for path in sorted(folder.glob("found-*")) if (line := confirmed(path))]
        if done.returncode:
            died = [path.read_bytes()[:4000] for path in Path(room).glob("died-*")]
            wrong.append(f"the process ended with {done.returncode}: {died}\n{done.stderr[-1500:]}")
    print(
        f"{reader:9}" + "".join(f"{number:>9}" for number in row) + f"{len(wrong):>9}", flush=True
    )
    for line in wrong:
        print(f"--- {line}")
    return len(wrong)


def confirmed(folder):
    """Judge a file that was kept once more, without atheris; return what is wrong with it."""
    reads = "import judging, pathlib, sys; p = pathlib.Path(sys.argv[1]); judging.warm(p); print(judging.judge(p)[2])"
    for path in sorted(folder.iterdir()):
        if path.name.split(".")[1:2] == ["target"] or path.suffix == ".raw":
            continue
        command = [sys.executable, "-c", reads, str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=HERE)
        wrong = done.stdout.strip() or done.stderr.strip()[-200:]
        if wrong:
            return f"{path.name}: {wrong}\n{path.read_bytes()[:600]!r}"
    return ""


def main(seconds, readers):
    """Fuzz readers in turn; return how many files were judged wrong."""
    try:
        import atheris  # noqa: F401
    except ImportError:
        print("atheris is not here, so nothing was spoilt under its guidance: `make fuzz` gets it.")
        return 0
    import judging

    heads = ("runs", "read", "refused", "ways", "covered", "wrong")
    print(f"{'reader':9}" + "".join(f"{head:>9}" for head in heads), flush=True)
    return sum(run(r, seconds) for r in readers or [k for k in judging.READERS if k != "raw"])


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    logging.disable(logging.ERROR)  # tifffile tells of every tag that it leaves out
    if sys.argv[1:2] == ["--one"]:
        spoil(sys.argv[2], Path(sys.argv[3]))
    else:
        numbers = [int(a) for a in sys.argv[1:] if a.isdecimal()]
        chosen = [a for a in sys.argv[1:] if not a.isdecimal()]
        sys.exit(1 if main((numbers or [SECONDS])[0], chosen) else 0)
