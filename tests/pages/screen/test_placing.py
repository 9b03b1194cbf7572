"""What helps to place pairs: loupe, marks, arrows, numbers that are typed, pictures that stand upright."""

import io
import re

import numpy as np
import pytest
from PIL import Image

from levkas.workbench.history import HISTORY_NAME
from levkas.workbench.library import id_of

from .serving import READY, opened, pause, told


def pixels(page, locator):
    return np.asarray(
        Image.open(io.BytesIO(page.locator(locator).first.screenshot())).convert("L"), int
    )


def rotation(page, pane="left"):
    script = f"levkasWorkbench.stage.{pane}.viewer.viewport.getRotation(true)"
    return page.evaluate(script) % 360


def choose_worst(page):
    page.keyboard.press("w")
    page.wait_for_function("() => levkasWorkbench.store.selected.value >= 0")


@pytest.mark.slow
def test_a_loupe_shows_both_ends_of_the_pair_that_is_placed(bench, correctable):
    page, _ = bench
    assert page.locator(".loupe:visible").count() == 0
    spot = [216.4, 160.3]
    x, y = page.evaluate(f"levkasWorkbench.stage.left.pageOf({spot[0]}, {spot[1]})")
    page.mouse.click(x, y)
    page.wait_for_selector("#pair-accept")
    page.wait_for_function("() => document.querySelectorAll('.loupe:not([hidden])').length === 2")
    pause(page, 600)
    shown = page.evaluate(
        """() => [...document.querySelectorAll('.loupe')].map((c) =>
        [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data].filter((_, i) => i % 4 === 0))"""
    )
    ours, theirs = (np.array(values, float) for values in shown)
    # A radiograph is the negative of the photograph: turned and scaled alike, the loupes oppose each other.
    assert ours.std() > 3 and np.corrcoef(ours, theirs)[0, 1] < -0.8
    target = correctable.truth([250.0, 190.0])
    x, y = page.evaluate(f"levkasWorkbench.stage.right.pageOf({target[0]}, {target[1]})")
    page.mouse.move(x, y)
    pause(page, 500)
    moved = page.evaluate(
        """() => { const c = document.querySelectorAll('.loupe')[1];
        return [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data].filter((_, i) => i % 4 === 0); }"""
    )
    assert np.abs(np.array(moved, float) - theirs).mean() > 3, "the other one follows the pointer"
    page.keyboard.press("l")
    page.keyboard.press("l")
    page.wait_for_function("() => document.querySelectorAll('.loupe:not([hidden])').length === 0")
    assert page.locator("#loupe").input_value() == "never"


@pytest.mark.slow
def test_marks_go_and_come_and_only_those_that_the_table_lists_are_there(bench):
    page, _ = bench
    with_marks = pixels(page, ".marks")
    page.keyboard.press("h")
    pause(page, 200)
    without = pixels(page, ".marks")
    assert np.abs(with_marks - without).max() > 60
    assert page.locator("#marks").get_attribute("aria-pressed") == "false"
    page.keyboard.press("h")
    pause(page, 200)
    assert np.abs(pixels(page, ".marks") - with_marks).max() < 20
    # A pair that was removed is no mark while the table lists those in use: a click there adds.
    choose_worst(page)
    pair = told(page, "selectedPair()")
    page.keyboard.press("Delete")
    told(page, "session.value.version")
    page.keyboard.press("Escape")
    page.evaluate(f"levkasWorkbench.stage.look({pair[0]}, {pair[1]}, 6)")
    pause(page, 300)
    x, y = page.evaluate(f"levkasWorkbench.stage.left.pageOf({pair[0]}, {pair[1]})")
    page.mouse.click(x, y)
    page.wait_for_selector("#pair-accept")
    page.keyboard.press("Escape")
    page.locator(".filters button", has_text="Removed").click()
    page.mouse.click(x, y)
    page.wait_for_function("() => levkasWorkbench.store.selected.value >= 0")


def test_of_marks_that_lie_close_the_worst_are_shown_until_one_zooms_in(bench):
    page, _ = bench
    told_of = page.get_by_text(re.compile(r"^\d+ of 241 marks$"))
    first = int(told_of.inner_text().split()[0])
    assert 60 < first < 241
    page.keyboard.press("+")
    page.keyboard.press("+")
    page.wait_for_function(
        "(first) => parseInt(document.querySelectorAll('.label')[1].textContent) > first", arg=first
    )
    choose_worst(page)
    page.evaluate("levkasWorkbench.stage.look(210, 170, 20)")
    page.wait_for_function("() => document.querySelectorAll('.label')[1].hidden")
    page.keyboard.press("h")
    page.keyboard.press("f")
    pause(page, 300)
    assert told_of.is_hidden(), "no marks, no number of them"


