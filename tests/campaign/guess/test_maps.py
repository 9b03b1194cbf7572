"""Maps of a scan in a folder: `look` proposes kind = "maps" for all formats that programs write, and finds the captures."""

import cv2
import numpy as np
import pytest
import tifffile
from scipy import ndimage

from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.campaign.guess import look, write_campaign

NAMES = ("Pb_L", "Hg_L", "Cu_K", "Fe_K", "Ar_K")
RPL = "key\tvalue\nwidth\t50\nheight\t38\ndepth\t5\noffset\t0\ndata-length\t4\ndata-type\tfloat\nbyte-order\tlittle-endian\nrecord-by\timage\n"
ENVI = "ENVI\nsamples = 50\nlines = 38\nbands = 5\ndata type = 4\ninterleave = bsq\nbyte order = 0\nband names = {Pb L, Hg L, Cu K, Fe K, Ar K}\n"


def write_ripple(folder, name, maps):
    (folder / f"{name}.rpl").write_text(RPL)
    (folder / f"{name}.raw").write_bytes(maps.tobytes())


def write_envi(folder, name, maps):
    (folder / f"{name}.hdr").write_text(ENVI)
    (folder / f"{name}.img").write_bytes(maps.tobytes())


def write_pages(folder, name, maps):
    tifffile.imwrite(folder / f"{name}.tif", maps, photometric="minisblack", metadata=None)


def write_files(folder, name, maps):
    (folder / name).mkdir()
    for label, one in zip(NAMES, maps, strict=True):
        cv2.imwrite(str(folder / name / f"{label}.tif"), one)


def write_beside_one_another(folder, name, maps):
    for label, one in zip(NAMES, maps, strict=True):
        cv2.imwrite(str(folder / f"{name}_{label.replace('_', '-')}.tif"), one)


FORMATS = {
    write_ripple: "{target}.rpl",
    write_envi: "{target}.hdr",
    write_pages: "{target}.tif",
    write_files: "{target}/{band}.tif",
    write_beside_one_another: "{target}_{band}.tif",
}


@pytest.mark.parametrize(
    "write",
    [
        pytest.param(w, marks=[pytest.mark.exhaustive] * (w in (write_envi, write_pages)))
        for w in FORMATS
    ],
    ids=lambda write: write.__name__,
)
def test_maps_are_proposed_as_such_beside_a_photograph(tmp_path, write):
    rng = np.random.default_rng(1)
    for part in ("photo", "xrf"):
        (tmp_path / part).mkdir()
    for name in ("icon1", "icon2"):
        paint = ndimage.gaussian_filter(rng.normal(size=(300, 400)), 4)
        paint = (paint - paint.min()) / np.ptp(paint)
        cv2.imwrite(
            str(tmp_path / f"photo/{name}.png"), (255 * np.dstack([paint] * 3)).astype(np.uint8)
        )
        few = cv2.resize(paint, (50, 38), interpolation=cv2.INTER_AREA)
        maps = np.stack([rng.poisson(20 * few ** (k + 1)) for k in range(5)]).astype("<f4")
        write(tmp_path / "xrf", name, maps)
    proposal = look(tmp_path)
    cameras = proposal.to_dict()["cameras"]
    assert cameras["xrf"]["kind"] == "maps"
    assert cameras["xrf"]["files"] == f"xrf/{FORMATS[write]}"
    assert proposal.to_dict()["campaign"]["reference"] == {"camera": "photo"}
    write_campaign(proposal)
    captures, *_ = find_captures(load_campaign(tmp_path))
    found = [one for one in captures if one.camera == "xrf"]
    assert [one.object for one in found] == ["icon1", "icon2"]
    assert all(len(one.bands) == 5 for one in found)
