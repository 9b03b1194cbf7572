"""Several workbenches and an editor at one edits.toml: what was acknowledged is on the disk, once and for all."""

import subprocess
import sys
import threading
import tomllib

import pytest
from starlette.testclient import TestClient

from levkas.campaign.edits import FrameEdits, change_edits, read_edits
from levkas.core.locks import Taken, locked
from levkas.workbench.answer import from_bytes
from levkas.workbench.history import HISTORY_NAME
from levkas.workbench.library import Library, id_of
from levkas.workbench.server.app import make_app
from levkas.workbench.server.guard import cookie_of

TOKEN = "k" * 43
XRAY = f"/api/cameras/{id_of('icon', 'xray')}"


class Server:
    """A workbench of its own on a campaign, as another process has it."""

    def __init__(self, folder, port):
        self.origin = f"http://127.0.0.1:{port}"
        self.library = Library(folder)
        app = make_app(self.library, port=port, token=TOKEN)
        self.client = TestClient(app, base_url=self.origin, cookies={cookie_of(port): TOKEN})

    def edit(self, **body):
        headers = {"origin": self.origin}
        return self.client.post(f"{XRAY}/edit", json=body, headers=headers)

    def pairs(self):
        return from_bytes(self.client.get(f"{XRAY}/pairs").content)


@pytest.fixture
def folder(correctable, tmp_path):
    return correctable.make(tmp_path / "campaign")


@pytest.fixture
def servers(folder):
    return Server(folder, 4711), Server(folder, 4712)


def edits_of(folder):
    return read_edits(folder / "edits.toml").frames.get(("icon", "xray"), FrameEdits())


def place(number):
    return [10.0 + 3 * number, 20.0 + number, 15.0 + 2 * number, 30.0 + number]


