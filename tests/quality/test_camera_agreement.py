"""Cameras that contradict each other are named; those that agree within their uncertainties are not."""

from dataclasses import replace

import numpy as np
import pytest

from levkas.calibration.error_sources import ErrorSource, MeanSpectrum, uncertain_mean
from levkas.database.layout import LayerId
from levkas.pages.agreement import describe_agreement
from levkas.quality.evaluation.camera_agreement import PatchMeans, compare_all, compare_layers

PLACES = np.array([(12 * k, 24) for k in range(30)])
TONES = np.linspace(0.3, 1.0, len(PLACES))
VIS, NIR = np.arange(400, 721, 20), np.arange(460, 1000, 50)


def spectrum(nm, tone):
    """A paint: a smooth step in reflectance."""
    return tone * (0.3 + 0.6 / (1 + np.exp(-(np.asarray(nm) - 570) / 40)))


def layer(name, nm, *, factor=1.0, noise=0.001, sources=(), setup="", seed=0):
    labels, rng = [f"{n:g} nm" for n in nm], np.random.default_rng(seed)
    means, numbers = [], []
    for k, tone in enumerate(TONES):
        values = spectrum(nm, tone) * factor + rng.normal(0, noise, len(nm))
        mean = MeanSpectrum(labels, values, np.full(len(nm), noise), np.array(nm, float))
        means.append(mean)
        own = name + setup
        numbers.append(uncertain_mean(mean, sources, layer=own, camera=name, region=(own, k)))
    fwhm = np.full(len(nm), 10.0)
    return PatchMeans(LayerId("icon", name, setup), PLACES, tuple(means), tuple(numbers), fwhm)


def relative(name, size, nm, extent="frame"):
    sizes = {f"{n:g} nm": size for n in nm}
    return ErrorSource(name, "relative", sizes, extent, all_bands=True)


def test_two_cameras_without_errors_agree():
    pair = compare_layers(layer("vis", VIS), layer("nir", NIR, seed=1), {})
    assert [band.band for band in pair.bands] == [f"{n} nm" for n in NIR if n <= 720]
    assert all(abs(band.ratio - 1) < 0.005 for band in pair.bands)
    assert not pair.contradictions
    ((mark, reported),) = describe_agreement([pair]).short
    assert mark == "ok" and "agree within their uncertainties" in reported


def test_a_wrong_white_is_named_in_every_pair_and_one_within_its_certificate_is_not():
    good = [layer("a", VIS), layer("b", NIR, seed=1), layer("c", VIS + 5, seed=2)]
    pairs = compare_all([*good, layer("odd", NIR + 10, factor=1 / 0.9, seed=3)], {})
    odd = [pair for pair in pairs if pair.contradictions]
    assert len(pairs) == 6 and len(odd) == 3
    assert all("odd" in (pair.first.name, pair.second.name) for pair in odd)
    ((mark, reported),) = describe_agreement(pairs).short
    assert mark == "warn" and reported.startswith("odd ") and "+11 %" in reported
    assert "white, lamp or angle" in reported
    sure = relative("white", 0.06, NIR + 10)
    doubtful = layer("odd", NIR + 10, factor=1 / 0.9, seed=3, sources=[sure])
    assert not any(pair.contradictions for pair in compare_all([*good, doubtful], {}))


def test_a_white_that_both_used_is_no_reason_why_they_should_differ():
    white = [relative("white", 0.2, nm, "campaign") for nm in (VIS, NIR)]
    first = layer("a", VIS, sources=white[:1])
    second = layer("b", NIR, factor=1.08, seed=1, sources=white[1:])
    pair = compare_layers(first, second, {})
    assert len(pair.contradictions) == len(pair.bands)


def test_a_broad_channel_is_weighed_by_its_sensitivity_and_not_judged_beyond_the_bands():
    nm = np.arange(380.0, 781.0)
    green, red = (np.exp(-(((nm - at) / wide) ** 2)) for at, wide in ((545, 45), (760, 30)))
    means, numbers = [], []
    for k, tone in enumerate(TONES):
        values = np.array([spectrum(nm, tone) @ w / w.sum() for w in (green, red)])
        mean = MeanSpectrum(["G", "R"], values, np.full(2, 0.0005), np.full(2, np.nan))
        means.append(mean)
        numbers.append(uncertain_mean(mean, (), layer="rgb", region=k))
    camera = PatchMeans(
        LayerId("icon", "rgb"), PLACES, tuple(means), tuple(numbers), np.full(2, np.nan)
    )
    pair = compare_layers(layer("vis", VIS), camera, {"G": (nm, green), "R": (nm, red)})
    assert [band.band for band in pair.bands] == ["G"]
    assert pair.bands[0].ratio == pytest.approx(1, abs=0.004)
    assert pair.bands[0].wavelength == pytest.approx(545, abs=1)
    assert compare_layers(layer("vis", VIS), camera, {}) is None  # nobody knows what it sees
    seen = {"G": (nm, green), "R": (nm, red)}
    assert compare_all([camera, camera], {"rgb": seen}) == ()  # and no spectrum is read off it


def test_another_lighting_is_read_as_another_lighting():
    pair = compare_layers(layer("a", VIS), layer("a", VIS, factor=0.6, setup="raking", seed=1), {})
    assert pair.contradictions
    found = describe_agreement([pair])
    assert found.rows[0].finding == "another lighting" and not found.short


def test_one_filter_under_two_lightings_is_two_bands():
    """Filters 40 nm wide under an even lamp and one with a peak at 530 nm, towards which a filter on its slope sees."""
    centres = np.arange(410.0, 700, 48)
    lamps = {"even": np.ones_like, "peak": lambda nm: 0.05 + np.exp(-(((nm - 530) / 15) ** 2))}
    made, seen = [], {}
    for name, lamp in lamps.items():
        bands = {}
        for centre in centres:
            nm = np.linspace(centre - 50, centre + 50, 201)
            bands[f"{centre:g} nm"] = nm, np.exp(-(((nm - centre) / 24) ** 2)) * lamp(nm)
        shift = [float(nm @ w / w.sum()) for nm, w in bands.values()]
        one = layer("cam", centres, setup=name)
        means, numbers = [], []
        for k, tone in enumerate(TONES):
            values = np.array([spectrum(nm, tone) @ w / w.sum() for nm, w in bands.values()])
            mean = replace(one.means[0], values=values)
            means.append(mean)
            numbers.append(uncertain_mean(mean, (), layer=name, region=(name, k)))
        made.append(replace(one, means=tuple(means), numbers=tuple(numbers), fwhm=0 * centres + 40))
        seen[one.layer.name] = bands
    assert max(abs(np.array(shift) - centres)) > 5
    (alike,), (known,) = compare_all(made, {}), compare_all(made, seen)
    assert max(abs(band.ratio - 1) for band in alike.bands) > 0.03
    assert max(abs(band.ratio - 1) for band in known.bands) < 0.02
    assert alike.contradictions and not known.contradictions
