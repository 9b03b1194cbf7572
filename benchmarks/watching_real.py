"""What does `levkas watch` say of real captures, and is it true?

    python benchmarks/watching_real.py [--results FILE]

Every folder of `$LEVKAS_REAL_DATA` (else ../shared/data) is a session, as it is guessed and as a campaign.toml declares it.
A finding counts as true where plain NumPy finds the same in the codes of the files, or tifffile in their tags: nothing of the
checks is used for it. Everything else is a false alarm.
"""

import argparse
import os
import tempfile
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import tifffile
from results import add_option, record

from levkas.workbench.watching import WatchedSession
from levkas.workbench.watching.cache import MeasureCache

DATA = Path(os.environ.get("LEVKAS_REAL_DATA", Path(__file__).parents[2] / "shared/data")).resolve()
GUESSED = (
    "filterwheel-disks", "silios-kinect", "rededge-5lens", "envi-linescan", "manuscript-8bands", "tiles-section",
    "three-filter-plates", "paintings", "unlike-pairs/day-night", "unlike-pairs/infrared-optical",
    "unlike-pairs/map-optical", "stain-landmarks/images", "stain-landmarks/lesions_", "stain-landmarks/rat-kidney_",
)  # fmt: skip
NINE = '[["B1", "B2", "B3"], ["B4", "B5", "B6"], ["B7", "B8", "B9"]]'
SILIOS = f'kind = "mosaic"\npattern = {NINE}\nbits = 8\nfiles = "silios-kinect/{{target}}/{{shot}}_multispectral_camera.png"'
DISKS = """kind = "bands"
pattern = "GBRG"
bits = 8
exposures = "one"
files = [
    "filterwheel-disks/frames/d1_{target}_{wavelength}nm_EXPOSURE_*.tif", "filterwheel-disks/dark/d1_{target}_EXPOSURE_*.tif"
]"""
DARK, FLAT = 'dark = "dark"', 'white = { names = "flat", reflectance = 1 }'
LENSES = "\n".join(
    ['kind = "sensors"', 'files = "rededge-5lens/IMG_{target}_{sensor}.tif"']
    + [f'[[cameras.cam.sensors]]\nname = "{k}"' for k in range(1, 6)]
)
BANDS = 'kind = "bands"\nbands = {}\nfiles = "{}"'
DECLARED = {
    **{f"disks, {ms} ms": (DISKS.replace("EXPOSURE", f"{ms}ms"), DARK) for ms in (25, 50, 100, 250, 500, 2000, 3916)},
    "disks, best of seven": (DISKS.replace('"one"', '"best"').replace("EXPOSURE", "{exposure}ms"), DARK),
    "mosaic of nine bands": (SILIOS, f"{DARK}\n{FLAT}"),
    "burst alone": (SILIOS, 'objects = ["burst"]'),
    "five lenses": (LENSES, 'objects = ["0000", "0001"]'),
    "five lenses, panel as white": (LENSES, 'white = { names = "0000", reflectance = 0.5 }\nobjects = ["0001"]'),
    "line scan": ('kind = "cube"\nfiles = "envi-linescan/{target}.hdr"',
                  'dark = "dark_reference_crop"\nwhite = { names = "white_reference_crop", reflectance = 0.99 }'),
    "manuscript": (BANDS.format([f"F{k}" for k in range(1, 9)], "{target}/{band}s.png"), 'objects = ["manuscript-8bands"]'),
    "tiles": (BANDS.format(["grey"], "tiles-section/{target}[Grid@{row} {column}].jpg"), 'objects = ["stitch2d_ex"]'),
    **{name: (BANDS.format(["pair1", "pair2"], "unlike-pairs/{target}/{band}.jpg"), f'objects = ["{name}"]')
       for name in ("day-night", "infrared-optical")},
}  # fmt: skip
PERIODS = {"silios": 3, "disks": 2}
"""Rows and columns of mosaics, by what their paths contain."""


