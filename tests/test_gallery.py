"""The scripts that draw figures of the paper: what they draw is true, and they are short and plain."""

import ast
import importlib
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

import levkas

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
SCRIPTS = sorted([*EXAMPLES.glob("figure_*.py"), *EXAMPLES.glob("notebook_*.py")])
DOCS = EXAMPLES.parent / "docs"
MODULES = {
    "levkas",
    "levkas.colour.gamut",
    "levkas.colour.illuminants",
    "levkas.calibration.noise_model",
    "levkas.planning",
    "levkas.quality.targets",
    "levkas.registration",
    "levkas.pages",
    "levkas.simulation",
}


@pytest.fixture(scope="module")
def script():
    """Return a function that imports a script by its name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        yield importlib.import_module


@pytest.fixture(scope="module")
def registration(script):
    return script("figure_9_registration").register_simulated_pair()


def decoded(path):
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


def curves(axes):
    return {line.get_label(): line.get_xydata() for line in axes.lines}


def area(corners):
    x, y = corners.T
    return np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda p: p.stem)
def test_a_script_is_short_and_rests_on_public_names(path):
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) < 60
    tree = ast.parse(text)
    assert f"python examples/{path.name}" in ast.get_docstring(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for name in node.names:
                assert not name.name.startswith("levkas.") or name.name in MODULES, name.name
        elif isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == "levkas":
            assert node.module in MODULES, node.module
            home = importlib.import_module(node.module)
            public = getattr(home, "__all__", [n for n in dir(home) if not n.startswith("_")])
            assert {name.name for name in node.names} <= set(public)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            assert node.value.id != "levkas" or node.attr in levkas.__all__, node.attr


def test_every_script_is_shown_in_the_documentation_and_run_by_a_test():
    shown = "\n".join(page.read_text(encoding="utf-8") for page in DOCS.rglob("*.md"))
    tests = Path(__file__).parent
    run = "\n".join(
        (tests / name).read_text(encoding="utf-8")
        for name in ("test_gallery.py", "test_tutorials.py", "estimation/test_example.py")
    )
    for path in EXAMPLES.glob("*.py"):
        assert path.name in shown, path.name
        assert re.search(rf"[\"/]{path.stem}(\.py)?\"", run), path.name


def test_the_gallery_shows_every_figure_with_its_script():
    text = (DOCS / "gallery.md").read_text(encoding="utf-8")
    for path in SCRIPTS:
        picture = f"images/{path.stem}.png"
        assert f"]({picture})" in text and (DOCS / picture).is_file()
        assert f"```{{literalinclude}} ../examples/{path.name}" in text


@pytest.mark.slow
def test_the_notebook_registers_two_cameras_on_arrays_alone(tmp_path, monkeypatch, capsys):
    out = tmp_path / "arrays.png"
    monkeypatch.setattr(sys, "argv", ["notebook_arrays.py", str(out)])
    found = runpy.run_path(str(EXAMPLES / "notebook_arrays.py"))
    assert decoded(out).std() > 5
    assert found["found"].verdict.decision == "accept" in capsys.readouterr().out
    assert len(found["errors"]) == 3 and np.mean(found["errors"]) < 0.15
    # On the pixels of the reference both cameras show the same reflectance, by about as much as bands differ.
    warped, reference = found["warped"], found["reference"]
    assert warped.values.shape == reference.values.shape
    sound = (warped.flags == 0).all(-1) & (reference.flags == 0).all(-1)
    observed = np.stack([warped.values[..., 1], reference.values[..., 1]], -1)[sound]
    assert sound.mean() > 0.5 and np.corrcoef(observed.T)[0, 1] > 0.9
    assert np.nanmedian(warped.variance) < np.median(found["colour"].sigma ** 2)


@pytest.mark.slow
def test_sampled_noise_lies_on_its_closed_form(script, tmp_path):
    figure = script("figure_3_noise").main(tmp_path / "3.png")
    assert decoded(tmp_path / "3.png").std() > 5
    drawn = curves(figure.axes[0])
    (e, closed), (at, sampled) = drawn["closed form"].T, drawn["sampled"].T
    assert np.abs(np.interp(np.log(at), np.log(e), closed) - sampled).max() < 0.03
    assert (np.diff(sampled) > 0).all() and sampled[0] < 6.6 and sampled[-1] > 17


@pytest.mark.slow
def test_the_grid_turns_the_icon_upright_and_leaves_the_table_out(script, tmp_path):
    figure = script("figure_8_grid").main(tmp_path / "8.png")
    assert decoded(tmp_path / "8.png").std() > 5
    source, result = (axes.images[0].get_array() for axes in figure.axes)
    assert source.shape == (260, 348, 3) and result.shape == (213, 159, 3)
    outline = figure.axes[0].lines[0].get_xydata()
    np.testing.assert_allclose(outline[0], [29.5, 233.5])  # bottom left comes to the top left
    np.testing.assert_allclose(outline[1], [29.5, 21.5])
    # The same picture by whole pixels: turned with numpy, cut out, every 4/3 of a pixel.
    turned = np.rot90(np.asarray(source), -1)[30:314, 26:238]
    rows, columns = (np.rint((np.arange(n) + 0.5) * 4 / 3 - 0.5).astype(int) for n in (213, 159))
    again = turned[np.ix_(rows, columns)]
    assert np.isfinite(result).all()
    assert np.corrcoef(again.ravel(), np.asarray(result).ravel())[0, 1] > 0.9


@pytest.mark.slow
def test_least_squares_goes_astray_until_the_outliers_are_cut(script, registration, tmp_path):
    figure = script("figure_9_registration").main(tmp_path / "9.png", registration)
    assert decoded(tmp_path / "9.png").std() > 5
    trace = registration.trace
    frames = [
        next(p for p in axes.patches if p.get_label() == "target, least squares").get_xy()[:4]
        for axes in figure.axes
    ]
    # Drawn is the fit that was made; before the cut it folds the target's frame.
    np.testing.assert_allclose(frames[1], trace.corners[0], atol=1e-3)
    np.testing.assert_allclose(frames[3], trace.corners[-1], atol=1e-3)
    region = next(p for p in figure.axes[3].patches if p.get_label() == "final region").get_xy()
    assert region.min() > 0 and (region.max(0) < trace.size).all()
    assert (region.min(0) > frames[3][0]).all() and (region.max(0) < frames[3][2]).all()
    areas = [area(frame) / np.prod(trace.size) for frame in frames]
    assert areas[0] < 0.5 and min(areas[1:]) > 1.0
    points = [curves(axes) for axes in figure.axes]
    assert all(np.diff([len(p["reference points"]) for p in points]) < 0)
    miss = np.linalg.norm(points[3]["reference points"] - points[3]["target points"], axis=1)
    assert miss.max() == pytest.approx(trace.largest[-1], abs=1e-3) and miss.max() <= trace.stop


def test_the_largest_error_falls_until_it_is_at_most_t2(script, registration, tmp_path):
    figure = script("figure_10_largest_error").main(tmp_path / "10.png", registration)
    assert decoded(tmp_path / "10.png").std() > 5
    drawn, trace = curves(figure.axes[0]), registration.trace
    largest = drawn["under the fit of each round"][:, 1]
    assert len(largest) > 10 and largest[-1] <= trace.stop < largest[-2]
    assert drawn["under scale alone"][0, 1] > trace.reject
    assert largest[0] > 10 * largest[-1]


@pytest.mark.slow
def test_the_gamut_of_reds_lies_where_red_is(script, tmp_path):
    folder = tmp_path / "database" / "objects" / "icon"
    folder.mkdir(parents=True)
    waves = list(range(400, 721, 20))
    spectrum = np.where(np.array(waves) > 590, 0.7, 0.05).astype(np.float32)
    values = np.linspace(0.5, 1, 12, dtype=np.float32)[:, None, None] * spectrum
    levkas.write_stiff(folder / "icon_lctf-vis.tif", values, waves, None, "{}")
    flags = np.zeros(values.shape, np.uint8)
    flags[0] = levkas.Flag.SATURATED
    levkas.write_stiff(folder / "icon_lctf-vis.flags.tif", flags, waves, None, "{}")
    figure = script("figure_12_gamut").main(tmp_path / "database", tmp_path / "12.png")
    assert decoded(tmp_path / "12.png").std() > 5
    assert [axes.get_xlabel() for axes in figure.axes] == ["a*", "a*", "b*"]
    assert len(figure.axes[0].lines[0].get_xydata()) == 2734
    cells = figure.axes[0].collections[0].get_offsets()
    assert len(cells) == 11 and cells[:, 0].min() > 40 and cells[:, 1].min() > 20


def test_previews_of_all_cameras_stand_side_by_side(script, tmp_path):
    from levkas.database.preview import write_preview

    folder = tmp_path / "database" / "objects" / "icon"
    folder.mkdir(parents=True)
    for k, camera in enumerate(("a", "b")):
        levels = np.full((12, 9, 3), 90 * k + 40, np.uint8)
        write_preview(folder / f"icon_{camera}.png", levels)
        levkas.write_stiff(
            folder / f"icon_{camera}.tif", levels.astype(np.float32), [450, 550, 650], levels, "{}"
        )
    figure = script("figure_13_previews").main(tmp_path / "database", tmp_path / "13.png")
    assert decoded(tmp_path / "13.png").std() > 5
    assert [axes.get_title() for axes in figure.axes] == ["(a) a: 3 bands", "(b) b: 3 bands"]
    assert [int(axes.images[0].get_array()[0, 0, 0]) for axes in figure.axes] == [40, 130]


@pytest.mark.slow
def test_snr_grows_with_the_signal_and_the_blurring_filter_is_seen_through(script, tmp_path):
    figure = script("figure_15_snr").main(tmp_path / "15.png")
    assert decoded(tmp_path / "15.png").std() > 5
    assert [len(axes.get_legend().texts) for axes in figure.axes] == [3, 7, 16, 6]
    for axes in figure.axes[:3]:
        for line in axes.lines:
            x, y = line.get_xydata().T
            assert line.get_label() == "IR" or np.corrcoef(np.log(x), y)[0, 1] > 0.97
    infrared, green = (curves(figure.axes[1])[label][:, 1] for label in ("IR", "G1"))
    above = infrared - green  # the two darkest patches, last, reflect 30 % in the infrared
    assert above[:4].max() < 0 and above[4:].min() > 0.8
    measured, corrected = (
        [line.get_ydata() for line in figure.axes[3].lines[k::2]] for k in (0, 1)
    )
    jump = [line[4] - line[5] for line in measured]  # 500 nm is blurred, 520 nm is not
    assert np.mean(jump) > 4
    mended = [line[4] - line[5] for line in corrected]
    assert abs(np.mean(mended)) < 0.8
    np.testing.assert_array_equal(measured[0][5:], corrected[0][5:])


def test_the_light_on_a_white_is_drawn_with_its_rectangle(script, tmp_path):
    y, x = np.mgrid[:120, :160]
    white = 3000 * np.exp(-((x - 90) ** 2 + (y - 60) ** 2) / 30_000) + 60
    for name, frame in (("dark", np.full(white.shape, 60)), ("white", white)):
        tifffile.imwrite(tmp_path / f"{name}.tif", frame.astype(np.uint16))
    out = tmp_path / "6b.png"
    figure = script("figure_6b_light").main(out, tmp_path / "dark.tif", [tmp_path / "white.tif"])
    assert decoded(out).std() > 5
    box = figure.axes[0].patches[0]
    middle = box.get_x() + box.get_width() / 2, box.get_y() + box.get_height() / 2
    assert abs(middle[0] - 45) < 8 and abs(middle[1] - 30) < 8  # of one phase: half the pixels


def test_close_ups_stand_setup_by_setup(script, tmp_path):
    from levkas.database.catalogue import entry_of, write_catalogue
    from levkas.database.preview import write_preview

    folder = tmp_path / "database" / "objects" / "icon"
    folder.mkdir(parents=True)
    rng = np.random.default_rng(1)
    levels = np.repeat(rng.integers(0, 99, (60, 80, 1), np.uint8), 3, 2)
    for stem, lifted in (("icon_a", 0), ("icon_a_45-degree", 90)):
        shown = levels + np.uint8(lifted)
        write_preview(folder / f"{stem}.png", shown)
        plane = shown.astype(np.float32)
        levkas.write_stiff(folder / f"{stem}.tif", plane, [450, 550, 650], shown, "{}")
    rows = [["icon", "a", setup, "3", "80", "60", "1", "reflectance", "accept", "0" * 64]
            for setup in ("", "45-degree")]  # fmt: skip
    write_catalogue(tmp_path / "database", [entry_of(row) for row in rows])
    figure = script("figure_4_setups").main(tmp_path / "database", tmp_path / "4.png")
    rows = [axes.get_ylabel() for axes in figure.axes if axes.get_ylabel()]
    assert rows == ["default setup", "45-degree"]
    first, second = (figure.axes[i].images[0].get_array() for i in (0, len(figure.axes) // 2))
    assert (np.asarray(second, int) - np.asarray(first, int) == 90).all()


def test_the_bench_shows_its_lamps_in_the_dark_field(script, tmp_path):
    figure = script("figure_5b_bench").main(tmp_path / "5b.png")
    assert decoded(tmp_path / "5b.png").std() > 5
    above, beside = figure.axes
    assert "6°, with facets 41°" in above.get_title()
    assert "5°, with facets 40°" in beside.get_title()
    lamps = [line.get_xydata()[0] for line in above.lines if line.get_label() == "lamp"]
    angles = np.degrees(np.arctan2(*np.array(lamps).T))
    np.testing.assert_allclose(np.sort(angles), [-70, 70], atol=0.01)


def test_a_filter_brings_halogen_to_daylight(script, tmp_path):
    figure = script("figure_6a_spectra").main(tmp_path / "6a.png")
    drawn = curves(figure.axes[0])
    named = {label.split(":")[0]: points[:, 1] for label, points in drawn.items()}
    for one, other in (("behind the D50 filter", "CIE D50"), ("behind the D65 filter", "CIE D65")):
        inside = slice(30, 165)  # 440 to 710 nm
        assert np.abs(named[one] - named[other])[inside].mean() < 0.05
    assert np.abs(named["halogen"] - named["CIE D50"]).mean() > 0.2


def test_the_light_drops_by_less_than_ten_per_cent_in_the_frame(script, tmp_path):
    figure = script("figure_6b_planned").main(tmp_path / "6b.png")
    assert "drops by 7.7 %" in figure.axes[0].get_title()
    along = curves(figure.axes[1])["along the width"]
    assert along[:, 1].min() > 60 and abs(along[np.abs(along[:, 0]) < 5, 1].mean() - 98) < 3


def test_sensitivities_are_drawn_channel_by_channel(script, tmp_path):
    figure = script("figure_7_sensitivities").main(tmp_path / "7.png")
    assert [len(axes.lines) for axes in figure.axes] == [51, 3, 7]
    title = figure.axes[2].get_title(loc="left")
    assert "weakest under the proposed light B2" in title
    assert "R1:G1:B1:R2:G2:B2:IR = 1.6:2.4:1.2:2.6:1.3:1.0:1.5" in title  # as the paper has them
