"""The workbench in a real browser, over its real server."""

import io

import numpy as np
import pytest
from PIL import Image

from levkas.campaign.edits import Edits, FrameEdits, read_edits, round_pair, write_edits
from levkas.workbench.library import id_of

from .serving import READY, TOKEN, opened, pause, told

OUTLINE = [[60.0, 50.0], [360.0, 60.0], [350.0, 290.0], [70.0, 280.0]]


def place(page, pane, x, y):
    return page.evaluate(f"levkasWorkbench.stage.{pane}.pageOf({x}, {y})")


def click(page, pane, x, y):
    page.mouse.click(*place(page, pane, x, y))


def choose_worst(page):
    page.keyboard.press("w")
    page.wait_for_function("() => levkasWorkbench.store.selected.value >= 0")


def rotation(page, pane="left"):
    script = f"levkasWorkbench.stage.{pane}.viewer.viewport.getRotation(true)"
    return page.evaluate(script) % 360


def test_the_planted_wrong_pair_is_deleted_and_undone_and_numbers_stay(bench):
    page, server = bench
    before = told(page, "session.value.summary.max")
    assert before > 3.5
    choose_worst(page)
    assert page.locator("#pair-head").inner_text() == "Pair 1"
    page.keyboard.press("Delete")
    assert told(page, "session.value.summary.max") < 0.6
    assert len(server.edits.deleted) == 1
    assert told(page, "selected.value") > 0, "the next pair is chosen"
    page.locator(".filters button", has_text="By hand").click()
    assert page.locator(".rows .row").count() == 1
    page.keyboard.press("Control+z")
    assert told(page, "session.value.summary.max") == pytest.approx(before)
    assert server.edits == FrameEdits()
    page.keyboard.press("Control+Shift+z")
    page.locator("#take-back").click()
    assert told(page, "session.value.corrections") == "" and server.edits == FrameEdits()
    page.locator(".filters button", has_text="Used").click()
    choose_worst(page)
    page.keyboard.press("p")
    told(page, "session.value.version")
    assert len(server.edits.pinned) == 1
    page.keyboard.press("p")
    assert told(page, "session.value.corrections") == "" and server.edits.pinned == ()


def test_a_pair_is_added_moved_by_arrows_snapped_and_typed(bench, correctable, browser):
    page, server = bench
    choose_worst(page)  # flies there, so that single pixels are large
    page.keyboard.press("Escape")
    spot = [216.4, 160.3]
    click(page, "left", *spot)
    page.wait_for_selector("#pair-accept")
    pair = told(page, "proposal.value.pair")
    assert np.abs(np.array(pair[:2]) - spot).max() < 0.5
    assert np.linalg.norm(np.array(pair[2:]) - correctable.truth(pair[:2])) < 0.3
    page.wait_for_function("() => document.querySelectorAll('.loupe:not([hidden])').length === 2")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Shift+ArrowDown")
    page.keyboard.press("Enter")
    assert told(page, "session.value.state.length") == 242
    (added,) = server.edits.added
    assert added[2:] == pytest.approx((pair[2] + 0.1, pair[3] + 1.0), abs=0.011)
    page.keyboard.press("j")
    told(page, "session.value.version")
    (snapped,) = server.edits.added
    assert np.linalg.norm(np.array(snapped[2:]) - correctable.truth(snapped[:2])) < 0.3
    page.evaluate("levkasWorkbench.store.choose({ row: 241 })")  # it was moved too far to be kept
    page.evaluate(  # faster than they are saved
        """() => { for (let i = 0; i < 12; i++)
        dispatchEvent(new KeyboardEvent('keydown', { key: 'ArrowRight', shiftKey: i < 2 })); }"""
    )
    page.wait_for_function(
        f"() => Math.abs(levkasWorkbench.store.selectedPair()[2] - {snapped[2] + 3}) < 0.02"
    )
    field = page.get_by_label("Here x")
    field.fill(f"{snapped[2] + 2:.2f}")
    field.press("Enter")
    page.wait_for_function(
        f"() => Math.abs(levkasWorkbench.store.selectedPair()[2] - {snapped[2] + 2}) < 0.02"
    )
    page.get_by_label("Reference y").fill("-40")
    page.get_by_label("Reference y").press("Enter")
    page.locator("#refused").wait_for()
    browser.errors.clear()  # the browser tells of the answer 422 by itself


