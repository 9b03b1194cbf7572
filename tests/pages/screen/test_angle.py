"""The map of spectral angles to the pinned place, which the page computes from the numbers of the TIFF."""

import numpy as np
import pytest

from levkas.core.flags import MARKS
from levkas.database.tiff_pages import open_pages

from .database import SIZE
from .serving import pause
from .test_viewer import SETTLED, click_pixel, open_object, shown_colour
from .walking import faint, nameless

READ = """async () => {
  const { angles, state } = levkasViewer;
  return [...await angles.find(state.a.value.picture.angle).angles].map(a => Number.isNaN(a) ? null : a);
}"""
TRUSTED = np.uint8(sum(flag for flag, mark in MARKS.items() if mark.trusted))
GREY = [128, 128, 128]


def expected_angles(viewer, camera, x, y):
    """Angles in degrees by numpy, NaN of pixels of which a needed band is not to be trusted; and the bands."""
    base = viewer / f"objects/icon1/icon1_{camera}"
    values = open_pages(base.with_name(f"{base.name}.tif")).read().astype(float)
    flags = open_pages(base.with_name(f"{base.name}.flags.tif")).read() & ~TRUSTED
    needed = np.isfinite(values[y, x]) & (flags[y, x] == 0)
    values, flags = values[..., needed], flags[..., needed]
    lengths = np.linalg.norm(values, axis=2) * np.linalg.norm(values[y, x])
    angles = np.degrees(np.arccos(np.clip(values @ values[y, x] / lengths, -1, 1)))
    angles[flags.any(2)] = np.nan
    return angles, needed


def show_angle(page, x, y):
    click_pixel(page, x, y)
    page.keyboard.press("a")
    page.wait_for_function(
        f"() => levkasViewer.state.a.value.picture.key.startsWith('angle-{x}-{y}-')"
    )
    page.wait_for_function(SETTLED)
    return np.array(page.evaluate(READ), float).reshape(SIZE[::-1])


@pytest.mark.parametrize("how", ["file", pytest.param("http", marks=pytest.mark.slow)])
def test_the_angle_of_every_pixel_is_that_of_its_spectrum(browser, viewer, address, how):
    page = open_object(browser, address(how))
    # The second place is saturated in one band, which is then needed of no pixel.
    for place, bands in (((25, 25), 8), ((62, 41), 7)):
        found = show_angle(page, *place)
        wanted, needed = expected_angles(viewer, "vis", *place)
        assert needed.sum() == bands
        assert np.array_equal(np.isnan(found), np.isnan(wanted)) and np.isnan(found).any()
        # Of angles near 0 the cosine in single precision knows little.
        assert np.nanmax(np.abs(found - wanted)) < 0.05
        assert np.nanmax(np.abs(found - wanted)[wanted > 1]) < 1e-3


def test_alike_is_light_and_what_is_not_to_be_trusted_is_grey(browser, viewer, address):
    page = open_object(browser, address("file"))
    assert page.locator(".picker-a option[value=angle]").is_disabled()
    angles = show_angle(page, 25, 25)
    page.get_by_label("Largest angle shown in A").select_option("5")
    page.wait_for_function("() => levkasViewer.state.a.value.picture.key.endsWith('-5')")
    page.wait_for_function(SETTLED)
    page.keyboard.press("Escape")  # the pin lies over its pixel
    pause(page, 300)
    assert np.abs(shown_colour(page, 103, 103) - GREY).max() < 6  # veiled
    assert np.abs(shown_colour(page, 62, 42) - GREY).max() < 6  # saturated
    rows, columns = np.nonzero((angles > 0.3) & (angles < 1))
    x, y = int(columns[len(columns) // 2]), int(rows[len(rows) // 2])
    assert shown_colour(page, x, y)[0] > 200 and angles[y, x] < 1
    caption = page.locator("#caption").inner_text()
    assert caption == "vis, Spectral angle to 25, 25: not an identification"
    note = page.locator(".picker-a .note").first.inner_text()
    assert "Not an identification" in note and "Grey" in note
    assert page.locator(".picker-a .legend").inner_text().split("\n")[0].startswith("0°")
    assert nameless(page) == [] and faint(page) == []


@pytest.mark.slow
def test_the_address_holds_the_map_and_another_place_is_taken_on_demand(browser, address):
    page = open_object(browser, address("file"))
    show_angle(page, 25, 25)
    page.wait_for_function("() => location.hash.includes('angle-25-25-10')")
    again = open_object(browser, page.url)
    assert again.evaluate("levkasViewer.state.a.value.picture.angle.place") == [25, 25]
    take = again.locator(".picker-a").get_by_role("button", name="Take the pinned place")
    assert take.is_disabled()
    click_pixel(again, 95, 65)
    assert again.evaluate("levkasViewer.state.a.value.picture.angle.place") == [25, 25]
    take.focus()
    again.keyboard.press("Enter")
    again.wait_for_function("() => levkasViewer.state.a.value.picture.angle.place[0] === 95")
    again.keyboard.press("2")  # another layer is compared with the same place
    again.wait_for_function("() => levkasViewer.state.a.value.layer.name === 'nir'")
    assert again.evaluate("levkasViewer.state.a.value.picture.angle.place") == [95, 65]
    for nonsense in ("angle-9999-2-10", "angle-1-1-3", "angle-x-1-10"):
        other = open_object(browser, address("file", fragment=f"#a=vis/{nonsense}"))
        assert other.evaluate("levkasViewer.state.a.value.picture.key") == "colour"


def test_a_place_of_which_nothing_is_to_be_trusted_gives_no_map_and_that_is_said(browser, address):
    page = open_object(browser, address("file"))
    assert np.isnan(show_angle(page, 103, 103)).all()
    status = page.locator(".picker-a [role=status]")
    assert "no angle can be computed" in status.inner_text()
    assert np.isfinite(show_angle(page, 25, 25)).any()
    assert status.inner_text() == ""


def test_one_picture_has_one_pin(browser, address):
    page = open_object(browser, address("file", fragment="#a=vis/colour&pin=25,25"))
    pause(page, 300)
    seen = "[...document.querySelectorAll('.pin')].filter(e => e.checkVisibility()).length"
    assert page.evaluate(seen) == 1
    page.keyboard.press("s")
    page.wait_for_function(f"() => {seen} === 2")