def test_residuals_are_drawn_as_arrows_as_long_as_is_said(bench):
    page, _ = bench
    page.keyboard.press("Shift+H")
    assert page.locator("#times").input_value() == "20"
    pause(page, 200)
    long = pixels(page, ".marks")
    page.locator("#times").select_option("100")
    pause(page, 200)
    assert np.abs(pixels(page, ".marks") - long).max() > 60
    page.evaluate("() => document.activeElement.blur()")
    page.keyboard.press("Shift+H")
    assert page.locator("#times").input_value() == "1"


def test_the_next_pair_is_chosen_after_a_deletion_and_numbers_stay(bench):
    page, _ = bench
    choose_worst(page)
    rows = page.locator(".rows .row .c-row")
    first, second, third = sorted(
        ((float(row.evaluate("e => e.parentElement.style.top").rstrip("px")), row.inner_text())
         for row in rows.all()),
    )[:3]  # fmt: skip
    assert page.locator("#pair-head").inner_text() == f"Pair {first[1]}"
    page.keyboard.press("Delete")
    page.wait_for_selector(f"#pair-head:has-text('Pair {second[1]}')")
    page.keyboard.press("Delete")
    page.wait_for_selector(f"#pair-head:has-text('Pair {third[1]}')")
    page.wait_for_function("levkasWorkbench.stage.sees(levkasWorkbench.store.selectedPair())")
    page.locator("#take-back").click()
    page.wait_for_function("() => levkasWorkbench.store.session.value.corrections === ''")
    page.keyboard.press("Control+z")
    told(page, "session.value.version")
    assert "2 deleted" in told(page, "session.value.corrections")


def test_undo_is_there_after_the_server_was_started_anew(bench, browser, inspected):
    page, server = bench
    choose_worst(page)
    page.keyboard.press("Delete")
    told(page, "session.value.version")
    server.library.settle()
    again = opened(browser, inspected(server.folder))
    assert again.locator("#undo").is_enabled()
    again.keyboard.press("Control+z")
    assert told(again, "session.value.corrections") == ""


def test_coordinates_are_typed(bench, browser):
    page, server = bench
    choose_worst(page)
    pair = told(page, "selectedPair()")
    field = page.get_by_label("Here x")
    field.fill(f"{pair[2] + 2:.2f}")
    field.press("Enter")
    page.wait_for_function(
        "() => levkasWorkbench.store.session.value.corrections.includes('moved')"
    )
    (moved,) = server.edits.moved
    assert moved[6] == pytest.approx(pair[2] + 2, abs=0.011) and moved[4:6] == moved[:2]
    assert page.locator("#pair-head").inner_text() == "Pair 1"
    page.get_by_label("Reference y").fill("-40")
    page.get_by_label("Reference y").press("Enter")
    page.wait_for_selector("#refused:has-text('outside the picture')")
    browser.errors.clear()  # the browser tells of the answer 422 by itself


def test_a_pair_follows_arrows_that_are_pressed_faster_than_it_is_saved(bench):
    page, server = bench
    choose_worst(page)
    pair = told(page, "selectedPair()")
    page.evaluate(
        """() => { for (let i = 0; i < 12; i++)
        dispatchEvent(new KeyboardEvent('keydown', { key: 'ArrowRight', shiftKey: i < 2 })); }"""
    )
    wanted = pytest.approx([*pair[:2], pair[2] + 3, pair[3]], abs=0.02)
    page.wait_for_function(
        f"() => Math.abs(levkasWorkbench.store.selectedPair()[2] - {pair[2] + 3}) < 0.02"
    )
    (moved,) = server.edits.moved
    assert list(moved[4:]) == wanted


