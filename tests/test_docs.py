import re
import sys
from pathlib import Path

import levkas

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"


def test_the_command_reference_is_what_the_commands_say(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    sys.modules.pop("write_commands", None)
    from write_commands import reference

    assert (DOCS / "commands.md").read_text(encoding="utf-8") == reference()


def test_every_public_name_loads_and_is_in_the_documentation():
    text = "\n".join(p.read_text(encoding="utf-8") for p in DOCS.glob("*.md"))
    for name in levkas.__all__:
        assert getattr(levkas, name) is not None
        assert name in text, name


def test_pages_of_the_documentation_are_in_its_index():
    listed = set(re.findall(r"^([a-z]+)$", (DOCS / "index.md").read_text(), re.MULTILINE))
    assert {p.stem for p in DOCS.glob("*.md")} - {"index"} == listed


def test_the_lock_file_names_no_registry_and_pins_by_hash():
    for name in ("requirements-render.lock", "requirements-peers.lock", "requirements-fuzz.lock"):
        assert "://" not in (ROOT / name).read_text()
    text = (ROOT / "requirements.lock").read_text()
    assert "://" not in text and text.count("--hash=sha256:") > 300


def test_the_lock_of_the_renderer_leaves_the_other_lock_as_it_is():
    def pinned(name):
        text = (ROOT / name).read_text()
        return set(re.findall(r"^([a-z0-9-]+==[^ ;\\]+)", text, re.MULTILINE))

    main, render = pinned("requirements.lock"), pinned("requirements-render.lock")
    added = {pin.partition("==")[0] for pin in render - main}
    assert added == {"mitsuba", "drjit"}
