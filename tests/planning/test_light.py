"""Light on a panel against numbers that were computed elsewhere, and against hand-made limits."""

from dataclasses import replace

import numpy as np
import pytest

from levkas.colour.microfacet import AIR, facet_lobe, fresnel, transmitted
from levkas.planning.light import compare_lightings, rough_texture
from levkas.planning.optimisation import WEIGHTS, optimise
from levkas.planning.setup import (
    Lighting,
    StudioLamp,
    aim_point,
    drop,
    illuminate,
    lamp_place,
    lobe_exponent,
)
from levkas.planning.surface import sample_surface, shading_contrast
from levkas.planning.tables import Gilding, StudioObjectKeys

FLAT = StudioObjectKeys(size_mm=(420, 320))
EYE = np.array([0.0, 0.0, 1900.0])


def pair(beam=None, *, angle=70.0, distance=2100.0, aim="middle", weaker=1.0):
    """Two opposed lamps along the width of the flat panel."""
    lamps = []
    for azimuth, candela in ((0.0, 1.0), (180.0, weaker)):
        place = lamp_place(angle, azimuth, distance)
        axis = aim_point(aim, place, FLAT.size_mm) - place
        exponent = lobe_exponent(beam) if beam else 0.0
        lamps.append(StudioLamp("a", place, axis / np.linalg.norm(axis), exponent, candela))
    return Lighting("pair", tuple(lamps))


def drop_of(lighting, thing=FLAT, lamps=slice(None)):
    surface = sample_surface(thing.model_copy(update={"recess_mm": 0.0}))
    return 100 * drop(illuminate(lighting.lamps[lamps], surface.points, surface.normals))


def specular(angle_deg, roughness, *, tilt_deg=0.0):
    """Light that varnish mirrors, over a white board's, seen along the board's normal."""
    light, tilt = np.radians(angle_deg), np.radians(tilt_deg)
    s, p = fresnel(np.cos(light / 2), 1.5 / AIR)
    incident = np.cos(light - tilt)
    lobe = facet_lobe(np.cos(light / 2 - tilt), np.asarray(incident), np.cos(tilt), roughness)
    return float((s + p) / 2 * lobe * incident / np.cos(light))


def test_ggx_gives_the_four_digits_that_mitsuba_gives():
    assert 100 * specular(70.0, 0.2) == pytest.approx(0.93, abs=0.005)
    found = [100 * specular(a, 0.1) for a in (45.0, 60.0, 70.0, 78.0)]
    np.testing.assert_allclose(found, [0.5930, 0.3104, 0.2739, 0.3181], atol=1.1e-4)


@pytest.mark.parametrize("roughness", [0.05, 0.1, 0.2, 0.3])
def test_glare_over_white_is_least_near_70_degrees_and_flat_around_it(roughness):
    angles = np.arange(40.0, 86.0, 0.1)
    level = np.array([specular(a, roughness) for a in angles])
    assert 68.9 <= angles[level.argmin()] <= 72
    near = angles[level < 1.1 * level.min()]
    # The note says 60 to 78°; the formula gives 58–61.5 to 76–78.7, by roughness.
    assert near.min() <= 61.6 and near.max() >= 76.0
    assert 1.5 <= specular(45.0, roughness) / level.min() <= 2.4


def test_fresnel_darkens_varnished_paint_by_13_per_cent_and_passes_p_light_better():
    assert transmitted(70.0) / transmitted(45.0) == pytest.approx(0.87, abs=0.005)
    assert transmitted(70.0) == pytest.approx(0.829, abs=1e-3)
    assert transmitted(45.0) == pytest.approx(0.950, abs=1e-3)
    assert fresnel(np.cos(np.arctan(1.5)), 1.5)[1] == pytest.approx(0, abs=1e-12)  # Brewster