@pytest.mark.slow
def test_pictures_are_turned_by_quarters_and_stay_so(bench, browser, correctable):
    page, server = bench
    page.keyboard.press("t")
    page.wait_for_function("() => levkasWorkbench.store.frame.value.turn === 90")
    page.wait_for_function(READY)
    assert rotation(page) == 90 and min(abs(rotation(page, "right") - 84), 6) < 0.5
    # What lies right of the middle in the picture lies below it on screen.
    at = [page.evaluate(f"levkasWorkbench.stage.left.pageOf({x}, 170)") for x in (210, 260)]
    assert abs(at[0][0] - at[1][0]) < 0.5 and at[1][1] > at[0][1] + 20
    centre = page.evaluate("levkasWorkbench.stage.left.centre")
    page.keyboard.press("+")
    page.keyboard.press("ArrowRight")
    pause(page, 400)
    moved = page.evaluate("levkasWorkbench.stage.left.centre")
    assert abs(moved[0] - centre[0]) < 1 and moved[1] < centre[1] - 5, "right on screen is up in it"
    page.keyboard.press("f")
    page.keyboard.press("c")
    page.wait_for_function(READY)
    pause(page, 300)
    clip = page.evaluate(
        "(() => { const c = levkasWorkbench.stage.left.layers[1].getClip(); return [c.x, c.y, c.width, c.height]; })()"
    )
    assert clip[:3] == [0, 0, 420] and clip[3] == pytest.approx(170, abs=2)
    again = opened(browser, server)
    again.wait_for_function("() => levkasWorkbench.store.frame.value.turn === 90")
    assert rotation(again) == 90
    assert '"turn": 90' in (server.folder / HISTORY_NAME).read_text().replace('":90', '": 90')
    again.keyboard.press("Shift+T")
    again.wait_for_function("() => levkasWorkbench.store.frame.value.turn === 0")


OPPOSITE = {"ArrowRight": "ArrowLeft", "ArrowDown": "ArrowUp"}


@pytest.fixture
def refused(correctable, inspected, browser, tmp_path):
    """The workbench of a refused camera that has no pairs and shows nothing but noise: (page, server)."""
    folder = correctable.make(tmp_path / "campaign", matched=False)
    width, height = correctable.xray_size
    noise = np.random.default_rng(1).integers(5, 250, (height, width))
    correctable.write_layer(folder, "icon", "xray", noise.astype(np.uint8))
    server = inspected(folder)
    return opened(browser, server), server


def test_before_there_is_a_map_one_picture_is_turned_by_itself(refused):
    page, _ = refused
    assert (rotation(page), rotation(page, "right")) == (0, 0)
    page.locator("#turn-alone").click()
    assert (rotation(page), rotation(page, "right")) == (0, 90)
    page.locator(".pane .openseadragon-canvas").nth(1).focus()
    page.keyboard.press("t")
    assert (rotation(page), rotation(page, "right")) == (0, 180)
    page.locator(".pane .openseadragon-canvas").first.focus()
    page.keyboard.press("t")
    page.wait_for_function("() => levkasWorkbench.store.frame.value.turn === 90")
    assert (rotation(page), rotation(page, "right")) == (90, 270)
    # All of it stays in view: 620 x 520 px on its side.
    for x, y in ((0, 0), (619, 519)):
        at = page.evaluate(f"levkasWorkbench.stage.right.placeOf({x}, {y})")
        box = page.locator(".pane").nth(1).bounding_box()
        assert 0 < at[0] < box["width"] and 0 < at[1] < box["height"]


