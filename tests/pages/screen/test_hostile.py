"""Text from outside through every page, from file:// and over http: it is shown, and does nothing."""

from urllib.parse import quote

import pytest

from .database import write_hostile_database
from .hostile import TITLES, as_names

STATE = """() => ({
  evil: window.evil ?? null,
  title: document.title,
  head: document.querySelector('h1').textContent,
  told: [...document.querySelectorAll('.picker-a option, .reasons')].map(e => e.textContent),
  tags: Object.entries([...document.querySelectorAll('*:not(script[async])')].reduce((all, e) => {
    const name = e.tagName.toLowerCase(); all[name] = (all[name] ?? 0) + 1; return all; }, {})).sort(),
  attributes: [...document.querySelectorAll('*')].flatMap(e => [...e.attributes])
    .filter(a => /^on|^srcdoc$/i.test(a.name) || (/^(href|src|action|data|.*:href)$/i.test(a.name)
      && /^\\s*(javascript|vbscript|data:text)/i.test(a.value)))
    .map(a => a.name + '=' + a.value),
})"""


def test_there_are_sixty_and_no_two_are_alike():
    assert len(set(TITLES)) == len(set(as_names(TITLES))) == len(TITLES) == 60


@pytest.fixture(scope="module")
def folder(add_viewer, tmp_path_factory):
    names = ["plain", *as_names(TITLES)]
    root = tmp_path_factory.mktemp("hostile") / "database"
    write_hostile_database(root, ["A plain title", *TITLES], names)
    return add_viewer(root, title=TITLES[1], creator=TITLES[7], description=TITLES[12])


def page_of(name):
    return f"viewer/objects/{quote(name, safe='')}/index.html"


@pytest.mark.slow
@pytest.mark.parametrize(
    "how",
    [
        pytest.param(one, marks=[pytest.mark.slow] * (one not in ("http",)))
        for one in ["file", "http"]
    ],
)
def test_hostile_titles_and_file_names_are_shown_and_do_nothing(browser, serve, folder, how):
    base = folder.as_uri() if how == "file" else serve(folder)
    page = browser.open(f"{base}/index.html", width=900, height=500)
    state = page.evaluate(STATE)
    shown = page.locator(".card .title").all_text_contents()
    assert sorted(shown) == sorted(["A plain title", *TITLES])
    assert state["evil"] is None and state["attributes"] == []
    assert not {"script", "iframe", "object", "embed", "base", "svg", "math", "style"} & {
        name for name, count in state["tags"] if count > (name == "script")
    }
    links = page.evaluate("[...document.querySelectorAll('.card a')].map(a => a.href)")
    assert sorted(links) == sorted(f"{base}/{page_of(n)}" for n in ["plain", *as_names(TITLES)])
    plain = None
    for title, name in zip(["A plain title", *TITLES], ["plain", *as_names(TITLES)], strict=True):
        page.goto(f"{base}/{page_of(name)}", wait_until="domcontentloaded")
        state = page.evaluate(STATE)
        assert state["head"] == title, name
        assert state["evil"] is None and state["attributes"] == [], name
        tags = [
            t for t in state["tags"] if t[0] not in ("a",)
        ]  # the first and last have one link less
        plain = plain or tags
        assert tags == plain, name
        assert state["told"].count(title) >= 2, name


def test_a_spectrum_of_a_hostile_layer_is_read_and_saved_as_text(browser, folder):
    title = TITLES[57]
    page = browser.open(f"{folder.as_uri()}/{page_of(as_names(TITLES)[57])}")
    page.keyboard.press("r")
    page.wait_for_selector(".place[data-pixel]")
    page.locator(".numbers-fold summary").click()
    assert title in page.locator(".numbers tbody th").all_text_contents()
    with page.expect_download() as saved:
        page.get_by_role("button", name="Save as CSV").click()
    text = saved.value.path().read_text(encoding="utf-8")
    assert text.startswith("x,y,layer,band,wavelength_nm,value,sigma,flags,u,U\n")
    assert '"\'=HYPERLINK(""http' in text


@pytest.mark.slow
def test_read_me_and_the_page_of_the_crate_show_hostile_titles_as_text(
    browser, publish_with, tmp_path
):
    database = tmp_path / "database"
    names = as_names(TITLES)
    write_hostile_database(database, TITLES, names)
    folder = publish_with(database, TITLES[1], TITLES[7], analyse=["all"])
    told = {
        "README.html": [" ".join(title.split()) for title in TITLES],
        "ro-crate-preview.html": [f"{name}/" for name in names],
    }
    for page_name, texts in told.items():
        page = browser.open((folder / page_name).as_uri())
        state = page.evaluate(STATE)
        assert state["evil"] is None and state["attributes"] == [], page_name
        assert state["head"] == TITLES[1], page_name
        data = int(page_name == "ro-crate-preview.html")
        assert dict(map(tuple, state["tags"])).get("script", 0) == data, page_name
        foreign = {"iframe", "object", "embed", "base", "svg", "img", "form", "template", "video"}
        assert not foreign & {name for name, _ in state["tags"]}, page_name
        find = "[...document.querySelectorAll('td, summary')].map(e => e.firstChild?.data?.trim())"
        shown = {" ".join((text or "").split()) for text in page.evaluate(find)}
        assert {" ".join(text.split()) for text in texts} <= shown, page_name
        links = page.evaluate("[...document.querySelectorAll('a')].map(a => a.protocol)")
        assert set(links) <= {"file:", "https:"}, page_name


def test_a_policy_stops_a_script_that_got_into_a_page(browser, folder, tmp_path):
    page = folder / "viewer/objects/plain/index.html"
    broken = page.with_name("broken.html")
    broken.write_text(
        page.read_text("utf-8").replace("</main>", "</main><script>window.evil=1</script>"), "utf-8"
    )
    opened = browser.open(broken.as_uri())
    assert opened.evaluate("window.evil ?? null") is None
    assert any("Content Security Policy" in error for error in browser.errors)
    browser.errors.clear()
    broken.unlink()
