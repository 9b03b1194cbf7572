import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from levkas.campaign.discovery.patterns import Pattern
from levkas.core.problems import Refused


def read(pattern, path, **known):
    return Pattern.parse(pattern).read(path, known)


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("250ms", 0.25),
        ("3s", 3.0),
        ("0.5", 0.5),
        ("40us", 4e-5),
        ("40µs", 4e-5),
        ("2min", 120.0),
        ("1.5sec", 1.5),
    ],
)
def test_the_exposure_takes_its_unit_from_the_letters_behind_it(text, seconds):
    unit = text.lstrip("0123456789.")
    assert read("{target}_{exposure}" + unit + ".tif", f"a_{text}.tif")["exposure_s"] == seconds


def test_what_stands_twice_must_agree():
    pattern = "{target}/{target}_{wavelength}nm.tif"
    assert read(pattern, "icon1/icon1_550nm.tif") == {"target": "icon1", "wavelength": 550.0}
    assert read(pattern, "icon1/icon2_550nm.tif") is None


def test_a_wavelength_has_decimals_and_is_never_the_tail_of_a_number():
    assert read("{target}_{wavelength}nm.tif", "a_366.55nm.tif")["wavelength"] == 366.55
    assert read("{target}*{wavelength}nm.tif", "a_1550nm.tif")["wavelength"] == 1550.0
    assert read("{target}_{wavelength}nm.tif", "a_550.nm.tif") is None


def test_literal_text_is_literal_and_only_the_suffix_ignores_case():
    assert read("a+b(1)/{target}.tif", "a+b(1)/x.TIF") == {"target": "x"}
    assert read("a+b(1)/{target}.tif", "aab1/x.tif") is None
    assert read("Raw/{target}.tif", "raw/x.tif") is None
    assert read("{target}.tif", "xxtif") is None


def test_a_declared_target_is_no_part_of_a_longer_name():
    known = {"target": ("icon1", "dark")}
    assert read("{target}*.tif", "icon10.tif", **known)["target"] == "icon10"
    assert read("{target}*.tif", "darkroom.tif", **known)["target"] == "darkroom"
    assert read("{target}*.tif", "icon1_003.tif", **known)["target"] == "icon1"
    assert read("*{target}.tif", "semidark.tif", **known)["target"] != "dark"


def test_a_target_takes_as_much_as_it_can_where_nothing_is_declared():
    assert read("{target}_{shot}.tif", "my_icon_001.tif") == {"target": "my_icon", "shot": "001"}
    assert read("{target}_{band}.tif", "my_icon_red_1.tif", band=("red_1",)) == {
        "target": "my_icon",
        "band": "red_1",
    }


@pytest.mark.parametrize(
    "text",
    [
        "{traget}.tif",
        "{target.tif",
        "target}.tif",
        "a**/{target}.tif",
        "{target}/",
        "{target}/**",
        "",
        "*a" * 3000,
        "*a" * 12 + "{target}b.tif",
        "*{target}*{setup}*{band}*{sensor}*x.tif",
        "{target}" + "*{target}" * 6 + "x.tif",
        "**/a/" * 12 + "{target}b.tif",
    ],
)
def test_a_pattern_that_cannot_be_read_is_refused(text):
    with pytest.raises(ValueError):
        Pattern.parse(text)


@given(
    st.text(alphabet="abcXYZ-", min_size=1, max_size=8),
    st.integers(100, 2500),
    st.text(alphabet="0123456789", max_size=4),
)
def test_what_is_written_is_what_is_read(target, wavelength, shot):
    found = read(
        "raw/{target}/{wavelength}nm_{shot}.tif", f"raw/{target}/{wavelength}nm_{shot}.tif"
    )
    assert found == {"target": target, "wavelength": float(wavelength), "shot": shot}


MANY = {
    "three in a long name": ("{shot}a{target}a{band}a.tif", "a" * 240 + "c.tif"),
    "five in a name": ("*a{target}a{band}a{setup}a{sensor}ax.tif", "a" * 70 + "c.tif"),
    "a name that stands thrice": ("{target}*{target}*{target}x.tif", "ab" * 36 + "c.tif"),
    "folders over and over": ("**/a/**/a/{target}b.tif", "a/" * 50 + "c.tif"),
}


@pytest.mark.parametrize("what", MANY)
def test_a_name_with_many_readings_ends_soon(what):
    pattern, name = MANY[what]
    began = time.process_time()
    assert read(pattern, name) is None
    assert time.process_time() - began < 2


def test_a_long_name_with_too_many_readings_is_refused():
    with pytest.raises(Refused) as refused:
        read("*a{target}a{band}a{setup}a{sensor}ax.tif", "a" * 250 + "c.tif")
    assert refused.value.problems[0].code == "E_VALUE"
