"""Two spectrographs spliced to one layer: the truth is a spectrum of each pixel that neither camera's bands share."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import levkas
from levkas.cli import app
from levkas.core.cube import Band, Cube
from levkas.core.problems import Refused
from levkas.database.catalogue import write_catalogue
from levkas.database.layers import Layer, write_layer
from levkas.database.manifest import write_manifest
from levkas.database.splicing import splice
from levkas.database.store import write_index
from levkas.database.validation import validate

SHAPE = (48, 80)
VNIR, SWIR = np.arange(400.0, 1001.0, 10.0), np.arange(950.0, 1701.0, 15.0)


def spectra(wavelengths, shift=0):
    """Paint in patches with a band of absorption each: reflectance, (h, w, n)."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    x = x + shift
    level = 0.3 + 0.15 * np.sin(0.7 * x + 0.4 * y) + 0.1 * ((x // 8 + y // 8) % 2)
    centre = 900 + 200 * ((x // 16) % 3)
    dip = 0.25 * np.exp(-(((wavelengths - centre[..., None]) / 90) ** 2))
    return (level[..., None] * (0.8 + wavelengths / 4000) * (1 - dip)).astype(np.float32)


def write(root, camera, wavelengths, values, sigma, rng, quantity="reflectance", bad=()):
    noisy = (values + rng.normal(0, 1, values.shape) * sigma).astype(np.float32)
    bands = tuple(Band(f"{w:g} nm", w, 12.0, w in bad) for w in wavelengths)
    sigmas = np.broadcast_to(sigma, values.shape).astype(np.float32)
    cube = Cube(noisy, np.zeros(values.shape, np.uint8), sigmas, bands, quantity)
    return write_layer(root, Layer("icon1", camera, px_per_mm=5.0), cube)[0]


@pytest.fixture
def make(tmp_path):
    def make(gain=1.0, shift=0, swir=SWIR, quantity="reflectance"):
        root, rng = tmp_path / "database", np.random.default_rng(3)
        noise = 0.001 + 0.01 * np.exp((VNIR - 1000) / 15)  # silicon ends there
        entries = [
            write(root, "vnir", VNIR, spectra(VNIR), noise, rng),
            write(root, "swir", swir, gain * spectra(swir, shift), 0.002, rng, quantity),
        ]
        write_catalogue(root, entries)
        write_index(root / "zarr/icon1.zarr")
        write_manifest(root)
        return root

    return make


def test_the_spectrum_goes_over_where_noise_is_least_and_values_are_those_of_the_sources(make):
    root = make()
    (step,) = splice(root, "swir", "vnir", "both")  # in any order
    overlap = step.overlap
    assert overlap.decision == "accept" and not overlap.reasons
    assert overlap.range_nm == (950, 1000) and abs(overlap.gain - 1) < 0.003
    assert (
        overlap.at_nm == 975
    )  # 0.0024 sqrt(10) at 970 is less than 0.002 sqrt(15), 0.0036 sqrt(10) at 980 more
    opened = levkas.open(root)["icon1"]
    both, sources = opened["both"], [opened["vnir"], opened["swir"]]
    waves = both.wavelength.values
    assert np.all(np.diff(waves) > 0) and waves[0] == 400 and waves[-1] == 1700
    for source, here in zip(sources, (waves < overlap.at_nm, waves >= overlap.at_nm), strict=True):
        picked = np.isin(source.wavelength.values, waves[here])
        assert np.array_equal(both.values[..., here], source.values[..., picked])
        assert np.array_equal(both.sigma.values[..., here], source.sigma.values[..., picked])
    assert np.abs(both.values - spectra(waves)).mean() < 0.004
    assert (both.attrs["kind"], both.attrs["splice"]["from"]) == ("spliced", ["vnir", "swir"])
    assert validate(root).ok


def test_bad_bands_are_not_compared_and_bands_in_any_order_come_out_rising(make):
    root, rng, down = make(), np.random.default_rng(5), VNIR[::-1]
    values = spectra(down)
    values[..., down == 980] *= 3  # a bad band that says nothing
    entry = write(root, "vnir", down, values, 0.002, rng, bad=(980.0,))
    write_catalogue(root, [entry, *(e for e in levkas.open(root).catalogue if e.camera == "swir")])
    (step,) = splice(root, "vnir", "swir", "both")
    assert step.overlap.decision == "accept" and 980 not in step.overlap.wavelengths_nm
    assert np.all(np.diff(levkas.open(root)["icon1"]["both"].wavelength.values) > 0)


@pytest.mark.slow
def test_of_two_that_begin_together_the_noisier_keeps_a_band(make):
    (step,) = splice(make(swir=np.arange(400.0, 1701.0, 15.0)), "vnir", "swir", "both")
    waves = levkas.open(step.files[0].parents[2])["icon1"]["both"].wavelength.values
    assert step.overlap.decision == "accept" and waves[0] == 400 and waves[-1] == 1690


@pytest.mark.slow
def test_a_step_is_measured_said_and_levelled_where_that_is_asked_for(make):
    root = make(gain=1.05)
    (step,) = splice(root, "vnir", "swir", "both")
    assert step.overlap.decision == "warn" and "brighter" in step.overlap.reasons[0]
    assert abs(step.overlap.gain - 1.05) < 0.003
    (entry,) = (e for e in levkas.open(root).catalogue if e.camera == "both")
    assert (entry.kind, entry.verdict) == ("spliced", "warn")
    plain = levkas.open(root)["icon1"]["both"].values
    (step,) = splice(root, "vnir", "swir", "both", level=True)
    levelled = levkas.open(root)["icon1"]["both"]
    after = levelled.wavelength.values >= step.overlap.at_nm
    assert np.allclose(
        levelled.values[..., after] * step.overlap.gain, plain[..., after], rtol=1e-3
    )
    assert np.array_equal(levelled.values[..., ~after], plain[..., ~after])
    assert levelled.attrs["splice"]["levelled_by"] == step.overlap.gain


@pytest.mark.slow
def test_layers_that_contradict_each_other_are_not_spliced_unless_levelled(make):
    root = make(gain=1.3)
    with pytest.raises(Refused, match=r"\+30\.\d%|\+29\.\d%"):
        list(splice(root, "vnir", "swir", "both"))
    assert not list(root.rglob("*both*"))
    (step,) = splice(root, "vnir", "swir", "both", level=True)
    assert step.overlap.decision == "warn"


def test_a_shift_of_two_pixels_shows_as_a_spread_beyond_the_noise(make):
    (step,) = splice(make(shift=2), "vnir", "swir", "both")
    assert step.overlap.decision == "warn" and "registration" in step.overlap.reasons[-1]
    assert step.overlap.spread > 5 * step.overlap.noise


@pytest.mark.slow
def test_without_common_wavelengths_nothing_shows_that_they_agree(make):
    (step,) = splice(make(swir=SWIR[8:]), "vnir", "swir", "both")
    assert (
        step.overlap.decision == "warn"
        and "no wavelength is seen by both" in step.overlap.reasons[0]
    )
    assert step.overlap.at_nm == (1000 + 1070) / 2


@pytest.mark.parametrize(
    ("arguments", "options", "found"),
    [
        (("vnir", "swri", "both"), {}, "Did you mean 'swir'"),
        (("vnir", "vnir", "both"), {}, "vnir twice"),
        (("vnir", "swir", "vnir"), {}, "must not replace it"),
        (("vnir", "swir", "a/b"), {}, "a/b"),
        (("vnir", "swir", "both"), {"at": 1800}, "1800 nm"),
        (("vnir", "swir", "both"), {"objects": ["icon2"]}, "icon2"),
    ],
)
def test_what_cannot_be_spliced_is_refused_before_anything_is_written(
    make, arguments, options, found
):
    root = make()
    before = sorted(root.rglob("*"))
    with pytest.raises(Refused, match=found):
        list(splice(root, *arguments, **options))
    assert sorted(root.rglob("*")) == before


def test_counts_are_refused(make):
    with pytest.raises(Refused, match="counts"):
        list(splice(make(quantity="counts"), "vnir", "swir", "both"))


@pytest.mark.slow
def test_the_command_prints_what_was_found(make):
    root = make(gain=1.05)
    result = CliRunner().invoke(app, ["splice", str(root), "vnir", "swir", "both"])
    assert result.exit_code == 0, result.output
    assert "step +4.9" in result.output and "1 of them doubtful" in result.output
    result = CliRunner().invoke(app, ["splice", str(root), "vnir", "swir", "both", "--json"])
    assert json.loads(result.stdout)["overlaps"]["icon1"]["decision"] == "warn"


@pytest.mark.slow
def test_the_viewer_says_what_was_spliced_and_what_the_overlap_showed(make):
    from levkas.publish.viewer.objects import find_items, write_object

    root = make(gain=1.05)
    list(splice(root, "vnir", "swir", "both"))
    (item,) = find_items(root)
    layers = {layer["name"]: layer for layer in write_object(lambda *_: None, item)}
    assert layers["both"]["decision"] == "warn" and "spliced" in layers["both"]["verdict"]
    assert "5.0% brighter" in layers["both"]["reasons"][1]
    assert layers["vnir"]["decision"] == "accept"