def test_a_pixel_is_drawn_where_it_is_said_to_be(correctable, inspected, browser, tmp_path):
    """One white pixel on black, native (150, 90) of the reference, is white at its place on screen."""
    server = inspected(correctable.make(tmp_path / "campaign"))
    from levkas.workbench.pictures import ShownPicture

    pixels = np.full((340, 420), 20, np.uint8)
    pixels[90, 150] = 255
    frame = server.library.open(id_of("icon", "xray"))
    dark = np.full((520, 620), 20, np.uint8)
    frame.read = lambda capture, band: ShownPicture(pixels if capture.camera == "photo" else dark)
    page = opened(browser, server)
    page.keyboard.press("h")
    page.evaluate("levkasWorkbench.stage.left.look(150, 90, 24)")
    page.wait_for_function(READY)
    pause(page, 300)
    screen = Image.open(io.BytesIO(page.screenshot())).convert("L")

    def shown(x, y):
        return screen.getpixel(tuple(round(v) for v in place(page, "left", x, y)))

    assert min(shown(150 + off, 90 + off) for off in (0, 0.4, -0.4)) > 150
    assert max(shown(150.7, 90), shown(149.3, 90), shown(150, 90.7), shown(150, 89.3)) < 80


@pytest.mark.slow
def test_both_pictures_show_the_same_place_upright_and_turned(bench, correctable):
    page, _ = bench
    page.evaluate(
        "levkasWorkbench.stage.left.look(200, 150, 4); levkasWorkbench.stage.left.onView()"
    )
    centre = page.evaluate("levkasWorkbench.stage.right.centre")
    assert np.linalg.norm(np.array(centre) - correctable.truth([200, 150])) < 1.5
    assert rotation(page, "right") == pytest.approx(354, abs=0.5)
    page.keyboard.press("t")
    page.wait_for_function("() => levkasWorkbench.store.frame.value.turn === 90")
    page.wait_for_function(READY)
    assert rotation(page) == 90 and rotation(page, "right") == pytest.approx(84, abs=0.5)
    page.reload()
    page.wait_for_function(READY)
    assert rotation(page) == 90
    page.keyboard.press("Shift+T")
    page.wait_for_function("() => levkasWorkbench.store.frame.value.turn === 0")


@pytest.mark.slow
def test_a_person_faster_than_the_pictures_stays_where_they_went(bench):
    """A mode whose pictures come late does not take back where a key led meanwhile."""
    page, _ = bench
    page.evaluate(
        """() => { const stage = levkasWorkbench.stage, load = stage.load.bind(stage);
        stage.load = async () => { await new Promise((go) => setTimeout(go, 400)); await load(); }; }"""
    )
    seen = "[...levkasWorkbench.stage.left.centre, levkasWorkbench.stage.left.scale]"
    page.keyboard.press("c")
    choose_worst(page)
    page.keyboard.press("s")
    page.wait_for_function(READY)
    pair = page.evaluate("levkasWorkbench.store.selectedPair()")
    assert np.allclose(page.evaluate(seen), [*pair[:2], 3], atol=[1, 1, 0.1])
    page.keyboard.press("c")
    page.keyboard.press("+")
    page.wait_for_function(READY)
    pause(page, 500)
    assert np.allclose(page.evaluate(seen), [*pair[:2], 4.5], atol=[1, 1, 0.1])


