"""TIFFs whose pages are bands, each page with its wavelength or label, in another order than another file or campaign.toml."""

import numpy as np
import pytest
import tifffile
from cameras import developed, key, text, write

from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.campaign.guess import look, write_campaign

CENTRES = (450, 550, 650)
TRUTH = np.array([0.2, 0.4, 0.8])
LAMP, BLACK = np.array([0.5, 1.0, 1.6]), np.array([50, 60, 75])


def imagej(path, pages, names):
    tifffile.imwrite(path, pages, imagej=True, metadata={"Labels": list(names)})


def described(path, pages, names):
    with tifffile.TiffWriter(path) as tiff:
        for page, name in zip(pages, names, strict=True):
            tiff.write(page, metadata=None, description=name)


def make(folder, save, orders=None, *, names=None, kind="cube"):
    """Write dark, white and panel, each with its pages in an order of its own; the codes of a page are those of its band."""
    rng = np.random.default_rng(2)
    write(folder, kind, shots=(1, 1, 1))
    for path in (folder / "raw").iterdir():
        path.unlink()
    pattern = {"cube": "{target}.hdr", "bands": "{target}_{wavelength}nm_{shot}.tif"}[kind]
    text(pattern, "{target}.tif")(folder)
    names = names or [f"{nm} nm" for nm in CENTRES]
    for target, light in (("dark", 0 * TRUTH), ("white", 1 + 0 * TRUTH), ("panel", TRUTH)):
        counts = np.rint(BLACK + 1500 * LAMP * light + rng.normal(0, 2, (48, 60, 3)))
        order = list((orders or {}).get(target, range(3)))
        pages = np.moveaxis(counts[..., order].astype(np.uint16), 2, 0)
        save(folder / f"raw/{target}.tif", np.ascontiguousarray(pages), [names[i] for i in order])
    return folder


def miss(made, order=range(3)):
    return np.abs(np.median(made.cube.values, (0, 1)) - TRUTH[list(order)]).max()


@pytest.mark.parametrize(
    ("save", "role", "kind"),
    [(imagej, "white", "cube"), (described, "dark", "bands"), (described, "panel", "cube"), (imagej, "panel", "bands")],
)  # fmt: skip
def test_pages_in_another_order_are_matched_by_their_wavelengths(tmp_path, save, role, kind):
    made = developed(make(tmp_path / "c", save, {role: (2, 0, 1)}, kind=kind))
    order = (2, 0, 1) if role == "panel" else range(3)
    assert [band.wavelength for band in made.cube.bands] == [CENTRES[i] for i in order]
    assert miss(made, order) < 0.003 and made.words


@pytest.mark.parametrize(
    ("order", "kind"), [((1, 0, 2), "cube"), ((2, 1, 0), "bands"), ((1, 2, 0), "cube")]
)
def test_pages_in_another_order_are_matched_by_their_labels(tmp_path, order, kind):
    folder = make(tmp_path / "c", imagej, {"white": order}, names=["UV", "R", "IR"], kind=kind)
    made = developed(folder)
    assert miss(made) < 0.003 and made.words


def test_declared_wavelengths_in_another_order_than_those_of_the_pages_are_refused(tmp_path):
    folder = make(tmp_path / "c", imagej, {"panel": (2, 1, 0)})
    key(f"wavelengths = {list(CENTRES)}")(folder)
    (problem,) = developed(folder).problems
    assert "650 nm" in problem.found and "450 nm" in problem.expected


def test_wavelengths_of_pages_are_those_of_a_proposed_campaign(tmp_path):
    folder = make(tmp_path / "c", imagej, dict.fromkeys(("dark", "white", "panel"), (2, 1, 0)))
    (folder / "campaign.toml").unlink()
    write_campaign(look(folder))
    (capture,), _ = find_captures(load_campaign(folder))
    assert [band.wavelength for band in capture.bands] == [650, 550, 450]
