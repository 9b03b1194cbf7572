import numpy as np
import pytest

import levkas
from levkas.core.cube import Band, Cube, Flag
from levkas.database.layers import Layer, write_tiffs
from levkas.database.validation import validate
from levkas.publish.editions import credits_of, fit_size, map_of, shrink


@pytest.mark.parametrize(
    ("full", "size"),
    [
        ((1392, 1040), (640, 478)),
        ((1040, 1392), (478, 640)),
        ((3000, 500), (640, 107)),
        ((9, 7), (9, 7)),
    ],
)
def test_the_medium_size_keeps_the_aspect_and_never_grows(full, size):
    assert fit_size(*full) == size
    assert abs(size[0] / size[1] - full[0] / full[1]) < 0.05 * full[0] / full[1]


def written(folder, values, *, flags=None, sigma=None):
    bands = tuple(Band(f"{400 + 10 * i} nm", 400.0 + 10 * i) for i in range(values.shape[2]))
    flags = np.zeros(values.shape, np.uint8) if flags is None else flags
    cube = Cube(values.astype(np.float32), flags, sigma, bands)
    return write_tiffs(folder / "icon_vis", Layer("icon", "vis"), cube)[0]


def test_a_ramp_keeps_its_place_and_corners_meet_corners(tmp_path):
    y, x = np.mgrid[0:600, 0:800]
    path = written(tmp_path, (0.1 + x / 1000 + y / 5000)[..., None])
    small = shrink(path, (320, 240))
    v, u = np.mgrid[0:240, 0:320]
    expected = 0.1 + ((u + 0.5) * 2.5 - 0.5) / 1000 + ((v + 0.5) * 2.5 - 0.5) / 5000
    assert np.abs(small.values[3:-3, 3:-3, 0] - expected[3:-3, 3:-3]).max() < 2e-5
    corners = map_of((320, 240), (800, 600))(np.array([[-0.5, -0.5], [319.5, 239.5]]))
    assert np.allclose(corners, [[-0.5, -0.5], [799.5, 599.5]])


def test_detail_finer_than_the_new_grid_is_averaged_and_makes_no_moire(tmp_path):
    values = np.where(np.indices((480, 640)).sum(0) % 2, 0.2, 0.6)[..., None]
    small = shrink(written(tmp_path, values), (213, 160))
    assert np.abs(small.values - 0.4).max() < 0.01


def test_sigma_is_what_the_spread_of_white_noise_becomes(tmp_path):
    rng = np.random.default_rng(3)
    values = 0.5 + 0.02 * rng.standard_normal((600, 800, 2))
    sigma = np.full(values.shape, 0.02, np.float32)
    small = shrink(written(tmp_path, values, sigma=sigma), (320, 240))
    assert small.values[5:-5, 5:-5].std() == pytest.approx(np.median(small.sigma), rel=0.03)
    assert 0.3 < np.median(small.sigma) / 0.02 < 0.6


def test_flags_of_what_a_pixel_was_made_from_go_with_it(tmp_path):
    flags = np.zeros((300, 400, 1), np.uint8)
    flags[100:110, 200:210] = Flag.SATURATED
    values = np.full((300, 400, 1), 0.5)
    values[:6] = np.nan
    flags[:6] = Flag.OUTSIDE
    small = shrink(written(tmp_path, values, flags=flags), (160, 120))
    assert small.flags[42, 82, 0] & Flag.SATURATED
    assert not small.flags[60:, :60].any()
    assert (small.flags[:2] & Flag.OUTSIDE).all() and np.isnan(small.values[:2]).all()


def test_blocks_of_bands_give_the_bytes_of_all_at_once(tmp_path, monkeypatch):
    from levkas.publish import editions

    path = written(tmp_path, np.random.default_rng(1).random((120, 90, 5)))
    whole = shrink(path, (45, 60))
    monkeypatch.setattr(editions, "GROUP_BYTES", 1)
    assert shrink(path, (45, 60)).values.tobytes() == whole.values.tobytes()


def test_the_medium_edition_is_a_database_of_its_own(database, publish, monkeypatch):
    from levkas.publish import editions

    monkeypatch.setattr(editions, "LONGEST", 80)
    monkeypatch.setattr(editions, "SHORTEST", 60)
    folder = publish(database)
    report = validate(folder / "medium")
    assert report.ok and report.manifest and validate(folder).ok
    full, medium = levkas.open(folder), levkas.open(folder / "medium")
    assert medium["icon1"]["vis"].shape == (60, 80, 11)
    assert medium["icon1"]["vis"].attrs["px_per_mm"] == pytest.approx(2.0 * 80 / 120)
    assert medium["icon1"]["vis"].sigma.shape == (60, 80, 11)
    assert (medium["icon2"]["vis"].values == full["icon2"]["vis"].values)[4:].all()
    assert medium.catalogue[0].width == 80


def test_the_medium_edition_alone_is_the_folder_itself(database, publish):
    folder = publish(database, editions="medium")
    assert validate(folder).ok
    assert not (folder / "medium").exists()
    assert list(levkas.open(folder)) == ["icon1", "icon2"]


def test_what_a_file_says_of_its_maker_is_handed_on(database):
    credits = credits_of(database / "objects/icon1/icon1_vis.tif")
    assert (credits.creator, credits.date[:10], credits.rights) == (
        "Ada",
        "2019-06-30",
        "CC-BY-4.0",
    )