def test_the_windows_that_a_map_rests_on_are_told(bench):
    page, _ = bench
    assert not page.locator(".basis").is_visible()
    page.evaluate(
        """() => { const frame = levkasWorkbench.store.frame;
        const column = [10, 100, 180];
        const shift_x = [0.01, 0.02, -0.01], shift_y = [0, 0.01, 0];
        const windows = { x: column, y: column, shift_x, shift_y, sigma: [0.02, 0.02, null],
            held_out: [0.03, 0.05, null], weight: [1, 1, 0.2] };
        const checks = { x: column, y: column, shift_x: [0, 0, 9], shift_y, found: [true, true, true],
            tolerance: 1 };
        frame.value = { ...frame.value,
            basis: { source: "fused", band: "R", count: 3, windows, checks } }; }"""
    )
    words = page.locator("#basis-words").inner_text()
    assert words.startswith("3 windows") and "2 of 3 free windows of R" in words


def test_a_place_is_measured_and_kept_as_check_point_but_for_one_that_cannot_be_compared(bench):
    page, server = bench
    page.keyboard.press("c")
    page.wait_for_function(READY)
    click(page, "left", 230, 120)
    page.wait_for_selector("#measured strong")
    assert float(page.locator("#measured").inner_text().split(" px")[0]) < 0.3
    page.locator("#pair-accept").click()
    assert told(page, "session.value.summary.checks") == len(server.edits.checks) == 1
    page.evaluate(
        """() => { const { store } = levkasWorkbench; const pair = [10, 10, 20, 20];
        store.choose({ measured: { pair, predicted: pair, shift: [3, 4], length: 5, length_mm: 2.5,
          score: 0.13, sure: false } }); }"""
    )
    assert page.locator("#pair-accept").is_disabled()
    page.keyboard.press("Enter")
    assert told(page, "session.value.summary.checks") == 1


@pytest.fixture
def refused(correctable, inspected, browser, tmp_path):
    """The workbench of a refused camera that has no pairs and shows nothing but noise: (page, server)."""
    folder = correctable.make(tmp_path / "campaign", matched=False)
    width, height = correctable.xray_size
    noise = np.random.default_rng(1).integers(5, 250, (height, width))
    correctable.write_layer(folder, "icon", "xray", noise.astype(np.uint8))
    server = inspected(folder)
    return opened(browser, server), server


@pytest.mark.slow
def test_before_there_is_a_map_pictures_are_turned_and_paired_by_hand(refused, correctable):
    page, server = refused
    assert (rotation(page), rotation(page, "right")) == (0, 0)
    page.locator("#turn-alone").click()
    assert (rotation(page), rotation(page, "right")) == (0, 90)
    canvases = page.locator(".pane .openseadragon-canvas")
    for spot in ([70, 60], [330, 70], [320, 270], [80, 260]):
        there = correctable.truth(spot)
        for pane, (x, y) in enumerate((spot, there)):
            side = ("left", "right")[pane]
            canvases.nth(pane).focus()
            page.evaluate(f"levkasWorkbench.stage.{side}.look({x}, {y}, 3)")
            pause(page, 100)
            page.keyboard.press("i")
            page.wait_for_selector("#pair-accept")
            if not pane and len(server.edits.added) >= 3:
                page.keyboard.press("ArrowRight")  # noise is like nothing: a person places it
                break
        page.keyboard.press("Enter")
        page.wait_for_function("() => levkasWorkbench.store.proposal.value === null")
        told(page, "session.value.version")
        page.keyboard.press("Escape")
    added = np.array(server.edits.added)
    assert len(added) >= 3
    assert np.abs(correctable.truth(added[:3, :2]) - added[:3, 2:]).max() < 40