@pytest.mark.slow
def test_nothing_that_was_acknowledged_is_lost_between_two_servers_and_an_editor(folder, servers):
    """60 edits of each, in threads; by hand a comment and a pair come into the file meanwhile."""
    lost, started = [], threading.Barrier(3)

    def work(server, numbers):
        started.wait()
        for number in numbers:
            if server.edit(operation="add", pair=place(number)).status_code != 200:
                lost.append(number)

    def write_by_hand():
        started.wait()
        path = folder / "edits.toml"
        while not path.exists() or "added" not in path.read_text():
            pass
        with locked(path.with_name(".edits.toml.lock")):  # an editor that saves in one step
            text = path.read_text().replace(
                "added = [", "added = [\n  # the nail\n  [1, 2, 3, 4],", 1
            )
            path.write_text("# seen on Monday\n" + text)

    jobs = [(work, servers[0], range(60)), (work, servers[1], range(60, 120)), (write_by_hand,)]
    threads = [threading.Thread(target=job, args=args) for job, *args in jobs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert lost == []
    for server in servers:
        server.library.settle()
    added = {tuple(place(n)) for n in range(120)} | {(1.0, 2.0, 3.0, 4.0)}
    assert set(edits_of(folder).added) == added
    text = (folder / "edits.toml").read_text()
    assert text.startswith("# seen on Monday\n") and "# the nail" in text
    assert [path.name for path in folder.glob(".edits*")] == [HISTORY_NAME]
    for server in servers:
        assert server.pairs()["corrections"].startswith("121 added")


def test_undo_takes_back_ones_own_change_and_nobody_elses(folder, servers):
    one, other = servers
    one.edit(operation="add", pair=place(1))
    other.edit(operation="add", pair=place(2))
    record = from_bytes(one.edit(operation="undo").content)
    assert edits_of(folder).added == (tuple(place(2)),)
    assert record["can"] == {"undo": 0, "redo": 1}
    one.edit(operation="redo")
    assert set(edits_of(folder).added) == {tuple(place(1)), tuple(place(2))}


@pytest.mark.parametrize(
    "first, second, field",
    [
        ({"operation": "pin"}, {"operation": "delete"}, "pinned"),
        ({"operation": "move", "to": place(3)}, {"operation": "move", "to": place(4)}, "moved"),
        ({"operation": "slide", "name": "stop", "value": 3}, {"operation": "slide", "name": "stop", "value": 2}, "stop"),
    ],
)  # fmt: skip
def test_a_change_that_contradicts_anothers_is_refused_with_what_is_there(
    folder, servers, first, second, field
):
    one, other = servers
    pair = from_bytes(one.client.get(f"{XRAY}/pairs").content)["pairs"][7].tolist()
    other.pairs()
    assert one.edit(**first, pair=pair).status_code == 200
    there = (folder / "edits.toml").read_bytes()
    answer = other.edit(**second, pair=pair)
    record = answer.json()
    assert answer.status_code == 409 and record["ok"] is False
    assert record["problems"][0]["code"] == "E_CONFLICT" and record["problems"][0]["fix"]
    assert record["present"][field] and (folder / "edits.toml").read_bytes() == there
    # Whoever was refused sees what is there, and may then change it.
    assert other.pairs()["corrections"] == one.pairs()["corrections"]
    assert other.edit(**second, pair=pair).status_code == 200
    assert (folder / "edits.toml").read_bytes() != there


def test_an_outline_that_another_drew_is_not_drawn_over_unseen(folder, servers):
    one, other = servers
    mine, theirs = (
        [[10.0, 10.0], [400.0, 12.0], [390.0, 320.0]],
        [[9.0, 9.0], [50.0, 9.0], [9.0, 50.0]],
    )
    other.pairs()
    assert from_bytes(one.edit(operation="outline", corners=mine).content)["outline"] == mine
    answer = other.edit(operation="outline", corners=theirs)
    assert answer.status_code == 409 and answer.json()["present"] == mine
    assert other.pairs()["outline"] == mine
    assert other.edit(operation="outline", corners=theirs).status_code == 200
    # What another has changed since is not taken back.
    one.pairs()
    assert one.edit(operation="undo").status_code == 200
    assert read_edits(folder / "edits.toml").outlines["icon"] == tuple(map(tuple, theirs))


def test_a_file_that_was_spoilt_by_hand_is_not_written_over(folder, servers):
    one, _ = servers
    one.edit(operation="add", pair=place(1))
    path = folder / "edits.toml"
    path.write_text(path.read_text() + "\n[objects\n")
    spoilt = path.read_bytes()
    answer = one.edit(operation="add", pair=place(2))
    assert answer.status_code == 422 and "edits.toml" in answer.json()["problems"][0]["file"]
    assert path.read_bytes() == spoilt
    path.write_bytes(spoilt.replace(b"\n[objects\n", b""))
    assert one.edit(operation="add", pair=place(2)).status_code == 200
    assert len(edits_of(folder).added) == 2


BY_HAND = """\
# Our own notes.
version = 1

[objects.icon.cameras.xray]  # the plate of 1931
# left edge
deleted = [
  # the nail
  [1, 2, 3, 4], # twice
  [5.001, 6, 7, 8],
]
stop = 2.25 # "by hand"

# Nothing was done to the other one.
[objects.icon2.cameras.xray]
added = [[1, 1, 1, 1]]
"""


def change(path, before, after, frame="xray"):
    return change_edits(path, "icon", lambda edits: frame, before, after)


def test_what_a_person_wrote_stays_where_it_is(tmp_path):
    path = tmp_path / "edits.toml"
    path.write_text(BY_HAND)
    before = read_edits(path).frames[("icon", "xray")]
    after = FrameEdits(deleted=(*before.deleted[1:], (9.0, 9.0, 9.0, 9.0)), pinned=((2.0, 2.0, 2.0, 2.0),),
                       stop=before.stop)  # fmt: skip
    assert change(path, before, after) == after
    text = path.read_text()
    for line in BY_HAND.splitlines():
        assert line in text or line == "  [1, 2, 3, 4], # twice", line
    assert text.index("pinned") < text.index("# Nothing was done") < text.index("icon2")
    assert read_edits(path).frames[("icon2", "xray")].added == ((1.0, 1.0, 1.0, 1.0),)
    change(path, FrameEdits(), FrameEdits(stop=3.0), "nir")
    text = path.read_text()
    assert tomllib.loads(text)["objects"]["icon"]["cameras"]["nir"] == {"stop": 3.0}
    assert change(path, after, FrameEdits()) == FrameEdits()
    assert (
        read_edits(path).of_layer("icon", "xray") == {} and "# Our own notes." in path.read_text()
    )


@pytest.mark.parametrize(
    "text",
    [
        'version = 1\nobjects = { icon = { cameras = { xray = { stop = 2.0 } } } }\n',
        "version = 1\nobjects.icon.cameras.xray.stop = 2.0\n",
        "version = 1\r\n[objects.icon.cameras.xray]\r\nstop = 2.0\r\n",
        "\ufeffversion = 1\n[objects.b.cameras.x]\nstop = 1\n[objects.icon.cameras.xray]\nstop = 2\n",
        "version = 1\n[objects.icon.cameras.xray]\nstop = 2\n[objects.b.cameras.x]\nstop = 1\n[objects.icon.cameras.nir]\nstop = 1\n",
    ],
)  # fmt: skip
def test_every_spelling_of_the_file_can_be_changed(tmp_path, text):
    path = tmp_path / "edits.toml"
    path.write_bytes(text.encode())
    others = {k: v for k, v in read_edits(path).frames.items() if k != ("icon", "xray")}
    before = FrameEdits(stop=2.0)
    after = FrameEdits(added=((1.0, 2.0, 3.0, 4.0),), stop=3.0)
    assert change(path, before, after) == after
    assert read_edits(path).frames == {**others, ("icon", "xray"): after}


def test_who_holds_the_lock_keeps_others_waiting_and_leaves_no_file(tmp_path):
    path = tmp_path / "lock"
    with locked(path), pytest.raises(Taken), locked(path, patience_s=0.05):
        pass
    with locked(path):
        assert path.exists()
    assert not path.exists()


def test_an_editor_that_saves_while_a_change_is_made_keeps_what_it_saved(tmp_path):
    """An editor takes no lock: its file comes between the reading and the writing of ours, once."""
    path = tmp_path / "edits.toml"
    path.write_text("version = 1\n")
    saved = iter([BY_HAND])

    def frame_of(edits):
        if text := next(saved, None):
            path.write_text(text)
        return "nir"

    change_edits(path, "icon", frame_of, FrameEdits(), FrameEdits(stop=3.0))
    assert path.read_text().startswith(BY_HAND)
    assert read_edits(path).frames[("icon", "nir")] == FrameEdits(stop=3.0)


WRITER = """
import sys
from pathlib import Path
from levkas.campaign.edits import FrameEdits, change_edits
known = FrameEdits()
for number in range(40):
    pair = (float(sys.argv[2]), float(number), 1.0, 1.0)
    wanted = FrameEdits(added=tuple(sorted((*known.added, pair))))
    known = change_edits(Path(sys.argv[1]), "icon", lambda edits: "xray", known, wanted)
"""


def test_two_processes_lose_nothing_and_a_lock_that_a_killed_one_left_is_no_lock(tmp_path):
    path = tmp_path / "edits.toml"
    (tmp_path / ".edits.toml.lock").touch()
    command = [sys.executable, "-c", WRITER, str(path)]
    runs = [subprocess.Popen([*command, name]) for name in ("1", "2")]
    assert [run.wait(timeout=600) for run in runs] == [0, 0]
    added = read_edits(path).frames[("icon", "xray")].added
    assert set(added) == {(float(n), float(i), 1.0, 1.0) for n in (1, 2) for i in range(40)}
    assert [p.name for p in tmp_path.iterdir()] == ["edits.toml"]
