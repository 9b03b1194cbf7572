import json

import numpy as np
import pytest
from typer.testing import CliRunner

import levkas
from levkas.cli import app
from levkas.core.digests import hash_tree
from levkas.core.problems import Refused
from levkas.database.catalogue import read_catalogue
from levkas.database.validation import validate
from levkas.estimation.applying import apply_model


def command(*arguments):
    return CliRunner().invoke(app, ["estimate", *map(str, arguments)])


@pytest.fixture(scope="module")
def models(paintings, tmp_path_factory):
    """Folder of models: Wiener and a Gaussian process from rgb."""
    out = tmp_path_factory.mktemp("models") / "out"
    ran = command(paintings, "--from", "rgb", "--method", "wiener", "--method", "gaussian-process",
                  "--train", "icon1", "--test", "icon2", "-o", out)  # fmt: skip
    assert ran.exit_code == 0, ran.stderr
    return out / "models"


def test_an_estimated_layer_is_near_the_measured_one_and_never_called_one(own_paintings, models):
    steps = list(apply_model(own_paintings, models / "rgb_wiener.npz", "vis-estimated"))
    assert [s.done for s in steps] == [1, 2, 3]
    layer = levkas.open(own_paintings)["icon3"]["vis-estimated"]
    assert layer.attrs["kind"] == "estimated" and layer.attrs["estimate"]["method"] == "wiener"
    assert layer.attrs["estimate"]["training"] == ["icon1", "icon2"]
    assert not layer.attrs["estimate"]["in training"]
    entries = {(e.object, e.camera): e.kind for e in read_catalogue(own_paintings) if not e.setup}
    assert (
        entries["icon3", "vis-estimated"] == "estimated" and entries["icon3", "vis"] == "measured"
    )
    measured = levkas.open(own_paintings)["icon3"]["vis"]
    assert np.nanmean((layer.values - measured.values) ** 2) ** 0.5 < 0.12
    assert validate(own_paintings).ok
    record = json.loads(
        (own_paintings / "objects/icon1/icon1_vis-estimated.estimate.json").read_text()
    )
    rgb = next(
        e
        for e in read_catalogue(own_paintings)
        if (e.object, e.camera, e.setup) == ("icon1", "rgb", "")
    )
    assert record["kind"] == "estimated" and record["sources"] == {"rgb": rgb.sha256}
    assert record["in training"] and len(record["model"]["sha256"]) == 64


@pytest.mark.slow
def test_a_model_fitted_in_python_predicts_what_the_command_writes(own_paintings, models, tmp_path):
    model = levkas.estimate(own_paintings, "rgb", "vis", method="wiener")
    model.save(tmp_path / "mine.npz")
    list(apply_model(own_paintings, tmp_path / "mine.npz", "mine", objects=["icon2"]))
    icon = levkas.open(own_paintings)["icon2"]
    spectra = model.predict(icon["rgb"].transpose("band", "y", "x"))
    assert spectra.attrs["kind"] == "estimated" and spectra.dims == ("y", "x", "band")
    np.testing.assert_allclose(spectra.values, icon["mine"].values, atol=1e-5)
    np.testing.assert_allclose(model.predict(icon["rgb"].values[5, 6]), spectra[5, 6])
    assert (spectra.wavelength.values == icon["vis"].wavelength.values).all()
    assert 0 < spectra.sigma.max() < 0.3
    with pytest.raises(Refused) as refused:
        model.predict(icon["vis"])
    assert refused.value.problems[0].code == "E_CHANNELS"


def test_sigma_is_the_method_s_own_or_the_held_out_error_of_the_band(own_paintings, models):
    for name in ("rgb_wiener", "rgb_gaussian-process"):
        list(apply_model(own_paintings, models / f"{name}.npz", name, objects=["icon1"]))
    facts = json.loads((models / "rgb_wiener.json").read_text())
    database = levkas.open(own_paintings)["icon1"]
    constant = database["rgb_wiener"].levkas.sigma.values[20, 20]
    of_reference = database["vis"].levkas.sigma.values[20, 20]
    beyond = np.sqrt(np.square(facts["sigma"]) - np.square(of_reference))
    np.testing.assert_allclose(constant, beyond, rtol=0.01)  # sigma is stored rounded
    own = database["rgb_gaussian-process"].levkas.sigma.values
    assert np.nanstd(own[..., 5]) > 0