@pytest.mark.slow
def test_a_refused_camera_is_placed_by_hand_and_by_its_picture_again(
    turned_plates, inspected, browser, tmp_path
):
    from levkas.building import build, status

    folder = turned_plates.make(tmp_path / "campaign", names=["bad"])
    list(build(folder))
    spots = np.array([[80.0, 70], [220, 60], [225, 190], [90, 200], [150, 130]])
    rows = np.hstack([spots, turned_plates.truth(spots)])
    page = opened(browser, inspected(folder))
    assert page.locator("#by-hand").is_hidden(), "there are no pairs yet"
    given = FrameEdits(added=tuple(sorted(round_pair(row) for row in rows)))
    write_edits(folder / "edits.toml", Edits({("bad", "xray"): given}))
    page.reload()
    page.locator("#by-hand").click()
    badge = "document.querySelector('.verdict .badge').textContent"
    page.wait_for_function(f"() => {badge} === 'placed by hand'", timeout=180_000)
    assert read_edits(folder / "edits.toml").frames["bad", "xray"].accept == "by hand"
    page.locator("#by-hand").click()
    page.wait_for_function(
        f"() => !['placed by hand', 'refused'].includes({badge})", timeout=180_000
    )
    assert read_edits(folder / "edits.toml").frames["bad", "xray"].accept == ""
    report = status(folder)
    assert {s.state for s in report.stages if s.key.layer == "xray"} == {"fresh"} and report.ok


@pytest.mark.slow
def test_a_doubtful_layer_is_confirmed_and_the_word_taken_back(
    doubtful, inspected, browser, tmp_path
):
    import shutil

    folder = shutil.copytree(doubtful, tmp_path / "campaign")
    page = opened(browser, inspected(folder))
    page.locator("nav button", has_text="infrared").click()
    page.locator("#confirm-head").click()
    page.locator("#confirm-name").fill("Doe, Jané")
    page.locator("#confirm-words").fill("the contours agree")
    page.locator("#confirm").click()
    page.locator("#unconfirm").wait_for()
    (word,) = read_edits(folder / "edits.toml").confirmed.values()
    assert (word.name, word.words) == ("Doe, Jané", "the contours agree")
    assert word.words in page.locator(".verdict").inner_text()
    page.locator("#unconfirm").click()
    page.locator("#confirm-head").wait_for()
    assert read_edits(folder / "edits.toml").confirmed == {}
    page.locator("#confirm-head").click()
    assert page.locator("#confirm-name").input_value() == "Doe, Jané"
    page.locator("nav button", has_text="xray").click()
    page.locator(".verdict .badge.refuse").wait_for()
    assert page.locator("#confirm-head").is_hidden() and page.locator("#unconfirm").is_hidden()


@pytest.mark.slow
def test_every_mode_shows_both_pictures_and_moves_none(bench):
    page, _ = bench
    pictures, tops = set(), set()
    for key, mode in zip(
        "sckdb", ("side", "curtain", "flicker", "difference", "checker"), strict=True
    ):
        page.keyboard.press(key)
        page.wait_for_function(f"() => levkasWorkbench.stage.mode.value === '{mode}'")
        page.wait_for_function(READY)
        pause(page, 250)
        pictures.add(page.locator(".pane").first.screenshot())
        tops.add(page.locator(".views").bounding_box()["y"])
    assert len(pictures) == 5 and len(tops) == 1
    page.keyboard.press("h")
    pause(page, 250)
    assert page.locator("#marks").get_attribute("aria-pressed") == "false"
    page.keyboard.down(" ")
    page.wait_for_function("() => levkasWorkbench.stage.flicker.running")
    page.keyboard.up(" ")
    page.wait_for_function("!levkasWorkbench.stage.flicker.running")


@pytest.mark.slow
def test_a_pair_is_dragged_in_an_overlay(bench):
    page, server = bench
    choose_worst(page)
    page.keyboard.press("c")
    page.wait_for_function("() => levkasWorkbench.stage.left.keys.length === 2")
    page.wait_for_function(READY)
    pair = told(page, "selectedPair()")
    start = page.evaluate(
        "(() => { const s = levkasWorkbench.stage; return s.left.pageOf(...s.seenAt(levkasWorkbench.store.selectedPair())); })()"
    )
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(start[0] + 60, start[1] + 10, steps=4)
    assert server.edits == FrameEdits()
    page.mouse.up()
    told(page, "session.value.version")
    (moved,) = server.edits.moved
    assert moved[:4] == pytest.approx(pair, abs=0.011)
    assert np.abs(np.subtract(moved[6:], pair[2:])).max() > 5