def codes_of(path):
    """Return the codes of a frame, (h, w, bands), mosaics taken apart."""
    values = (
        tifffile.imread(path)
        if path.suffix == ".tif"
        else cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    )
    period = next((n for name, n in PERIODS.items() if name in str(path)), 1)
    h, w = (n // period * period for n in values.shape[:2])
    values = values[:h, :w].reshape(h, w, -1).astype(float)
    return np.concatenate(
        [values[y::period, x::period] for y in range(period) for x in range(period)], axis=2
    )


def is_true(frame, finding, frames):
    """Whether the files themselves show what a finding says of a frame."""
    path, text = frame.file.path, finding.text
    same = [
        f
        for f in frames
        if (f.file.camera, f.file.sensor) == (frame.file.camera, frame.file.sensor)
    ]
    codes = codes_of(path)
    top = 255.0 if codes.max() <= 255 else 65535.0
    if finding.check == "settings":  # of the two frames that are named
        other = next(f.file.path for f in same if f.file.name in text)
        values = [_iso(p) for p in (path, other)]
        return "ISO" in text and values[0] != values[1]
    if finding.check == "exposure" and "full scale" in text and "reaches" not in text:
        limit = 2e-4 if frame.file.role == "white" else 0.01
        return (codes >= top).mean((0, 1)).max() >= limit
    if finding.check == "exposure":
        return np.quantile(codes, 0.999) / top < 0.03
    if finding.check == "dark":
        return np.ptp(_coarse(codes)) / top > 0.005
    if (
        finding.check == "drift"
    ):  # against shot 0, outdoors, without darks: their level is below a tenth
        first = codes_of(next(f.file.path for f in same if f.file.shot == "0"))
        change = (codes.mean() - first.mean()) / (first.mean() - 8)
        return abs(change) > 0.01 and (change < 0) == ("less" in text)
    whites = [f for f in same if f.file.role == "white"]
    if finding.check in ("glare", "white") and frame.file.role == "object" and whites:
        white = codes_of(whites[0].file.path)
        darks = [codes_of(f.file.path) for f in same if f.file.role == "dark"]
        black = darks[0] if darks else 0
        share = ((codes - black) > 1.15 * (white - black)).mean((0, 1)).max()
        return share > (0.3 if finding.check == "white" else 0.01)
    if finding.check == "white" and ("not smooth" in text or "a picture" in text):
        cells = _coarse(codes)
        return cells.std() / cells.mean() > 0.15  # a lens shades by less
    return False


def _coarse(codes):
    return cv2.resize(codes.mean(2), (16, 12), interpolation=cv2.INTER_AREA)


def _iso(path):
    with tifffile.TiffFile(path) as file:
        return file.pages[0].tags["ExifTag"].value["ISOSpeed"]


def sessions(folder):
    """Yield names of sessions and their folders."""
    for name in GUESSED:
        yield f"{name}, guessed", DATA / name
    for k, (name, (camera, targets)) in enumerate(DECLARED.items()):
        home = folder / f"session{k}"
        home.mkdir()
        for source in DATA.iterdir():
            (home / source.name).symlink_to(source)
        head = '[campaign]\nreference = { camera = "cam" }\n[cameras.cam]\n'
        (home / "campaign.toml").write_text(f"{head}{camera}\n[targets]\n{targets}\n")
        yield name, home


def main():
    """Judge every session, and every finding of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_option(parser)
    options = parser.parse_args()
    total, alarmed, false = 0, 0, 0
    with tempfile.TemporaryDirectory() as folder:
        for k, (name, home) in enumerate(sessions(Path(folder))):
            state = WatchedSession(home, MeasureCache(Path(folder) / f"cache{k}")).settle(60)
            said, wrong = Counter(), 0
            for frame in state.frames:
                judged = [(is_true(frame, f, state.frames), f) for f in frame.findings]
                said.update(f"{f.check} ({f.severity})" for _, f in judged)
                wrong += any(not true for true, _ in judged)
                for _, finding in (pair for pair in judged if not pair[0]):
                    print(f"    FALSE {frame.file.name}: {finding.check}: {finding.text}")
            some = sum(bool(f.findings) for f in state.frames)
            total, alarmed, false = total + len(state.frames), alarmed + some, false + wrong
            words = ", ".join(f"{n} {what}" for what, n in sorted(said.items())) or "nothing"
            print(f"{name}: {len(state.frames)} frames; {words}; {wrong} false", flush=True)
    print(
        f"{total} frames of {len(GUESSED) + len(DECLARED)} sessions, {alarmed} with findings, {false} false"
    )
    record(options.results, "watching", {"false alarms, real": 100 * false / total})


if __name__ == "__main__":
    main()
