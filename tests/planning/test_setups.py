"""Setup files: what is misspelt, impossible or gone is refused, nothing is assumed."""

import numpy as np
import pytest

from levkas.colour.illuminants import illuminant, planck
from levkas.planning import PlanRefused, load_setup, plan_framing
from levkas.planning.framing import depth_of_field, diffraction_mtf, field_mm, magnification
from levkas.planning.spectra import GRID, colour_temperature, tristimulus

FIRST = "angle_deg = 70, azimuth_deg = 0, distance_mm = 2100"


def test_the_bench_is_read_whole(bench):
    assert list(bench.lightings) == ["proposed", "45-degree", "crossed", "soft", "d65"]
    assert [len(c.labels) for c in bench.cameras.values()] == [3, 7, 33, 51]
    lamp = bench.lighting().lamps[0]
    assert lamp.angle_deg == pytest.approx(70) and lamp.distance_mm == pytest.approx(2100)


@pytest.mark.parametrize(
    ("old", "new", "code", "field"),
    [
        ("recess_mm = 3 ", "reces_mm = 3 ", "E_KEY", "object.reces_mm"),
        ('spectrum = "halogen"', 'spectrum = "halogn"', "E_VALUE", "lamps.halogen.spectrum"),
        ("beam_deg = 20", "beam_deg = 120", "E_VALUE", "lamps.halogen.beam_deg"),
        ("planck_k = 3000", 'planck_k = 3000, cie = "A"', "E_VALUE", "spectra.halogen"),
        ("planck_k = 3000", 'cie = "Q7"', "E_VALUE", "spectra.halogen.cie"),
        ("planck_k = 3000", 'csv = "none.csv"', "E_UNREADABLE", None),
        ("border_mm = 30", "border_mm = 170", "E_VALUE", "object.border_mm"),
        ('sensors = [["R1", "G1", "B1"], ', "sensors = [", "E_VALUE", "cameras.msbs.sensors"),
        (FIRST, FIRST.replace("2100", "2.1"), "E_VALUE", "setups.proposed.lamps.0.distance_mm"),
        ("planck_k = 3000", "planck_k = 3", "E_VALUE", "spectra.halogen.planck_k"),
        ('distance_mm = 1500, polariser = "p"', "distance_mm = 1500", "E_VALUE", "setups.crossed.camera_polariser"),
        (FIRST, FIRST.replace("70", "95"), "E_VALUE", "setups.proposed.lamps.0.angle_deg"),
        ("distance_mm = 1900", "distance_mm = 75", "E_CAMERA_BLIND", "cameras.d80.distance_mm"),
        ("planck_k = 3000", 'cie = "D50"', "E_SPD_COVER", "setups.proposed.lamps.0.spectrum"),
        # keys that are gone
        ("recess_mm = 3 ", "recess_mm = 3\nbend = { radius_mm = 2000 }\n", "E_KEY", "object.bend"),
        ("beam_deg = 20 ", 'beam_deg = 20\nlobe = "lobe.csv" ', "E_KEY", "lamps.halogen.lobe"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_refused_where_it_stands(rewritten, old, new, code, field):
    with pytest.raises(PlanRefused) as refused:
        load_setup(rewritten((old, new)))
    assert all(one.file and one.fix for one in refused.value.problems)
    found = [(one.code, one.field) for one in refused.value.problems]
    assert (code, field) in found or field is None, found


def test_the_paper_s_own_table_does_not_close(bench):
    found = {f.camera: f for f in plan_framing(bench)}
    assert found["lctf-vis"].field_mm == pytest.approx((268, 200), abs=0.5)
    assert found["msbs"].field_mm == pytest.approx((386, 288), abs=0.5)
    for name in ("lctf-vis", "lctf-nir", "msbs"):
        assert not found[name].covers and found[name].contradictions
        m = magnification(bench.cameras[name].keys.focal_mm, found[name].needed_distance_mm)
        again = field_mm((1392, 1040), 6.45, m)
        assert min(a / b for a, b in zip(again, (420, 320), strict=True)) == pytest.approx(1.08)
    assert found["d80"].covers and not found["d80"].contradictions


def test_depth_of_field_and_diffraction_have_the_checked_numbers(rewritten):
    m = magnification(60.0, 1850.0)
    mtf = [float(diffraction_mtf(w, 8.0, m, 6.45)) for w in (450, 550, 700, 950)]
    np.testing.assert_allclose(mtf, [0.64, 0.56, 0.45, 0.28], atol=0.006)
    assert depth_of_field(8.0, 6.45e-3, m) == pytest.approx(2 * 8 * 6.45e-3 * (1 + m) / m**2)
    for stop, deep in ((0.8, 20), (45, 3)):  # shallow, and closed too far
        lens = f"f_number = {stop}\ndistance_mm = 1900"
        path = rewritten(
            ("f_number = 8\ndistance_mm = 1900", lens), ("recess_mm = 3 ", f"recess_mm = {deep} ")
        )
        assert len(plan_framing(load_setup(path))[0].contradictions) == 1


def test_illuminants_are_those_of_colour_science():
    import colour

    for name in ("A", "C", "D50", "D60", "D65", "E", "FL2", "FL3.15", "HP5", "LED-RGB1", "ID65"):
        w, power = illuminant(name)
        reference = colour.SDS_ILLUMINANTS[name]
        inside = (w >= 380) & (w <= 780)
        ours = power[inside] / np.interp(560, w, power)
        theirs = np.interp(w[inside], reference.wavelengths, reference.values) / reference[560]
        np.testing.assert_allclose(ours, theirs, atol=2e-4)


def test_colour_temperature_is_that_of_ohno():
    import colour

    for power in (planck(GRID, 3200.0), np.interp(GRID, *illuminant("D50"))):
        kelvin, duv = colour_temperature(power)
        x, y, z = tristimulus(power)
        uv = np.array([4 * x, 6 * y]) / (x + 15 * y + 3 * z)
        theirs = colour.temperature.uv_to_CCT_Ohno2013(uv)
        assert (kelvin, duv) == (
            pytest.approx(theirs[0], abs=3),
            pytest.approx(theirs[1], abs=1e-4),
        )
