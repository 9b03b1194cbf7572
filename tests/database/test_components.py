"""Components: against linear algebra on the whole cube, and on scenes whose truth is planted."""

import numpy as np
import pytest
import xarray
from scipy.linalg import eigh

import levkas.database.components as components
from levkas.core.cube import Flag
from levkas.database.components import ComponentsRefused, find_components

SHAPE = (40, 30, 5)


def labelled(values):
    labels = [f"{400 + 10 * i} nm" for i in range(values.shape[2])]
    return xarray.DataArray(values, dims=("y", "x", "band"), coords={"band": labels})


def plain(shape):
    return labelled(np.zeros(shape, np.uint8))


@pytest.fixture
def scene():
    """Two smooth planes in five bands, and noise whose spread differs from band to band."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]] / 10.0
    first, second = np.sin(x) * np.cos(y), np.cos(1.3 * x + y)
    planes = first[..., None] * [0.5, 0.4, 0.3, 0.1, 0.0] + second[..., None] * [
        0,
        0.1,
        0,
        0.2,
        0.1,
    ]
    spread = np.array([0.01, 0.02, 0.01, 0.05, 0.01])
    values = (0.5 + planes + rng.normal(size=SHAPE) * spread).astype(np.float32)
    return labelled(values), labelled(np.broadcast_to(spread, SHAPE).astype(np.float32))


def test_principal_components_are_those_of_the_whole_cube(scene, monkeypatch):
    layer, _ = scene
    monkeypatch.setattr(components, "BLOCK_SAMPLES", 30 * 5 * 7)  # blocks of seven rows
    found = find_components(layer, plain(SHAPE))
    spectra = layer.values.reshape(-1, 5).astype(float)
    values, vectors = np.linalg.eigh(np.cov(spectra.T))
    assert np.allclose(found.variance, values[::-1], rtol=1e-9)
    assert np.allclose(found.explained, values[::-1] / values.sum(), rtol=1e-9)
    turned = np.abs(np.einsum("kb,bk->k", found.loadings, vectors[:, ::-1]))
    assert np.allclose(turned, 1, atol=1e-9)
    image = np.concatenate(list(found.rows(layer, plain(SHAPE), count=3)))
    expected = (layer.values.astype(float) - spectra.mean(0)) @ found.loadings[:3].T
    assert image.shape == (40, 30, 3) and np.allclose(image, expected, atol=1e-6)


def test_the_largest_loading_is_positive_whatever_the_sign_of_the_scene(scene):
    layer, sigma = scene
    for method in ("pca", "mnf"):
        for sign in (1, -1):
            found = find_components(layer * sign, plain(SHAPE), sigma, method=method)
            rows = np.arange(5), np.abs(found.loadings).argmax(1)
            assert (found.loadings[rows] > 0).all()


def test_fractions_solve_the_generalised_problem_and_have_noise_one(scene):
    layer, sigma = scene
    found = find_components(layer, plain(SHAPE), sigma, method="mnf")
    noise = np.diag(np.square(sigma.values[0, 0].astype(float)))
    values, _ = eigh(np.cov(layer.values.reshape(-1, 5).astype(float).T), noise)
    assert found.noise_from == "sigma" and np.allclose(found.noise, noise, rtol=1e-6)
    assert np.allclose(found.variance, values[::-1], rtol=1e-6)
    assert np.allclose(found.loadings @ found.noise @ found.loadings.T, np.eye(5), atol=1e-9)
    assert np.allclose(found.snr, np.maximum(found.variance - 1, 0))


@pytest.mark.parametrize("known", [True, False])
def test_fractions_order_by_signal_over_noise_where_principal_components_do_not(known):
    """A faint drawing in quiet bands, below the noise of a loud band: PCA puts the noise first, MNF the drawing."""
    rng = np.random.default_rng(5)
    shape = (120, 120, 4)
    drawing = np.sin(np.add.outer(np.arange(120), np.arange(120)) * 2 * np.pi / 80) * 0.01
    spread = np.array([0.3, 0.002, 0.002, 0.002])
    values = 0.5 + drawing[..., None] * [0, 1, 1, 1] + rng.normal(size=shape) * spread
    layer = labelled(values.astype(np.float32))
    sigma = labelled(np.broadcast_to(spread, shape).astype(np.float32)) if known else None
    images = {}
    for method in ("pca", "mnf"):
        found = find_components(layer, plain(shape), sigma, method=method)
        images[method] = next(found.rows(layer, plain(shape), count=1))[..., 0]
    alike = {m: abs(np.corrcoef(i.ravel(), drawing.ravel())[0, 1]) for m, i in images.items()}
    assert alike["pca"] < 0.05 and alike["mnf"] > 0.98
    truth = 3 * drawing.var() / 0.002**2  # of the mean of three bands
    assert found.snr[0] == pytest.approx(truth, rel=0.05 if known else 0.15)
    assert (np.diff(found.snr) <= 0).all()


def test_noise_from_differences_is_that_of_the_pairs_of_the_whole_cube(scene, monkeypatch):
    layer, _ = scene
    flags = plain(SHAPE)
    flags.values[10:14, 5:9, 2] = Flag.SATURATED
    cube, sound = layer.values.astype(float), ~flags.values.any(-1)
    across = (cube[:, 1:] - cube[:, :-1])[sound[:, 1:] & sound[:, :-1]]
    down = (cube[1:] - cube[:-1])[sound[1:] & sound[:-1]]
    pairs = np.concatenate([across, down])
    for samples in (30 * 5 * 7, 30 * 5, 10**7):
        monkeypatch.setattr(components, "BLOCK_SAMPLES", samples)
        found = find_components(layer, flags, method="mnf")
        assert found.noise_from == "differences"
        assert np.allclose(found.noise, pairs.T @ pairs / len(pairs) / 2, rtol=1e-9)


def test_flagged_pixels_do_not_count_and_are_not_drawn(scene):
    layer, sigma = scene
    flags, values = plain(SHAPE), layer.values.copy()
    flags.values[:5, :, 1] = Flag.SATURATED
    values[:5] = 1e6
    values[20, 20, 3] = np.nan
    flags.values[30, 3] = Flag.DEFECT  # replaced: an estimate of the paint all the same
    spoilt = labelled(values)
    found = find_components(spoilt, flags, sigma, method="mnf")
    assert found.pixels == 40 * 30 - 5 * 30 - 1
    kept = np.ones((40, 30), bool)
    kept[:5], kept[20, 20] = False, False
    assert np.allclose(found.mean, layer.values[kept].astype(float).mean(0), rtol=1e-12)
    image = np.concatenate(list(found.rows(spoilt, flags, count=2)))
    assert np.isnan(image[:5]).all() and np.isnan(image[20, 20]).all()
    assert np.isfinite(image[30, 3]).all() and np.isnan(image).sum() == 2 * (5 * 30 + 1)


def test_the_same_bytes_for_any_number_of_threads(scene, monkeypatch):
    layer, sigma = scene
    big = labelled(np.tile(layer.values, (4, 8, 1)))
    more = labelled(np.tile(sigma.values, (4, 8, 1)))
    made = set()
    for threads in ("1", "2", "4"):
        monkeypatch.setenv("LEVKAS_THREADS", threads)
        found = find_components(big, plain(big.shape), more, method="mnf")
        image = np.concatenate(list(found.rows(big, plain(big.shape), count=3)))
        made.add((found.loadings.tobytes(), found.variance.tobytes(), image.tobytes()))
    assert len(made) == 1


@pytest.mark.parametrize(
    ("shape", "method", "code"),
    [((9, 9, 1), "pca", "E_SIZE"), ((3, 3, 4), "pca", "E_SIZE"), ((9, 9, 3), "mnf", "E_VALUE")],
)
def test_what_has_no_components_is_refused(shape, method, code):
    layer = labelled(np.full(shape, 0.5, np.float32))
    with pytest.raises(ComponentsRefused) as refused:
        find_components(layer, plain(shape), method=method)
    assert refused.value.problems[0].code == code


def test_an_opened_layer_gives_its_components(tmp_path, scene):
    import levkas
    from levkas.core.cube import Band, Cube
    from levkas.database.layers import Layer, write_layer

    layer, sigma = scene
    bands = tuple(Band(str(b), float(str(b).split()[0]), 10.0) for b in layer["band"].values)
    cube = Cube(layer.values, np.zeros(SHAPE, np.uint8), sigma.values, bands)
    write_layer(tmp_path, Layer("one", "vis"), cube)
    opened = levkas.open(tmp_path)["one"]["vis"]
    found = opened.components("mnf")
    assert found.noise_from == "sigma" and found.pixels == 1200 and found.bands[0] == "400 nm"
    part = opened.isel(band=slice(0, 3)).components()
    assert part.loadings.shape == (3, 3) and part.snr is None
