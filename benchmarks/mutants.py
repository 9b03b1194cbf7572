"""Planted faults: a line of the package is made wrong, and the tests have to say so.

    python benchmarks/mutants.py [NAME...] [--whole] [-o JSON]

Each fault is one replacement of text in a copy of the package; the tests of its row run in that copy and have to fail.
With ``--whole`` a fault that they do not find is tried with all fast tests. Ends with 1 where a fault is found by none,
or where its text stands no longer once in its file: then the row has to follow the code.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]


class Fault(NamedTuple):
    """A wrong line: in which file of the package, what stands there, what is put in its place, which tests have to find it."""

    path: str
    right: str
    wrong: str
    tests: str


FAULTS = {
    # calibration: values
    "dark is added": Fault(
        "calibration/flatfield.py",
        "np.nan if lost else signal / light * factor[x]",
        "np.nan if lost else (signal + 2 * back[x]) / light * factor[x]",
        "tests/calibration",
    ),
    "white without its dark": Fault(
        "calibration/flatfield.py",
        "np.nan if lost else signal / light * factor[x]",
        "np.nan if lost else signal / lit[x] * factor[x]",
        "tests/calibration",
    ),
    "white's exposure upside down": Fault(
        "calibration/flatfield.py",
        "ratio = white.exposure_s / shot.exposure_s",
        "ratio = shot.exposure_s / white.exposure_s",
        "tests/calibration",
    ),
    "saturated white is no flag": Fault(
        "calibration/flatfield.py",
        "SATURATED if full[x] | lit_full[x] else",
        "SATURATED if full[x] else",
        "tests/calibration",
    ),
    "saturation needs one code more": Fault(
        "calibration/templates.py",
        "saturated[y, x] |= np.float32(frame[y, x]) >= high",
        "saturated[y, x] |= np.float32(frame[y, x]) > high",
        "tests/calibration",
    ),
    "dark of another time is not scaled": Fault(
        "calibration/darks.py",
        "mean = (black + (dark.mean - np.float32(black)) * np.float32(scale))",
        "mean = (black + (dark.mean - np.float32(black)))",
        "tests/calibration",
    ),
    "dark on the line, ends swapped": Fault(
        "calibration/darks.py",
        "mean = (1 - part) * first.mean + part * second.mean",
        "mean = part * first.mean + (1 - part) * second.mean",
        "tests/calibration",
    ),
    "demosaicing looks one row off": Fault(
        "calibration/mosaic.py",
        "return int(self.table[(self.y + dy) % rows, (self.x + dx) % columns])",
        "return int(self.table[(self.y + dy + 1) % rows, (self.x + dx) % columns])",
        "tests/calibration",
    ),
    "Malvar's mask is not turned": Fault(
        "calibration/mosaic.py",
        "mask = COLOUR_IN_ITS_ROW if in_row else COLOUR_IN_ITS_ROW.T",
        "mask = COLOUR_IN_ITS_ROW",
        "tests/calibration",
    ),
    "defect is kept as it is": Fault(
        "calibration/defects.py",
        "values[at] = (some[each, (whole - 1) // 2] + some[each, whole // 2]) / 2",
        "values[at] = values[at]",
        "tests/calibration",
    ),
    "median of defects takes an end": Fault(
        "calibration/defects.py",
        "values[at] = (some[each, (whole - 1) // 2] + some[each, whole // 2]) / 2",
        "values[at] = some[each, whole - 1]",
        "tests/calibration",
    ),
    "merged exposures, times forgotten": Fault(
        "calibration/exposures.py",
        "total[y, x] += weight * signal / time",
        "total[y, x] += weight * signal",
        "tests/calibration",
    ),
    # calibration: sigma
    "variance of the white is dropped": Fault(
        "calibration/flatfield.py",
        "total = own + below + r * r * (of_lit + beside)",
        "total = own + below + r * r * beside",
        "tests/calibration",
    ),
    "variance scales by the first power": Fault(
        "calibration/flatfield.py",
        "total * (factor[x] / light) ** 2 if",
        "total * (factor[x] / light) if",
        "tests/calibration",
    ),
    "common dark counts twice": Fault(
        "calibration/flatfield.py",
        "total -= 2.0 * r * common",
        "total += 2.0 * r * common",
        "tests/calibration",
    ),
    "mean of n shots is as noisy as one": Fault(
        "calibration/flatfield.py",
        "shots.variance, freedom, 1.0 / shots.count, width)",
        "shots.variance, freedom, 1.0, width)",
        "tests/calibration",
    ),
    "sample variance over n": Fault(
        "calibration/templates.py",
        "freedom = count * (count - 1.0)",
        "freedom = count * (count + 0.0)",
        "tests/calibration",
    ),
    "weights of sigma are not squared in a mosaic": Fault(
        "calibration/mosaic.py",
        "squares[j] += w * w * variance",
        "squares[j] += w * variance",
        "tests/calibration",
    ),
    "shot noise without its gain": Fault(
        "calibration/noise_fit.py",
        "return self.read_variance + self.gain * np.maximum(signal, 0.0)",
        "return self.read_variance + np.maximum(signal, 0.0)",
        "tests/calibration",
    ),
    "budget adds instead of squares": Fault(
        "calibration/error_sources.py",
        "squares[name] = squares.get(name, 0.0) + np.square(row)",
        "squares[name] = squares.get(name, 0.0) + row",
        "tests/calibration tests/promises",
    ),
    "noise model of Eq. 2 without PRNU": Fault(
        "calibration/noise_model.py",
        "shot = e * (1 + sensor.prnu**2) + (sensor.prnu * e) ** 2",
        "shot = e * (1 + sensor.prnu**2)",
        "tests/calibration src/levkas/calibration/noise_model.py",
    ),
    "motion compares nothing": Fault(
        "calibration/motion.py",
        "ratio, period) > _limit(stack.count - 1)",
        "ratio, period) > np.inf",
        "tests/calibration",
    ),
    # geometry
    "grid is half a pixel off": Fault(
        "geometry/grid.py",
        "crop[:2, 2] = step_x / 2 - 0.5 + x, step_y / 2 - 0.5 + y",
        "crop[:2, 2] = step_x / 2 + x, step_y / 2 + y",
        "tests/geometry",
    ),
    "rotation the other way": Fault(
        "geometry/grid.py",
        "turn = np.array([[c, -s], [s, c]])",
        "turn = np.array([[c, s], [-s, c]])",
        "tests/geometry",
    ),
    "mirror is off by one": Fault(
        "geometry/grid.py",
        "flip = np.array([[-1.0, 0, width - 1], [0, 1, 0], [0, 0, 1]])",
        "flip = np.array([[-1.0, 0, width], [0, 1, 0], [0, 0, 1]])",
        "tests/geometry",
    ),
    "scaling about corners": Fault(
        "geometry/transforms.py",
        "return cls(np.column_stack([np.diag(s), s / 2 - 0.5]))",
        "return cls(np.column_stack([np.diag(s), 0 * s]))",
        "tests/geometry",
    ),
    "lens swaps its tangential terms": Fault(
        "geometry/transforms.py",
        "(k1, k2), (p1, p2) = self.radial, self.tangential\n        r2 = u * u + v * v\n        gain = 1",
        "(k1, k2), (p2, p1) = self.radial, self.tangential\n        r2 = u * u + v * v\n        gain = 1",
        "tests/geometry src/levkas/geometry/transforms.py",
    ),
    "jacobian is transposed": Fault(
        "geometry/transforms.py",
        "x, y = right.T\n    with",
        "y, x = right.T\n    with",
        "tests/geometry",
    ),
    "cubic kernel of OpenCV": Fault(
        "geometry/resample_kernels.py",
        "F(t * ((-0.5 * t + 1.0) * t - 0.5))",
        "F(t * ((-0.75 * t + 1.5) * t - 0.75))",
        "tests/geometry",
    ),
    "flags of other bands are lost": Fault(
        "geometry/resample_kernels.py",
        "out[row, x, b] |= flags[y0 + r, x0 + k, b]",
        "out[row, x, b] = flags[y0 + r, x0 + k, b]",
        "tests/geometry",
    ),
    # registration
    "outliers: the best match leaves": Fault(
        "registration/outliers.py",
        "j = int(np.argmax(error >= max(worst - TIE_PX, 0.0) ** 2))",
        "j = int(np.argmin(error))",
        "tests/registration -k outlier",
    ),
    "ratio test the other way": Fault(
        "registration/matching.py",
        '"ratio": lambda f, ratio: f.distance < ratio * f.second,',
        '"ratio": lambda f, ratio: f.distance >= ratio * f.second,',
        "tests/registration -k match",
    ),
    "matches that predict nothing are enough": Fault(
        "registration/verdict.py",
        "return error / e.tolerance if scattered or error > e.tolerance else 0.0",
        "return 0.0",
        "tests/registration -k verdict",
    ),
    "few agreeing windows are enough": Fault(
        "registration/verdict.py",
        "return 1.0 if enough and everywhere else e.off_share",
        "return 0.0",
        "tests/registration",
    ),
    "richest model always": Fault(
        "registration/model_selection.py",
        "self._gain(self.best.missed, found.missed) > STANDARD_ERRORS",
        "self._gain(self.best.missed, found.missed) > -STANDARD_ERRORS",
        "tests/registration",
    ),
    "chromatic shift has the wrong sign": Fault(
        "registration/chromatic.py",
        "coefficients[1:3] += self.spread * np.eye(2)",
        "coefficients[1:3] -= self.spread * np.eye(2)",
        "tests/registration -k magnifications",
    ),
    # database
    "pixel frames: inverse goes forward": Fault(
        "database/pixel_frames.py",
        "self.source.inside(points), self.source.from_reference.inverse)",
        "self.source.inside(points), self.source.from_reference)",
        "tests/database",
    ),
    "crop is taken for none": Fault(
        "database/accessor.py",
        "return slice(int(places[0]), int(places[-1]) + 1, int(steps[0]))",
        "return slice(0, int(places[-1] - places[0]) + 1, int(steps[0]))",
        "tests/database/test_crops.py",
    ),
    "descending wavelengths stay": Fault(
        "database/spectral_tiff.py", "if centres[0] > centres[-1]:", "if False:", "tests/database"
    ),
    "hashes are not compared": Fault(
        "database/validation.py",
        "if key in listed and found[key] != listed[key].sha256]",
        "if False]",
        "tests/database",
    ),
    "sizes are not compared": Fault(
        "database/validation.py",
        "elif size != file.size:",
        "elif False:",
        "tests/database",
    ),
    "manifest may be cut": Fault(
        "database/manifest.py",
        "if hashlib.sha256(body).hexdigest() != stated[3]:",
        "if False:",
        "tests/database",
    ),
    "short strip is read": Fault(
        "database/tiff_pages.py",
        "if len(data) != page.databytecounts[number]:",
        "if False:",
        "tests/database",
    ),
    # core
    "written under its own name": Fault(
        "core/files.py",
        "partial = _partial(path)\n            if folder",
        "partial = path\n            if folder",
        "tests/core",
    ),
    "name leads out of the folder": Fault(
        "core/files.py",
        'if Path(name).is_absolute() or ".." in Path(name).parts:',
        "if Path(name).is_absolute():",
        "tests/core",
    ),
    "half of what goes together": Fault(
        "core/files.py",
        "one.drop()  # nothing, where it has its name",
        "pass",
        "tests/core",
    ),
    "nothing is synced": Fault(
        "core/files.py",
        'fault("fsync", path)\n            os.fsync(handle.fileno())',
        "pass",
        "tests/core",
    ),
    # campaign and readers
    "milliseconds are seconds": Fault(
        "campaign/discovery/patterns.py",
        "SECONDS[exposure_unit(self.text)]",
        "1.0",
        "tests/campaign",
    ),
    "longer number's tail is a wavelength": Fault(
        "campaign/discovery/patterns.py",
        r'_NUMBER = r"(?<!\d)(?<!\d\.)\d+(?:\.\d+)?(?!\d)"',
        r'_NUMBER = r"\d+(?:\.\d+)?"',
        "tests/campaign",
    ),
    "unknown keys are taken": Fault(
        "campaign/schema/tables.py",
        'model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)',
        'model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)',
        "tests/campaign",
    ),
    "another ISO is the same": Fault(
        "readers/compared_facts.py",
        'return "same" if max(a, b) <= most * min(a, b) else "refused"',
        'return "same"',
        "tests/readers tests/calibration tests/building/test_facts.py",
    ),
    "other wavelengths are the same": Fault(
        "readers/compared_facts.py",
        'return "same" if np.allclose(a, b, rtol=0, atol=NEAREST_NM) else "refused"',
        'return "same"',
        "tests/readers tests/building/test_facts.py",
    ),
    "big-endian cube is read as it is": Fault(
        "readers/envi.py",
        "out = out.byteswap(inplace=True).view(dtype.newbyteorder())",
        "out = out.view(dtype.newbyteorder())",
        "tests/readers",
    ),
    # building
    "fingerprint misses the cameras' keys": Fault(
        "building/inputs.py",
        "prints = read_by((CALIBRATE, LIGHT, NATIVE), campaign, capture, hashes)",
        "prints = {}",
        "tests/building/test_staleness.py",
    ),
    "fingerprint misses the frames": Fault(
        "building/inputs.py",
        'prints |= {f"file {path}": content for path, content in files.items()}',
        "pass",
        "tests/building/test_staleness.py",
    ),
    "white's reflectance is no input": Fault(
        "building/inputs.py",
        "if board or not path",
        "if not path",
        "tests/building/test_staleness.py",
    ),
    # workbench and publication
    "token is not asked for": Fault(
        "workbench/server/guard.py",
        'if scope["path"] not in OPEN and not self._knows(headers):',
        "if False:",
        "tests/workbench",
    ),
    "any host is answered": Fault(
        "workbench/server/guard.py",
        'if headers.get("host", [""]) not in ([host] for host in self.hosts):',
        "if False:",
        "tests/workbench",
    ),
    "another site may write": Fault(
        "workbench/server/guard.py",
        'if foreign or (scope["method"] not in SAFE and not origins and not sites):',
        "if False:",
        "tests/workbench",
    ),
    "person is an organisation": Fault(
        "publish/crate.py",
        '"Organization" if person.organisation else "Person"',
        '"Person" if person.organisation else "Organization"',
        "tests/publish",
    ),
    "IIIF tiles in the wrong column": Fault(
        "publish/iiif.py",
        "x, y = column * reach, row * reach",
        "x, y = row * reach, column * reach",
        "tests/publish",
    ),
    "ENVI export without wavelengths": Fault(
        "publish/export/envi.py",
        "if layer.wavelengths:\n        lines.append",
        "if False:\n        lines.append",
        "tests/export",
    ),
    # colour, simulation, estimation, planning, quality
    "sRGB without its knee": Fault(
        "colour/srgb.py",
        "curve = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** np.float32(1 / 2.4) - 0.055)",
        "curve = 1.055 * x ** np.float32(1 / 2.4) - 0.055",
        "tests/colour",
    ),
    "Planck's law without its power": Fault(
        "colour/illuminants.py",
        "return (560 / w) ** 5 * (",
        "return (560 / w) ** 4 * (",
        "tests/colour src/levkas/colour/illuminants.py",
    ),
    "depth of field over one magnification": Fault(
        "planning/framing.py",
        "return 2 * f_number * blur_mm * (1 + m) / m**2",
        "return 2 * f_number * blur_mm * (1 + m) / m",
        "tests/planning src/levkas/planning/framing.py",
    ),
    "safe exposure without its drift": Fault(
        "planning/exposure_levels.py",
        "share = 1 / ((1 + z * noise) * (1 + unevenness / 2) * (1 + DRIFT))",
        "share = 1 / (1 + z * noise)",
        "tests/planning",
    ),
    "edge's own sampling is left in": Fault(
        "quality/image_quality/slanted_edge.py",
        "return np.asarray(found[resolved] / found[0] / (np.sinc(f / 2) * np.sinc(f / 4)))",
        "return np.asarray(found[resolved] / found[0])",
        "tests/quality",
    ),
    "errors in target pixels": Fault(
        "quality/evaluation/similarity.py",
        "return np.asarray(np.linalg.norm(transform.inverse(target) - reference, axis=1))",
        "return np.asarray(np.linalg.norm(transform(reference) - target, axis=1))",
        "tests/quality tests/building",
    ),
    "simulated cameras stand askew": Fault(
        "simulation/cameras.py",
        "return np.column_stack([linear, middle - linear @ middle + sensor.shifted])",
        "return np.column_stack([linear, middle + sensor.shifted])",
        "tests/simulation",
    ),
    "RMSE without its root": Fault(
        "estimation/metrics.py",
        "return np.asarray(np.sqrt(np.square(estimated - measured).mean(-1)))",
        "return np.asarray(np.square(estimated - measured).mean(-1))",
        "tests/estimation src/levkas/estimation/metrics.py",
    ),
}


def plant(fault: Fault, source: Path) -> str:
    """Write a fault into a copy of the sources; return what is wrong with its row, if anything."""
    path = source / "levkas" / fault.path
    if not path.is_file():
        return f"{fault.path} is no file"
    text = path.read_text(encoding="utf-8")
    if text.count(fault.right) != 1:
        return f"stands {text.count(fault.right)} times in {fault.path}: {fault.right}"
    path.write_text(text.replace(fault.right, fault.wrong), encoding="utf-8")
    return ""


def run_tests(source: Path, tests: list[str], room: Path) -> str:
    """Run tests against a copy of the sources; return the name of the first that fails, or nothing."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "--no-header",
        "-m",
        "not slow and not exhaustive",
    ]
    command += ["-p", "no:cacheprovider", "--import-mode=importlib", f"--rootdir={room}"]
    code = {**os.environ, "PYTHONPATH": str(source), "NUMBA_CACHE_DIR": str(room / "kernels")}
    done = subprocess.run(
        [*command, *tests], cwd=room, env=code, capture_output=True, text=True, check=False
    )
    if done.returncode == 0:
        return ""
    named = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    if done.returncode == 5 or not named:
        sys.exit(
            f"{' '.join(tests)}: exit status {done.returncode}\n{done.stdout[-2000:]}{done.stderr[-1000:]}"
        )
    return named[0].partition(" - ")[0]


