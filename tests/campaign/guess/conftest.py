"""Folders of small frames: a line for each set of files, ``d80/{dark,white,icon1}/{450,550}nm.tif``.

What a file shows follows from its name: ``dark``, ``white`` or ``flat``; else a painting that its other words give, so that bands and
shots of one object show the same. ``{zwart=dark,schilderij}`` says it.
"""

import re
from itertools import product

import cv2
import numpy as np
import pytest
import tifffile

from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.campaign.guess import look

SHAPE = (120, 160)


def painting(seed, shape=SHAPE):
    """Strokes of a painting, shares of one."""
    rng = np.random.default_rng(seed)
    picture = np.full(shape, 0.3, np.float32)
    for _ in range(160):
        x, y, level = *rng.integers(0, shape[::-1]), rng.uniform(0.05, 0.9)
        end = int(x + rng.integers(-20, 20)), int(y + rng.integers(-20, 20))
        cv2.line(picture, (int(x), int(y)), end, float(level), int(rng.integers(2, 6)))
    return picture


def shares_of(what, shape=SHAPE):
    """Shares of the scale that a frame shows."""
    if what.startswith("dark"):
        return np.zeros(shape)
    light = 0.9 - 0.15 * np.linspace(-1, 1, shape[1]) ** 2
    if what.startswith(("white", "flat")):
        return light * np.ones(shape)
    return light * painting(list(what.encode()), shape)


def write(path, shares, *, bits=12, pages=1, mosaic=False, shift=0):
    """Write shares as counts above a black level, with noise; the suffix gives the format, ``.jpg`` has colours."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rng, full = np.random.default_rng([*str(path.name).encode()]), 2**bits - 1
    if mosaic:
        shares = shares * np.tile(
            [[0.7, 1.0], [1.0, 0.55]], (shares.shape[0] // 2, shares.shape[1] // 2)
        )
    counts = 0.02 * full + 0.8 * full * shares + rng.normal(0, 0.5 + 0.002 * full, shares.shape)
    values = counts.clip(0, full).round().astype(np.uint16) << shift
    if path.suffix.lower() in (".tif", ".tiff"):
        planes = values if pages == 1 else np.stack([values] * pages)
        tifffile.imwrite(path, planes, photometric="minisblack", metadata=None)
        return
    grey = (counts / full * 255).clip(0, 255).round().astype(np.uint8)
    cv2.imwrite(str(path), np.dstack([grey] * 3) if path.suffix == ".jpg" else grey)


def names_of(line):
    """Yield each name of a line, and what it shows."""
    parts = re.split(r"\{([^{}]*)\}", line)
    choices = [
        [(text, "")] if not i % 2 else [_choice(one) for one in text.split(",")]
        for i, text in enumerate(parts)
    ]
    for some in product(*choices):
        what = "".join(what for _, what in some if not re.fullmatch(r"[\d.]*", what))
        yield "".join(text for text, _ in some), what or line


def _choice(text):
    name, _, what = text.partition("=")
    return name, what or name


@pytest.fixture
def studio(tmp_path):
    """Make a folder of the files that lines list; options of `write` follow a bar."""

    def make(lines, folder=tmp_path / "studio"):
        for line in filter(None, map(str.strip, lines.splitlines())):
            names, _, options = line.partition(" | ")
            keys = {key: int(value) for key, value in re.findall(r"(\w+)=(\d+)", options)}
            size = keys.pop("wide", SHAPE[1])
            for name, what in names_of(names):
                write(folder / name, shares_of(what, (SHAPE[0], size)), **keys)
        return folder

    return make


def flat(table, above=""):
    """Return the keys of a document by their paths."""
    found = {}
    for key, value in table.items():
        found |= (
            flat(value, f"{above}{key}.") if isinstance(value, dict) else {f"{above}{key}": value}
        )
    return found


def answered(proposal):
    """Yield the text of the proposal under each answer to its question."""
    answers = [choice.what for camera in proposal.cameras for choice in camera.choices]
    for answer in dict.fromkeys(answers):
        blocks = rf"# {re.escape(answer)}\n(?:#     .*\n)+"
        yield re.sub(blocks, lambda block: block[0].replace("#     ", ""), proposal.text)


def taken(folder, text):
    """Return what a build would find by a campaign: object → layers with their bands; nothing may be refused."""
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    captures, refusals = find_captures(load_campaign(folder))
    assert not refusals
    return {(c.object, c.layer): [b.label for b in c.bands] for c in captures}


@pytest.fixture
def proposed(studio):
    """Make a folder, and return it with what is proposed for it."""

    def make(lines):
        folder = studio(lines)
        return folder, look(folder)

    return make