@pytest.mark.slow
def test_any_band_and_three_as_colours_are_shown(bench):
    page, _ = bench
    assert page.locator(".pane").nth(1).locator(".bands").is_hidden()  # a radiograph has one
    shown = "() => levkasWorkbench.stage.left.keys[0].includes('bands={}')"
    page.get_by_label("Band of the reference picture").select_option("0")
    page.wait_for_function(shown.format("0"))
    page.get_by_label("Band of the reference picture").select_option("three")
    page.wait_for_function(shown.format("2,1,0"))
    page.get_by_label("Band shown as red, reference picture").select_option("1")
    page.wait_for_function(shown.format("1,1,0"))
    page.evaluate("() => document.activeElement.blur()")
    page.keyboard.press(">")
    page.wait_for_function(shown.format("2"))


@pytest.mark.slow
def test_points_are_saved_and_come_back(bench, tmp_path):
    page, server = bench
    page.evaluate("levkasWorkbench.stage.left.look(300, 250, 3)")
    click(page, "left", 310.2, 262.7)
    page.wait_for_selector("#pair-accept")
    page.keyboard.press("Enter")
    assert told(page, "session.value.pairs.length") == 242
    (added,) = server.edits.added
    page.locator("#files").click()
    with page.expect_download() as download:
        page.locator("#export").click()
    path = tmp_path / download.value.suggested_filename
    download.value.save_as(path)
    page.keyboard.press("Escape")
    page.locator("#undo").click()
    assert told(page, "session.value.pairs.length") == 241 and server.edits.added == ()
    page.locator("#files").click()
    page.locator("#import").set_input_files(path)
    page.wait_for_function("() => levkasWorkbench.store.session.value.pairs.length === 242")
    assert server.edits.added == (pytest.approx(added, abs=0.011),)


@pytest.mark.slow
def test_an_outline_is_drawn_corrected_undone_and_removed(bench, browser):
    page, server = bench

    def drawn():
        told(page, "refused.value")
        return np.array(read_edits(server.edits_path).outlines.get("icon", ()))

    page.locator("#outline").click()
    for corner in ([60, 50], [350, 290], [350, 60], [60, 280]):
        click(page, "left", *corner)
    page.keyboard.press("Enter")
    assert told(page, "refused.value") and len(drawn()) == 0, "it crosses itself, and stays open"
    for _ in range(4):
        page.keyboard.press("Delete")
    for corner in [*OUTLINE, OUTLINE[0]]:
        click(page, "left", *corner)
    assert np.abs(drawn() - OUTLINE).max() < 1.0 and told(page, "stale.value") is True
    page.mouse.move(*place(page, "left", *drawn()[1]))
    page.mouse.down()
    page.mouse.move(*place(page, "left", 380, 40), steps=5)
    page.mouse.up()
    assert np.abs(drawn()[1] - (380, 40)).max() < 1.0
    click(page, "left", 210, 285)
    added = drawn()[3]
    assert len(drawn()) == 5 and np.abs(added - (210, 285)).max() < 6.0
    page.keyboard.press("Shift+ArrowRight")
    assert drawn()[3] == pytest.approx(added + np.array([10, 0]), abs=0.02)
    page.keyboard.press("Delete")
    assert len(drawn()) == 4
    for _ in range(4):
        page.keyboard.press("Control+z")
    assert np.abs(drawn() - OUTLINE).max() < 1.0
    click(page, "left", 200, 170)
    assert told(page, "proposal.value") is None, "clicks are of the outline"
    page.locator("#outline-remove").click()
    assert len(drawn()) == 0 and told(page, "stale.value") is False
    assert all("422" in error for error in browser.errors)
    browser.errors.clear()


