"""Files that viewers turn by their EXIF orientation: proposed by `look`, upright on the grid, said where they are not."""

from io import BytesIO

import numpy as np
import pytest
import tifffile
from PIL import Image, ImageOps

from levkas.building import build, status, summarise
from levkas.campaign.guess import look
from levkas.database.pixel_frames import warn_of_turns
from levkas.readers.frames import read_facts
from levkas.readers.orientation import UPRIGHT

ORIENTATION = 274
SIZE = (120, 80)


def scene():
    """A picture of which no turn and no mirror image is the same: the red quarter at the top left, a green stripe right."""
    height, width = SIZE[1], SIZE[0]
    picture = np.random.default_rng(1).integers(60, 120, (height, width, 3), np.uint8)
    picture[: height // 2, : width // 2] = (200, 40, 40)
    picture[:, -width // 8 :] = (40, 200, 40)
    return Image.fromarray(picture)


def stored(turn):
    """The pixels that a viewer shows as the scene under an orientation."""
    back = {
        2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180,
        4: Image.Transpose.FLIP_TOP_BOTTOM, 5: Image.Transpose.TRANSPOSE,
        6: Image.Transpose.ROTATE_90, 7: Image.Transpose.TRANSVERSE, 8: Image.Transpose.ROTATE_270,
    }  # fmt: skip
    return scene().transpose(back[turn]) if turn in back else scene()


def write(path, turn, kind="jpeg"):
    path.parent.mkdir(parents=True, exist_ok=True)
    if kind == "tiff":
        tag = (ORIENTATION, "H", 1, turn, True)
        tifffile.imwrite(path, np.asarray(stored(turn)), photometric="rgb", extratags=[tag])
        return
    exif = Image.Exif()
    exif[ORIENTATION] = turn
    data = BytesIO()
    stored(turn).save(
        data, "png" if kind == "png" else "jpeg", quality=98, subsampling=0, exif=exif
    )
    path.write_bytes(data.getvalue())
    shown = np.asarray(ImageOps.exif_transpose(Image.open(path)), float)
    assert np.abs(shown - np.asarray(scene())).mean() < 6  # a viewer shows the scene


@pytest.mark.parametrize(("turn", "kind"), [(1, "jpeg"), (2, "tiff"), (3, "png"), (5, "jpeg")])
def test_readers_return_the_orientation_and_leave_pixels_as_they_are_stored(tmp_path, turn, kind):
    write(tmp_path / f"a.{kind}", turn, kind)
    facts = read_facts(tmp_path / f"a.{kind}")
    assert facts.orientation == (turn if turn > 1 else None)
    assert facts.shape[:2] == stored(turn).size[::-1]


def grid_of(folder):
    proposal = look(folder)
    (folder / "campaign.toml").write_text(proposal.text)
    return proposal


@pytest.mark.parametrize(
    ("turn", "kind"),
    [
        (6, "jpeg"),
        (5, "tiff"),
        *(pytest.param(t, "jpeg", marks=pytest.mark.exhaustive) for t in (2, 3, 4, 7, 8)),
    ],
)
def test_a_phone_photograph_ends_upright_where_the_proposal_is_taken(tmp_path, turn, kind):
    write(tmp_path / f"phone/icon1.{kind}", turn, kind)
    proposal = grid_of(tmp_path)
    assert proposal.to_dict().get("grid", {}) == {
        key: value for key, value in zip(("mirror", "rotate"), UPRIGHT.get(turn, (False, 0)), strict=True) if value
    }  # fmt: skip
    report = summarise(build(tmp_path))
    assert report.ok and not any("EXIF" in line for line in report.warnings)
    camera = proposal.cameras[0].name
    layer = next((tmp_path / "database/objects/icon1").glob(f"icon1_{camera}.png"))
    shown = np.asarray(Image.open(layer).convert("RGB").resize(SIZE), float)
    height, width = SIZE[1], SIZE[0]
    corner = shown[: height // 2, : width // 2].mean((0, 1))
    stripe = shown[:, -width // 10 :].mean((0, 1))
    assert corner[0] > 2 * corner[1] and stripe[1] > 2 * stripe[0]


def test_a_grid_that_is_not_turned_is_named_by_the_build_and_by_map(tmp_path):
    write(tmp_path / "phone/icon1.jpeg", 6)
    text = look(tmp_path).text
    write(tmp_path / "two/phone/icon1.jpeg", 6)
    write(tmp_path / "two/phone/icon2.jpeg", 8)
    assert not look(tmp_path / "two").grid  # objects that are turned otherwise
    (tmp_path / "campaign.toml").write_text(
        text.replace("[grid]\nrotate = 90", "[grid]\nrotate = 0")
    )
    report = summarise(build(tmp_path))
    (said,) = (line for line in report.warnings if "rotate = 90" in line)
    assert said in status(tmp_path).warnings
    database, camera = tmp_path / "database", text.partition("[cameras.")[2].partition("]")[0]
    assert len(warn_of_turns(database, "icon1", ("grid", camera))) == 1
    assert warn_of_turns(database, "icon1", ("grid",)) == []


def test_points_of_a_turned_file_are_evaluated_with_a_warning(tmp_path):
    from levkas.quality.evaluation.layer_report import assess

    write(tmp_path / "phone/icon1.jpeg", 6)
    write(tmp_path / "scan/icon1.png", 1, "png")
    cameras = "".join(
        f'[cameras.{name}]\nkind = "image"\nfiles = "{name}/{{target}}.{kind}"\n'
        for name, kind in (("phone", "jpeg"), ("scan", "png"))
    )
    (tmp_path / "campaign.toml").write_text('[campaign]\nreference = "scan:G"\n' + cameras)
    assert not [line for line in summarise(build(tmp_path)).warnings if "EXIF" in line]
    (tmp_path / "points.csv").write_text(
        "object,camera,band,reference_x,reference_y,x,y\nicon1,phone,,30,20,20,89\n"
    )
    problems = assess(tmp_path / "database", points=tmp_path / "points.csv").problems
    assert [p.code for p in problems] == ["E_TURNED"]
