"""The viewer as a part of a publication."""

import re
from urllib.parse import unquote

import pytest

from levkas.database.validation import validate
from levkas.pages.screen import ScreenMissing, read_built


@pytest.fixture
def built():
    try:
        read_built("sheet.js")
    except ScreenMissing:
        pytest.skip("the pages are not built: run `make frontend`")


def test_every_page_leads_to_what_stands_beside_it(database, publish, built):
    folder = publish(database, iiif=True)
    assert validate(folder).ok
    pages = [folder / "index.html", *sorted(folder.glob("viewer/objects/*/index.html"))]
    pages.append(folder / "README.html")
    for page in pages:
        links = re.findall(r'href="([^"#]+)"', page.read_text(encoding="utf-8"))
        inside = [unquote(link) for link in links if ":" not in link]
        missing = [link for link in inside if not (page.parent / link).is_file()]
        assert inside and missing == []
        assert "Creative Commons Attribution 4.0 International" in page.read_text(encoding="utf-8")
    assert "../../../iiif/icon1/manifest.json" in pages[1].read_text(encoding="utf-8")


def test_a_report_leads_to_the_viewer_once_there_is_one(database, publish, built):
    from levkas.database.manifest import write_manifest
    from levkas.pages.page import render_page

    address = "../../viewer/objects/icon1/index.html"
    page = render_page("report.html", page={"title": "Icon", "views": (), "viewer": address})
    (database / "objects/icon1/report.html").write_text(page, encoding="utf-8")
    write_manifest(database)
    assert f'<a hidden href="{address}">' in page
    folder = publish(database, iiif=False)
    made = (folder / "objects/icon1/report.html").read_text(encoding="utf-8")
    assert f'<a href="{address}">' in made and (folder / "objects/icon1" / address).is_file()
    assert made.replace("<a href", "<a hidden href") == page.replace("<a href", "<a hidden href")


def test_without_built_pages_the_viewer_is_left_out_and_that_is_said(database, monkeypatch):
    from levkas.publish import run
    from levkas.publish.viewer import run as viewing

    def missing(name):
        raise ScreenMissing(*NOT_BUILT)

    try:
        read_built("no-such-page.js")
    except ScreenMissing as error:
        NOT_BUILT = error.problems
    monkeypatch.setattr(viewing, "read_built", missing)
    steps = list(run.publish(database))
    output = run.summarise(steps).output
    assert not (output / "index.html").exists() and validate(output).ok
    assert len([step for step in steps if step.part == "viewer" and step.what]) == 1


def test_the_first_page_has_the_links_by_which_machines_find_licence_identifier_and_record():
    from levkas.publish.viewer.pages import About, render_sheet

    about = About("Icons", licence_url="https://example.org/by", doi="https://doi.org/10.5072/1")
    more = [{"label": "RO-Crate", "href": "ro-crate-metadata.json"}]
    head = render_sheet(about, [], more).partition("</head>")[0]
    assert '<link rel="cite-as" href="https://doi.org/10.5072/1">' in head
    assert '<link rel="license" href="https://example.org/by">' in head
    assert (
        '<link rel="describedby" type="application/ld+json" href="ro-crate-metadata.json">' in head
    )
    assert '<link rel="type" href="https://schema.org/Dataset">' in head
    assert "cite-as" not in render_sheet(About("Icons"), [])