def test_a_verdict_is_as_of_the_last_registration_only_until_the_next(bench):
    page, server = bench
    assert told(page, "stale.value") is False
    choose_worst(page)
    page.keyboard.press("Delete")
    words = told(page, "session.value.corrections")
    assert told(page, "stale.value") is True
    frame = server.library.open(id_of("icon", "xray"))
    assert server.library.registered_with(frame)["registered"] is None
    page.evaluate(
        f"""() => {{ const {{ frame }} = levkasWorkbench.store;
        frame.value = {{ ...frame.value, registered: {words!r} }}; }}"""
    )
    assert told(page, "stale.value") is False


@pytest.mark.slow
def test_the_keyboard_is_enough_and_without_the_token_nothing_is_shown(bench, browser):
    page, server = bench
    page.locator(".scroll").focus()
    page.keyboard.press("ArrowDown")
    assert told(page, "selected.value") == 0
    page.keyboard.press("?")
    assert page.locator("dialog.help").is_visible()
    page.keyboard.press("Escape")
    page.keyboard.press("]")
    page.wait_for_function("() => levkasWorkbench.store.frame.value.camera === 'photo'")
    assert TOKEN not in page.url and page.evaluate("document.cookie") == ""
    other = browser.open(server.address.partition("#")[0])
    other.locator("main.alone h1").wait_for()
    browser.errors.clear()  # the browser tells of the answer 401 by itself


NAMES = ["icon'1", "icon&amp;", "icon#1", "icon;rm -rf", "icon$(id)", "-icon", "icon+1", "(icon)", "icon^",
         "ícône", "アイコン", "😀", "icon&#0;", "__proto__"]  # fmt: skip
HOSTILE = '<script>alert(1)</script></title>"><img src=x onerror=alert(1)>{{7*7}}<base href=//evil.example>'


@pytest.mark.slow
def test_hostile_titles_and_names_are_only_text(correctable, inspected, browser, tmp_path):
    folder = correctable.make(
        tmp_path / "campaign", names=NAMES, title=HOSTILE, texts={"reason": HOSTILE}
    )
    page = opened(browser, inspected(folder))
    assert page.locator(".campaign").text_content() == HOSTILE
    assert page.locator(".verdict li").first.text_content() == HOSTILE
    assert page.locator("script").count() == 1 and page.locator("iframe, object, base").count() == 0
    assert page.locator("nav h2").count() == len(NAMES)
    for name in NAMES[::6]:
        page.evaluate(f"levkasWorkbench.store.open('{id_of(name, 'xray')}')")
        page.wait_for_function(
            "(name) => levkasWorkbench.store.frame.value.object === name", arg=name
        )
        assert page.locator("h1").text_content() == f"{name} · xray"
    page.keyboard.press("w")
    page.keyboard.press("Delete")
    page.evaluate("levkasWorkbench.store.settled()")
    assert [name for name, _ in read_edits(folder / "edits.toml").frames] == [NAMES[::6][-1]]


ASK_ALL = """async ([base, token]) => {
  const seen = [];
  const post = (body) => ({ method: 'POST', body: JSON.stringify(body), credentials: 'include',
                            headers: { 'content-type': 'application/json' } });
  const asks = [['/', {}], ['/api/cameras', { credentials: 'include' }], ['/assets/workbench.js', {}],
    ['/api/cameras/IDENT/pairs', { credentials: 'include' }], ['/enter', post({ token })],
    ['/api/cameras/IDENT/edit', post({ operation: 'delete', pair: [1, 2, 3, 4] })]];
  for (const [path, how] of asks) {
    try { const answer = await fetch(base + path, how); seen.push(answer.status); }
    catch { seen.push('blocked'); }
  }
  return seen;
}""".replace("IDENT", id_of("icon", "xray"))


@pytest.mark.slow
def test_a_page_of_another_origin_reads_nothing(served, browser, tmp_path, serve):
    (tmp_path / "index.html").write_text("<!doctype html><title>evil</title>")
    (tmp_path / "favicon.ico").write_bytes(b"")
    base = f"http://127.0.0.1:{served.port}"
    browser.allow(base)
    page = browser.open(f"{serve(tmp_path)}/")
    assert set(page.evaluate(ASK_ALL, [base, TOKEN])) == {"blocked"}
    browser.errors.clear()