def lay_out(room: Path) -> Path:
    """Copy what the tests need; return the folder of the sources."""
    for name in ("src", "tests", "benchmarks", "docs", "examples", "paper"):
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, room / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("conftest.py", "pyproject.toml", "README.md", "Makefile"):
        shutil.copyfile(ROOT / name, room / name)
    if (ROOT.parent / "shared").exists():
        (room.parent / "shared").symlink_to(ROOT.parent / "shared")
    return room / "src"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="faults to plant; all without one")
    parser.add_argument(
        "--whole",
        action="store_true",
        help="try all fast tests where those of the row find nothing",
    )
    parser.add_argument("-o", "--output", type=Path, help="JSON: which test found each fault")
    given = parser.parse_args()
    found: dict[str, str] = {}
    missed = 0
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        room = Path(folder) / "levkas"
        source = lay_out(room)
        for name in given.names or FAULTS:
            fault, start = FAULTS[name], time.perf_counter()
            path = source / "levkas" / fault.path
            kept = path.read_bytes() if path.is_file() else b""
            if wrong := plant(fault, source):
                print(f"! {name}: {wrong}", flush=True)
                missed += 1
                continue
            here = fault.tests.split()
            here = [t for t in here if not t.startswith(("tests/", "src/")) or (room / t).exists()]
            test = run_tests(source, here, room)
            if not test and given.whole:
                test = run_tests(source, ["tests"], room)
            path.write_bytes(kept)
            found[name], missed = test, missed + (not test)
            print(
                f"{' ' if test else '!'} {name}: {test or 'found by no test'}; {time.perf_counter() - start:.0f} s",
                flush=True,
            )
    if given.output:
        given.output.write_text(json.dumps(found, indent=1), encoding="utf-8")
    print(
        f"{len(found) - sum(not t for t in found.values())} of {len(given.names or FAULTS)} planted faults are found"
    )
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