@pytest.mark.slow
def test_the_mean_of_an_estimated_region_is_no_better_known_than_its_paint(own_paintings, models):
    for name in ("rgb_wiener", "rgb_gaussian-process"):
        list(apply_model(own_paintings, models / f"{name}.npz", "guess", objects=["icon3"]))
        layer = levkas.open(own_paintings)["icon3"]["guess"]
        one, many = (
            layer.levkas.uncertainty(rectangle=(20, 20, *end)) for end in ((20, 20), (31, 31))
        )
        np.testing.assert_allclose(one.u, layer.levkas.sigma.values[20, 20], rtol=1e-3)
        assert (many.u_random < 0.1 * one.u_random).all()
        missed = [found.u_by_source.sel(source="prediction") for found in (one, many)]
        np.testing.assert_allclose(
            missed[1], missed[0], rtol=0.4
        )  # sigma is not the same everywhere
        apart = layer.levkas.uncertainty(
            rectangle=(20, 20, 31, 31), bands=["590 nm", "610 nm"], of="difference"
        )
        assert apart.u < np.hypot(*many.u.sel(band=["590 nm", "610 nm"]))  # missed alike
        assert "sigma" in levkas.open(own_paintings)["icon3"].dataset("guess")


def test_an_estimate_never_replaces_a_measurement_nor_is_estimated_to(own_paintings, models):
    with pytest.raises(Refused) as refused:
        list(apply_model(own_paintings, models / "rgb_wiener.npz", "cam2"))
    assert refused.value.problems[0].code == "E_EXISTS"
    for _ in range(2):  # its own may be replaced
        list(apply_model(own_paintings, models / "rgb_wiener.npz", "guess", objects=["icon1"]))
    ran = command(own_paintings, "--to", "guess", "--json")
    assert json.loads(ran.stdout)["problems"][0]["code"] == "E_ESTIMATED"


# --- models made elsewhere -----------------------------------------------------------------------


def stored(models, folder, change):
    """Copy a model with its facts, some of its arrays changed."""
    with np.load(models / "rgb_wiener.npz") as packed:
        arrays = change(dict(packed))
    np.savez(folder / "m.npz", **arrays)
    (folder / "m.json").write_bytes((models / "rgb_wiener.json").read_bytes())
    return folder / "m.npz"


HARM = {
    "bands": lambda a: a | {"coefficients": a["coefficients"][:, :3], "offset": a["offset"][:3]},
    "channels": lambda a: a | {"coefficients": a["coefficients"][:-1]},
    "no matrix": lambda a: a | {"coefficients": a["coefficients"][None]},
    "texts": lambda a: a | {"coefficients": a["coefficients"].astype(str)},
    "infinite": lambda a: a | {"offset": a["offset"] + np.inf},
    "large": lambda a: a | {"offset": np.zeros(9 << 20)},
    "lacking": lambda a: {name: array for name, array in a.items() if name != "offset"},
    "method": lambda a: a | {"method": "nonsense"},
    "version": lambda a: a | {"version": np.zeros(3)},
}


@pytest.mark.parametrize("harm", HARM)
def test_a_model_whose_arrays_do_not_fit_is_refused_and_nothing_is_written(
    own_paintings, models, tmp_path, harm
):
    before = hash_tree(own_paintings)
    model = stored(models, tmp_path, HARM[harm])
    ran = command("apply", own_paintings, model, "guess", "--json")
    assert ran.exit_code == 1, ran.output
    (problem,) = json.loads(ran.stdout)["problems"]
    assert problem["code"] in ("E_MODEL", "E_CHANNELS") and problem["fix"]
    assert hash_tree(own_paintings) == before
