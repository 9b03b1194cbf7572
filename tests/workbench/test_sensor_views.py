"""A camera of several sensors: each is looked at and corrected by itself."""

import json
import shutil

import numpy as np
import pytest

from levkas.campaign.campaign import load_campaign
from levkas.campaign.edits import read_edits
from levkas.geometry.transforms import Affine
from levkas.stages.control_points import corrections_of
from levkas.workbench.library import Library, id_of
from levkas.workbench.server.routes import describe_frame

SHIFT = np.array([7.0, -4.0])
"""From a place in the first sensor's picture to the same place in the second's."""


@pytest.fixture
def folder(correctable, folder):
    """The plates, the radiograph taken by two sensors of which the second is shifted."""
    text = (folder / "campaign.toml").read_text()
    head, _, rest = text.partition("[cameras.xray]")
    rest = rest[rest.index("[targets]") :]
    (folder / "campaign.toml").write_text(f"""{head}[cameras.xray]
kind = "sensors"
[[cameras.xray.sensors]]
name = "left"
files = "xray/{{target}}.png"
bands = ["grey"]
[[cameras.xray.sensors]]
name = "right"
files = "xray2/{{target}}.png"
bands = ["far"]
{rest}""")
    shutil.copytree(folder / "xray", folder / "xray2")
    place = folder / "database/objects/icon"
    for path in sorted((place / "native").glob("icon_xray.*")):
        for sensor in ("left", "right"):
            shutil.copy(path, path.with_name(path.name.replace("_xray", f"_xray_{sensor}")))
    record = json.loads((place / "registration/xray.json").read_text())
    record["bands"]["far"] = {"transform": Affine(_shifted(correctable)).to_dict()}
    (place / "registration/xray.json").write_text(json.dumps(record))
    lines = (place / "registration/xray.matches.csv").read_text().splitlines()
    (place / "registration/xray.right.matches.csv").write_text(
        "\n".join([lines[0], *(_moved(line) for line in lines[2:200])]) + "\n"
    )
    return folder


def _shifted(correctable):
    origin = correctable.truth([0.0, 0.0])
    slope = np.column_stack([correctable.truth(e) - origin for e in ([1.0, 0.0], [0.0, 1.0])])
    return np.column_stack([slope, origin + SHIFT])


def _moved(line):
    cells = line.split(",")
    cells[2], cells[3] = (str(float(v) + s) for v, s in zip(cells[2:4], SHIFT, strict=True))
    return ",".join(cells)


def test_every_sensor_has_its_own_pairs_and_its_own_map(folder, correctable):
    library = Library(folder)
    rows = [(r["camera"], r["sensor"], r["bands"]) for r in library.list()]
    assert rows == [("photo", "", "R, G, B"), ("xray", "left", "grey"), ("xray", "right", "far")]
    left = library.open(id_of("icon", "xray"))
    right = library.open(id_of("icon", "xray", "right"))
    assert (len(left.session.found.matches), len(right.session.found.matches)) == (241, 198)
    point = np.array([[200.0, 150.0]])
    assert np.allclose(right.built(point) - left.built(point), SHIFT)
    found = right.session.view.forward(point)[0] - correctable.truth([200.0, 150.0])
    assert np.abs(found - SHIFT).max() < 0.2


def test_a_correction_of_the_second_sensor_reaches_the_build_as_its_own(folder):
    library = Library(folder)
    right = library.open(id_of("icon", "xray", "right"))
    pair = np.hstack(
        [right.session.found.matches.reference[3], right.session.found.matches.target[3]]
    )
    right.session.apply("delete", pair.tolist())
    library.open(id_of("icon", "xray")).session.apply("add", [50.0, 60.0, 70.0, 80.0])
    frames = {frame for _, frame in read_edits(folder / "edits.toml").frames}
    assert frames == {"xray", "xray:far"}
    campaign = load_campaign(folder)
    capture = right.capture
    given, _ = corrections_of(campaign, capture)
    assert given["right"].deleted[0] == pytest.approx(pair, abs=0.006)
    assert given["left"].added.tolist() == [[50.0, 60.0, 70.0, 80.0]]
    again = Library(folder).open(id_of("icon", "xray", "right"))
    assert len(again.session.edits.deleted) == 1 and not again.session.edits.added


def test_each_sensor_shows_the_windows_that_its_own_map_rests_on(folder):
    path = folder / "database/objects/icon/registration/xray.json"
    record = json.loads(path.read_text())
    sensors = [{"sensor": "left"}, {"sensor": "right", "windows": {"x": [1.0]}, "count": 1}]
    path.write_text(json.dumps(record | {"trace": {"kind": "windows", "sensors": sensors}}))
    library = Library(folder)
    reported = [
        describe_frame(library.open(id_of("icon", "xray", name)))["basis"] for name in ("", "right")
    ]
    assert reported == [None, sensors[1]]