@pytest.mark.parametrize(
    ("lighting", "expected"),
    [
        (pair(), 5.8),
        (pair(beam=15.0), 9.9),
        (pair(beam=15.0, aim="far edge"), 9.3),
        (pair(distance=1000.0), 22.7),
        (pair(beam=15.0, distance=1000.0), 35.6),
        (pair(beam=20.0, aim="far edge"), 7.7),
        (pair(beam=20.0, aim="far edge", weaker=0.95), 8.35),
    ],
)
def test_evenness_of_a_pair_at_70_degrees(lighting, expected):
    assert drop_of(lighting) == pytest.approx(expected, abs=0.06)


def test_an_opposed_pair_cancels_relief_that_one_lamp_shows():
    lamps, one = pair().lamps, pair(angle=45.0).lamps[:1]
    assert shading_contrast(one, 0.1) == pytest.approx(0.1, rel=0.01)
    ratios = [shading_contrast(one, s) / shading_contrast(lamps, s) for s in (0.15, 0.25, 0.3)]
    # Four times weaker on steep craquelure, more on gentle brush strokes.
    assert ratios == sorted(ratios, reverse=True) and 3.0 <= ratios[-1] <= 4.5 and ratios[0] > 6
    uneven = pair(weaker=3 / 7).lamps
    assert shading_contrast(uneven, 0.15) > 5 * shading_contrast(lamps, 0.15)


def test_crossed_polarisers_take_glare_away_and_flatten_texture(bench):
    by_name = {p.lighting.name: p for p in compare_lightings(bench)}
    crossed, open_ = by_name["crossed"], by_name["45-degree"]
    assert crossed.gold <= 0.002 and crossed.varnish < 1e-4
    assert open_.gold > 0.5 and open_.varnish > 0.01
    thing, sheets = bench.object, bench.bench.sheets
    lighting = bench.lighting("proposed")
    both = replace(lighting, camera_polariser="crossed")
    ratios = [
        rough_texture(thing, lighting, EYE, sheets, paint=p)
        / rough_texture(thing, both, EYE, sheets, paint=p)
        for p in (0.1, 0.2, 0.3)
    ]
    assert all(1.5 <= r <= 5.5 for r in ratios), ratios


def test_claims_of_section_3_1_as_numbers(bench):
    by_name = {p.lighting.name: p for p in compare_lightings(bench)}
    proposed, flat45, soft = (by_name[n] for n in ("proposed", "45-degree", "soft"))
    assert 0.07 <= proposed.drop <= 0.085
    assert flat45.drop > 0.4 and flat45.varnish > 3 * proposed.varnish
    assert flat45.gold > 3 * proposed.gold and flat45.gold_spread > 3 > proposed.gold_spread
    assert soft.varnish > 5 * proposed.varnish and soft.gold > 3 * proposed.gold
    assert soft.drop < 0.13
    assert proposed.texture_varnished > 2 * by_name["crossed"].texture_varnished
    cost = by_name["proposed"].mean / by_name["d65"].mean
    assert 1.5 <= cost <= 1.65


def with_object(bench, **changed):
    """The bench with another object."""
    thing = bench.object.model_copy(update=changed)
    return replace(bench, bench=bench.bench.model_copy(update={"object": thing}))


def test_the_best_angle_is_the_paper_s(bench):
    found = optimise(bench)
    assert found.angle_deg == pytest.approx(70, abs=1)


@pytest.mark.slow
def test_the_best_angle_hangs_little_on_any_weight(bench):
    for name, factor in [(name, factor) for name in WEIGHTS for factor in (0.5, 2.0)]:
        weights = {**WEIGHTS, name: WEIGHTS[name] * factor}
        assert 66 <= optimise(bench, weights=weights).angle_deg <= 74, name


def test_a_matte_panel_and_rough_gilding_want_lamps_higher_up(bench):
    matte = optimise(with_object(bench, varnish=None, gold=None, recess_mm=0.0))
    assert matte.angle_deg < 56 and matte.values["varnish"] == matte.values["gold"] == 0
    rough = optimise(with_object(bench, gold=Gilding(roughness=0.45)))
    smooth = optimise(bench)
    assert rough.angle_deg < smooth.angle_deg and rough.values["gold"] > 1.5 * smooth.values["gold"]
