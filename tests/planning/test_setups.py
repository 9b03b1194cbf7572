"""Setup files: what is misspelt, impossible or gone is refused, nothing is assumed."""

import numpy as np
import pytest

from levkas.colour.illuminants import illuminant, planck
from levkas.planning import PlanRefused, load_setup, plan_framing
from levkas.planning.framing import depth_of_field, diffraction_mtf, field_mm, magnification
from levkas.planning.spectra import GRID, colour_temperature

FIRST = "angle_deg = 70, azimuth_deg = 0, distance_mm = 2100"


def problems_of(path):
    with pytest.raises(PlanRefused) as refused:
        load_setup(path)
    for problem in refused.value.problems:
        assert problem.file and problem.fix, problem
    return refused.value.problems


def the_one(path, code):
    found = [p for p in problems_of(path) if p.code == code]
    assert found, problems_of(path)
    return found[0]


def test_the_bench_is_read_whole(bench):
    assert list(bench.lightings) == ["proposed", "45-degree", "crossed", "soft", "d65"]
    assert [len(c.labels) for c in bench.cameras.values()] == [3, 7, 33, 51]
    lamp = bench.lighting().lamps[0]
    assert lamp.angle_deg == pytest.approx(70) and lamp.distance_mm == pytest.approx(2100)


def test_a_lamp_behind_the_panel_is_refused(rewritten):
    problem = the_one(rewritten((FIRST, FIRST.replace("70", "95"))), "E_LAMP_BEHIND")
    assert problem.field == "setups.proposed.lamps.0" and "behind the panel" in problem.message


def test_a_lamp_in_the_view_of_a_camera_is_refused(rewritten):
    near = "place_mm = [60, 40, 900]"
    problem = the_one(rewritten((FIRST, near)), "E_LAMP_IN_VIEW")
    assert "'d80'" in problem.message
    behind = the_one(rewritten((FIRST, "place_mm = [0, 0, 4000]")), "E_LAMP_HIDDEN")
    assert "between this lamp and the object" in behind.message


@pytest.mark.parametrize(
    ("new", "word"),
    [
        ("distance_mm = 1900\naim_mm = [900, 0]", "does not point at the object"),
        ("place_mm = [0, 0, -1900]", "is behind the object"),
        ("distance_mm = 30", "focal length"),
    ],
)
def test_a_camera_that_cannot_see_the_object_is_refused(rewritten, new, word):
    found = problems_of(rewritten(("distance_mm = 1900", new)))
    assert any(
        p.field.startswith("cameras.d80") and word in f"{p.message} {p.expected}" for p in found
    )


def test_a_spectrum_that_does_not_cover_a_sensitivity_is_refused(rewritten):
    problem = the_one(rewritten(("planck_k = 3000", 'cie = "D50"')), "E_SPD_COVER")
    assert "lctf-nir" in problem.message or "msbs" in problem.message
    assert "300–830 nm" in problem.found and problem.expected.endswith("nm")


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("recess_mm = 3 ", "reces_mm = 3 ", "object.reces_mm"),
        ('spectrum = "halogen"', 'spectrum = "halogn"', "lamps.halogen.spectrum"),
        ("beam_deg = 20", "beam_deg = 120", "lamps.halogen.beam_deg"),
        ("planck_k = 3000", 'planck_k = 3000, cie = "A"', "spectra.halogen"),
        ("planck_k = 3000", 'cie = "Q7"', "spectra.halogen.cie"),
        ("planck_k = 3000", 'csv = "none.csv"', None),
        ("border_mm = 30", "border_mm = 170", "object.border_mm"),
        ('sensors = [["R1", "G1", "B1"], ', "sensors = [", "cameras.msbs.sensors"),
        (FIRST, "angle_deg = 70", "setups.proposed.lamps.0"),
        (FIRST, FIRST.replace("2100", "2.1"), "setups.proposed.lamps.0.distance_mm"),
        ("focal_mm = 50", "focal_mm = 0.5", "cameras.msbs.focal_mm"),
        ("pitch_um = 6.05", "pitch_um = 0.00605", "cameras.d80.pitch_um"),
        ("planck_k = 3000", "planck_k = 3", "spectra.halogen.planck_k"),
        (
            'distance_mm = 1500, polariser = "p"',
            "distance_mm = 1500",
            "setups.crossed.camera_polariser",
        ),
    ],
)
def test_what_is_wrong_is_named(rewritten, old, new, field):
    found = problems_of(rewritten((old, new)))
    assert field is None or field in [p.field for p in found], found


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("recess_mm = 3 ", "recess_mm = 3\nbend = { radius_mm = 2000 }\n", "object.bend"),
        (FIRST, FIRST + ", sure = true", "setups.proposed.lamps.0.sure"),
        ("pitch_um = 6.05", "pitch_um = 6.05\nisos = [100, 200]", "cameras.d80.isos"),
    ],
)
def test_a_key_that_is_gone_is_refused_with_what_to_write(rewritten, old, new, field):
    (problem,) = problems_of(rewritten((old, new)))
    assert (problem.code, problem.field) == ("E_KEY", field) and problem.fix.startswith("Leave it")


