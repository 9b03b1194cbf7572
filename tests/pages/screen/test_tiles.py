import io
import zlib
from base64 import b64decode

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image

from levkas.colour.relighting import relighting_matrix
from levkas.database.tiff_pages import open_pages
from levkas.publish.viewer import spectra
from levkas.publish.viewer.pyramid import OVERLAP_PX, TILE_PX, cut, halve, write_pyramid
from levkas.publish.viewer.spectra import encode_block, write_spectra

from .database import write_database


def decode_block(
    data: bytes, shape: tuple[int, int, int], dtype: np.dtype | type
) -> tuple[np.ndarray, bytes]:
    """Return the first block of a payload, and what follows it, as the page decodes them."""
    rows, columns, bands = shape
    kind = np.dtype(dtype)
    size = rows * columns * bands * kind.itemsize
    octets = np.frombuffer(data[:size], np.uint8).reshape(bands, kind.itemsize, rows, columns)
    whole = np.cumsum(octets, axis=-1, dtype=np.uint8)
    values = np.ascontiguousarray(np.moveaxis(whole, 1, 3)).view(kind.newbyteorder("<"))[..., 0]
    return np.moveaxis(values, 0, 2).astype(kind), data[size:]


@settings(max_examples=60, deadline=None)
@given(
    arrays.arrays(
        st.sampled_from([np.float32, np.uint8]),
        st.tuples(st.integers(1, 5), st.integers(1, 5), st.integers(1, 4)),
    )
)
def test_a_block_of_spectra_comes_back_bit_for_bit(block):
    back, rest = decode_block(encode_block(block) + b"more", block.shape, block.dtype)
    assert back.tobytes() == block.tobytes() and rest == b"more"


@pytest.mark.parametrize("most", [5_000_000, 60_000])
def test_tiles_of_spectra_cover_every_pixel_of_the_file(tmp_path, monkeypatch, most):
    monkeypatch.setattr(spectra, "MOST_TILE_BYTES", most)
    root = write_database(tmp_path / "database", {"icon": "An icon"})
    tiff = root / "objects/icon/icon_vis.tif"
    files = {}
    facts = write_spectra(files.__setitem__, "here", tiff, key="0/spectra")
    whole = open_pages(tiff).read()
    across, down = facts["columns"], facts["rows"]
    seen = np.zeros(whole.shape[:2], int)
    for name, data in files.items():
        column, row = map(int, name.removeprefix("here/").removesuffix(".js").split("_"))
        head, text = data.decode("ascii").removesuffix('");\n').split(',"')
        assert head == f'levkasTile("0/spectra/{column}_{row}"'
        place = np.s_[row * down : (row + 1) * down, column * across : (column + 1) * across]
        part = whole[place]
        values, _ = decode_block(zlib.decompress(b64decode(text)), part.shape, np.float32)
        assert values.tobytes() == np.ascontiguousarray(part).tobytes()
        seen[place] += 1
    assert (seen == 1).all()


@pytest.mark.parametrize("size", [(1, 1), (TILE_PX + 1, 3), (1300, 700)])
def test_tiles_of_every_level_join_to_the_picture(size):
    rng = np.random.default_rng(3)
    image = rng.integers(0, 4, size[::-1], np.uint8)
    palette = rng.integers(0, 255, (4, 3), np.uint8)
    files = {}
    facts = write_pyramid(files.__setitem__, "p", image, key="layers/0/p", palette=palette)
    for level in range(facts["most"], facts["least"] - 1, -1):
        joined = np.full((*image.shape, 3), 7, np.uint8)
        for name, data in files.items():
            if not name.startswith(f"p/{level}/"):
                continue
            column, row = map(int, name.split("/")[-1].removesuffix(".js").split("_"))
            head, text = data.decode("ascii").removesuffix('");\n').split(',"')
            assert head == f'levkasTile("layers/0/{name.removesuffix(".js")}"'
            tile = np.asarray(Image.open(io.BytesIO(b64decode(text))).convert("RGB"))
            top, left = (max(0, n * TILE_PX - OVERLAP_PX) for n in (row, column))
            joined[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
        np.testing.assert_array_equal(joined, palette[image])
        image = halve(image, categories=True)
    assert max(size) / 2 ** (facts["most"] - facts["least"]) <= TILE_PX


def test_neighbouring_tiles_overlap_by_a_pixel_on_each_side():
    tiles = {(column, row): tile for column, row, tile in cut(np.zeros((20, 1100), np.uint8))}
    assert [tiles[column, 0].shape[1] for column in range(3)] == [TILE_PX + 1, TILE_PX + 2, 81]


def test_relit_colours_are_those_of_colour_science():
    import colour

    wavelengths = np.arange(380, 781, 10)
    patches = colour.SDS_COLOURCHECKERS["BabelColor Average"]
    for name in ("dark skin", "blue", "orange"):
        spectrum = patches[name].copy().align(colour.SpectralShape(380, 780, 10))
        light = colour.SDS_ILLUMINANTS["A"]
        xyz = colour.sd_to_XYZ(spectrum, illuminant=light) / 100
        white = colour.sd_to_XYZ(light, method="Integration")
        adapted = colour.adaptation.chromatic_adaptation_VonKries(
            xyz, white / white[1], np.array([0.9505, 1.0, 1.089]), transform="Bradford"
        )
        expected = np.linalg.inv(
            [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
        )
        linear = spectrum.values @ relighting_matrix(wavelengths, "A")
        np.testing.assert_allclose(linear, expected @ adapted, atol=4e-3)