@pytest.mark.slow
def test_a_refused_camera_gets_its_pairs_with_the_keyboard_alone(refused, correctable):
    page, server = refused
    keys = page.keyboard

    def walk(pane, to):
        """Bring a place to the middle as nearly as steps of the arrows do."""
        script = f"[levkasWorkbench.stage.{pane}.centre, levkasWorkbench.stage.{pane}.scale]"
        centre, scale = page.evaluate(script)
        height = page.locator(".pane").first.bounding_box()["height"]
        steps = ((np.array(to) - centre) * scale / (0.15 * height)).round()
        for name, count in zip(("ArrowRight", "ArrowDown"), steps, strict=True):
            for _ in range(int(abs(count))):
                keys.press(name if count > 0 else OPPOSITE[name])

    page.locator(".pane .openseadragon-canvas").first.focus()
    for _ in range(3):
        keys.press("+")
    page.locator(".pane .openseadragon-canvas").nth(1).focus()
    for _ in range(3):
        keys.press("+")
    page.locator(".pane .openseadragon-canvas").first.focus()
    pause(page, 500)
    for number, spot in enumerate(([70, 60], [330, 70], [320, 270], [80, 260]), 1):
        walk("left", spot)
        keys.press("i")
        page.wait_for_selector("#pair-accept")
        wanted = correctable.truth(told(page, "proposal.value.pair")[:2])
        if number <= 3:
            assert "press I" in page.locator(".pair").inner_text()
            assert page.evaluate(
                "document.activeElement === levkasWorkbench.stage.right.viewer.canvas"
            )
            walk("right", wanted)
            keys.press("i")
        at = np.array(told(page, "proposal.value.pair")[2:])
        assert np.abs(at - wanted).max() < 40
        for name, px in zip(("ArrowRight", "ArrowDown"), (wanted - at).round(), strict=True):
            for _ in range(int(abs(px))):
                keys.press(f"Shift+{name if px > 0 else OPPOSITE[name]}")
        keys.press("Enter")
        page.wait_for_function(
            f"() => levkasWorkbench.store.session.value.pairs.length === {number}"
        )
        keys.press("Escape")
    added = np.array(server.edits.added)
    assert np.abs(correctable.truth(added[:, :2]) - added[:, 2:]).max() < 1.2
    page.locator("#by-hand").focus()
    assert page.evaluate("document.activeElement.id") == "by-hand"
    assert page.locator("#turn-alone").is_hidden(), "the map turns it now"


def test_a_place_that_cannot_be_compared_is_no_check_point(bench):
    page, _ = bench
    page.keyboard.press("c")
    page.wait_for_function(READY)
    page.evaluate(
        """() => { const { store } = levkasWorkbench; const pair = [10, 10, 20, 20];
        store.choose({ measured: { pair, predicted: pair, shift: [3, 4], length: 5, length_mm: 2.5,
          score: 0.13, sure: false } }); }"""
    )
    words = page.locator("#measured").inner_text()
    assert "likeness 13 %" in words and "5.00 px" not in words
    assert page.locator("#pair-accept").is_disabled()
    page.keyboard.press("Enter")
    assert told(page, "session.value.summary.checks") == 0


@pytest.mark.slow
def test_differences_are_amplified_and_choosing_a_mode_moves_no_picture(bench):
    page, _ = bench
    tops = {}
    for key in "sckdby":
        page.keyboard.press(key)
        page.wait_for_function(READY)
        tops[key] = page.locator(".views").bounding_box()["y"]
    assert len(set(tops.values())) == 1
    page.keyboard.press("d")
    page.wait_for_function(READY)
    gain = page.get_by_label("Amplify")
    gain.fill("1")
    pause(page, 300)
    plain = pixels(page, ".pane .openseadragon-canvas").mean()
    gain.fill("8")
    pause(page, 300)
    assert pixels(page, ".pane .openseadragon-canvas").mean() > 1.2 * plain


def test_a_verdict_is_as_of_the_last_registration_only_until_the_next(bench):
    page, server = bench
    assert "as of" not in page.locator(".verdict").inner_text()
    choose_worst(page)
    page.keyboard.press("Delete")
    page.wait_for_selector(".verdict:has-text('as of the last registration')")
    words = told(page, "session.value.corrections")
    frame = server.library.open(id_of("icon", "xray"))
    assert server.library.registered_with(frame)["registered"] is None
    page.evaluate(
        f"""() => {{ const {{ frame }} = levkasWorkbench.store;
        frame.value = {{ ...frame.value, registered: {words!r} }}; }}"""
    )
    assert "as of" not in page.locator(".verdict").inner_text()
    assert "Your corrections: 1 deleted" in page.locator("#corrections").inner_text()


def test_the_errors_by_round_are_saved_as_drawing_and_as_numbers(bench, tmp_path):
    page, _ = bench
    for words, suffix in (("Save as SVG", ".svg"), ("Save as CSV", ".csv")):
        with page.expect_download() as download:
            page.locator(".trace").get_by_role("button", name=words).click()
        path = tmp_path / download.value.suggested_filename
        download.value.save_as(path)
        assert path.name == f"icon_xray_removal{suffix}"
        text = path.read_text()
        if suffix == ".svg":
            assert "Largest error, px" in text and "where the removal stops" in text
            assert "var(" not in text
        else:
            assert text.splitlines()[0] == "round,largest_error_px,removed_pair"
            assert float(text.splitlines()[1].split(",")[1]) == pytest.approx(3.96, abs=0.05)