def test_a_misspelt_key_is_recognised(rewritten):
    problem = problems_of(rewritten(("recess_mm = 3 ", "reces_mm = 3 ")))[0]
    assert problem.fix == "Did you mean 'recess_mm'?"


def test_a_measured_lobe_stands_for_a_beam(rewritten):
    path = rewritten(("beam_deg = 20 ", 'lobe = "lobe.csv" '))
    angles = np.arange(0, 91, 5.0)
    exponent = np.log(0.5) / np.log(np.cos(np.radians(20)))
    lobe = np.maximum(np.cos(np.radians(angles)), 0) ** exponent
    rows = "\n".join(f"{a:g},{v:.6f}" for a, v in zip(angles, lobe, strict=True))
    (path.parent / "lobe.csv").write_text("angle,intensity\n" + rows)
    from levkas.planning import plan_light

    table = plan_light(load_setup(path))
    formula = plan_light(load_setup(rewritten()))
    assert table.drop == pytest.approx(formula.drop, abs=0.01)
    assert table.mean == pytest.approx(formula.mean, rel=0.02)


# --- framing ------------------------------------------------------------------------------------


def test_the_paper_s_own_table_does_not_close(bench):
    found = {f.camera: f for f in plan_framing(bench)}
    assert found["lctf-vis"].field_mm == pytest.approx((268, 200), abs=0.5)
    assert found["msbs"].field_mm == pytest.approx((386, 288), abs=0.5)
    for name in ("lctf-vis", "lctf-nir", "msbs"):
        said = found[name].contradictions[0]
        assert not found[name].covers and "smaller than the object, 420 x 320 mm" in said
        needed = found[name].needed_distance_mm
        again = field_mm(
            (1392, 1040), 6.45, magnification(bench.cameras[name].keys.focal_mm, needed)
        )
        assert min(a / b for a, b in zip(again, (420, 320), strict=True)) == pytest.approx(1.08)
    assert found["d80"].covers and not found["d80"].contradictions
    assert pytest.approx(2.3, abs=0.02) == 640 * 480 / (420 * 320)  # and not 4 samples a mm²


def test_depth_of_field_and_diffraction_have_the_checked_numbers():
    m = magnification(60.0, 1850.0)
    mtf = [float(diffraction_mtf(w, 8.0, m, 6.45)) for w in (450, 550, 700, 950)]
    np.testing.assert_allclose(mtf, [0.64, 0.56, 0.45, 0.28], atol=0.006)
    assert depth_of_field(8.0, 6.45e-3, m) == pytest.approx(2 * 8 * 6.45e-3 * (1 + m) / m**2)


def test_a_shallow_depth_of_field_and_a_closed_lens_are_said(rewritten):
    path = rewritten(
        ("f_number = 8\ndistance_mm = 1900", "f_number = 0.8\ndistance_mm = 1900"),
        ("recess_mm = 3 ", "recess_mm = 20 "),
    )
    said = plan_framing(load_setup(path))[0].contradictions
    assert any("deep, but at f/0.8" in s for s in said)
    path = rewritten(("f_number = 8\ndistance_mm = 1900", "f_number = 45\ndistance_mm = 1900"))
    assert any("Diffraction" in s for s in plan_framing(load_setup(path))[0].contradictions)


# --- spectra --------------------------------------------------------------------------------------


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
        from levkas.planning.spectra import tristimulus

        x, y, z = tristimulus(power)
        uv = np.array([4 * x, 6 * y]) / (x + 15 * y + 3 * z)
        theirs = colour.temperature.uv_to_CCT_Ohno2013(uv)
        assert kelvin == pytest.approx(theirs[0], abs=3) and duv == pytest.approx(
            theirs[1], abs=1e-4
        )
