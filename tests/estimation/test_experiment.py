import json

import numpy as np
import pytest
from typer.testing import CliRunner

import levkas
from levkas.cli import app
from levkas.core.problems import Refused
from levkas.database.reader import Database
from levkas.estimation.budget import DRAWS
from levkas.estimation.experiment import Paintings, run_experiment
from levkas.estimation.methods import METHODS as EVERY_METHOD
from levkas.estimation.plan import ExperimentPlan, choose_layers
from levkas.estimation.samples import SampleSource, training_of
from levkas.estimation.splits import split_at_random, split_paintings
from levkas.estimation.training import mean_square, sample_weights

METHODS = ("wiener", "pseudo-inverse")
pytestmark = pytest.mark.usefixtures("few_kernels")


def report_of(database, **options):
    options = {"methods": METHODS, "budget": False, **options}
    return list(run_experiment(ExperimentPlan(database, **options)))[-1].report


def command(*arguments):
    return CliRunner().invoke(app, ["estimate", *map(str, arguments)])


@pytest.fixture(scope="module")
def whole(paintings, few_kernels):
    """The report of three methods with the error budget."""
    return report_of(paintings, sources=["rgb"], methods=(*METHODS, "matern"), budget=True)


def test_defaults_are_the_broad_cameras_and_the_spectral_layer(paintings):
    target, groups = choose_layers(levkas.open(paintings), ExperimentPlan(paintings))
    assert target == "vis" and sorted(groups) == [("cam2",), ("rgb",)]


def test_each_painting_is_scored_while_it_is_held_out(whole):
    source = whole.sources[0]
    assert [f.name for f in source.split.folds] == ["icon1", "icon2", "icon3"]
    assert source.scores[0].objects == ["icon1", "icon2", "icon3"]
    assert source.pixels + source.gold_pixels == 3 * (40 * 48 - 7)


def test_the_ceiling_is_the_reference_s_sigma_and_all_scores_lie_above_it(whole):
    source = whole.sources[0]
    assert source.ceiling == pytest.approx(0.004, rel=1e-3)  # as it was planted
    assert all(score.rmse > source.ceiling for score in source.scores)


def test_random_pixels_are_easier_than_a_painting_of_other_pigments(whole):
    """A flexible method remembers the pigments it saw: unseen ones cost it half as much again, a linear one little."""
    source = whole.sources[0]
    random = {score.method: score.rmse for score in source.random}
    ratio = {score.method: score.rmse / random[score.method] for score in source.scores}
    assert ratio["matern"] > 1.5 and 1.0 < ratio["wiener"] < 1.2


def test_the_budget_grows_from_computed_to_real_and_with_the_shift(whole):
    """Patches of 4 px: a shift by one pixel moves a quarter of them into another paint."""
    for row in whole.sources[0].budget.rmse.values():
        assert row["computed"] < row["real"] * 1.05
        assert row["real"] < row["shift 0.5"] < row["shift 1"]
    assert whole.sources[0].budget.slope("wiener") > 0.02


def test_differences_of_the_budget_have_intervals_over_the_same_draws(whole):
    budget = whole.sources[0].budget
    for method, row in budget.draws.items():
        assert {len(values) for values in row.values()} == {DRAWS}
        apart = np.mean(np.subtract(row["shift 1"], row["real"]))
        half = budget.interval(method, "shift 1", "real")
        assert 0 < half < apart  # a shift of a pixel costs more than chance
        assert half < np.hypot(budget.interval(method, "shift 1"), budget.interval(method, "real"))


@pytest.mark.slow
def test_linear_methods_are_fitted_to_every_pixel_of_paint(paintings):
    """The pseudo-inverse of all training pixels, worked out apart."""
    report = report_of(paintings, sources=["rgb"], methods=["pseudo-inverse"], models=True)
    source = SampleSource(Database(paintings), "vis", 10**9)
    parts = [source.read(name, ("rgb",)) for name in Database(paintings)]
    paint = training_of([part.take(~part.gold) for part in parts])
    root = np.sqrt(sample_weights(paint))[:, None]
    expected = np.linalg.lstsq(root * paint.responses, root * paint.spectra, rcond=None)[0]
    (model,) = report.sources[0].models
    np.testing.assert_allclose(model.model.coefficients, expected, atol=1e-6)


def test_parameters_are_chosen_on_what_is_held_out_as_the_test_is(paintings):
    held = Paintings(SampleSource(Database(paintings), "vis", 10**9), 1)
    names = list(Database(paintings))
    by_painting = split_paintings(names, ("rgb",))
    at_random = split_at_random(names, ("rgb",))
    one = held.training(by_painting.folds[0], by_painting.grouping, mean_square)
    other = held.training(at_random.folds[0], at_random.grouping, mean_square)
    assert len(np.unique(one.groups)) == len(names) - 1 and other.groups is None


@pytest.mark.slow
def test_parameters_chosen_by_colour_have_no_larger_colour_difference(paintings):
    found = {}
    for choice in ("rmse", "delta-e"):
        report = report_of(
            paintings, sources=["rgb"], methods=["matern", "wiener"], choose_by=choice
        )
        assert report.to_dict()["choose_by"] == choice
        found[choice] = [s.summary()["delta_e_d65"]["mean"] for s in report.sources[0].scores]
    assert all(b <= a * 1.02 for a, b in zip(found["rmse"], found["delta-e"], strict=True))


def test_an_exposure_breaks_what_is_not_homogeneous(whole):
    rows = whole.sources[0].budget.rmse
    assert rows["pseudo-inverse"]["exposure 0.5"] == pytest.approx(rows["pseudo-inverse"]["real"])
    assert rows["wiener"]["exposure 0.5"] > rows["wiener"]["real"]


@pytest.mark.slow
def test_the_same_seed_gives_the_same_report_whatever_the_threads(paintings, monkeypatch):
    found = []
    for threads in ("1", "2"):
        monkeypatch.setenv("LEVKAS_THREADS", threads)
        methods = ("wiener", "matern", "gaussian-process")
        found.append(report_of(paintings, sources=["rgb"], methods=methods, test=["icon1"]))
    one, other = found
    assert json.dumps(one.to_dict()) == json.dumps(other.to_dict())
    assert one.tables() == other.tables()


@pytest.mark.slow
def test_layers_together_have_the_channels_of_both(paintings):
    report = report_of(paintings, sources=["rgb,cam2"], methods=["wiener"])
    assert report.sources[0].channels == 6 and report.sources[0].name == "rgb+cam2"


@pytest.mark.slow
def test_a_model_of_one_camera_is_tried_on_another(paintings):
    report = report_of(paintings, sources=["rgb", "cam2"], split="camera", methods=["wiener"])
    (source,) = report.sources
    assert len(source.split.folds) == 6 and source.split.folds[0].name == "rgb → cam2, icon1"


@pytest.mark.slow
def test_a_model_of_one_lighting_errs_under_another(paintings):
    """Red and blue were scaled by 1.1 and 0.9 under the other lighting."""
    split = report_of(paintings, sources=["rgb"], split="lighting", methods=["wiener"])
    same = report_of(paintings, sources=["rgb"], methods=["wiener"])
    assert split.sources[0].scores[0].rmse > 1.1 * same.sources[0].scores[0].rmse


def test_one_painting_is_estimated_from_its_own_blocks_and_the_text_says_so(one_painting):
    report = report_of(one_painting, sources=["rgb"])
    assert len(report.sources[0].split.folds) == 4 and "only painting" in report.text


@pytest.mark.parametrize(
    ("options", "code"),
    [
        (["--from", "rbg"], "E_VALUE"),
        (["--from", "raw"], "E_QUANTITY"),
        (["--to", "rgb"], "E_VALUE"),
        (["--from", "vis"], "E_VALUE"),
        (["--method", "wienr"], "E_METHOD"),
        (["--split", "paintings"], "E_VALUE"),
        (["--split", "chart"], "E_CHART_MISSING"),
        (["--train", "icon1", "--test", "icon1"], "E_SPLIT_LEAK"),
        (["--test", "icon9"], "E_VALUE"),
        (["--split", "random", "--train", "icon1"], "E_VALUE"),
        (["--split", "camera", "--test", "icon1"], "E_VALUE"),
        (["--method", "all", "--method", "wienr"], "E_METHOD"),
        (["--choose-by", "delta_e"], "E_VALUE"),
        (["--split", "camera", "--from", "rgb", "--from", "rgb,cam2"], "E_BAND_COUNT"),
    ],
)
def test_what_cannot_be_estimated_is_refused_with_status_1(paintings, options, code):
    ran = command(paintings, "--json", *options)
    report = json.loads(ran.stdout)
    assert ran.exit_code == 1 and not report["ok"]
    assert report["problems"][0]["code"] == code


def test_suggestions_name_what_was_meant(paintings):
    assert "Did you mean 'wiener'?" in command(paintings, "--method", "wienr").stderr
    assert "Did you mean 'painting'?" in command(paintings, "--split", "paintings").stderr


@pytest.mark.slow
def test_fewer_samples_than_coefficients_are_refused_by_the_method(paintings, monkeypatch):
    monkeypatch.setattr("levkas.estimation.experiment.TRAINING_PIXELS", 4)
    with pytest.raises(Refused) as refused:
        report_of(paintings, sources=["rgb,cam2"], methods=["wiener"])
    assert refused.value.problems[0].code == "E_TOO_FEW_SAMPLES"


@pytest.mark.slow
def test_the_command_ranks_every_method_where_none_is_named(paintings):
    ran = command(paintings, "--from", "rgb", "--test", "icon1", "--no-budget", "--json")
    assert ran.exit_code == 0, ran.stderr
    (result,) = json.loads(ran.stdout)["results"]
    errors = {one["method"]: one["metrics"]["rmse"]["mean"] for one in result["methods"]}
    assert errors.keys() == EVERY_METHOD.keys() and min(errors.values()) > 0
    assert max(errors.values()) < 0.2


@pytest.mark.slow
def test_the_command_writes_page_json_tables_maps_and_models(paintings, tmp_path):
    out = tmp_path / "out"
    ran = command(paintings, "--from", "rgb", "--method", "wiener", "--json", "-o", out)
    assert ran.exit_code == 0, ran.stderr
    record, kept = json.loads(ran.stdout), json.loads((out / "estimation.json").read_text())
    assert record["results"] == kept["results"] and record["command"] == "estimate"
    method = kept["results"][0]["methods"][0]
    assert method["method"] == "wiener" and set(method["metrics"]["rmse"]) == {
        "mean",
        "median",
        "p95",
        "max",
    }
    assert len(method["bands"]) == 16 and method["over_distance"]
    page = (out / "estimation.html").read_text(encoding="utf-8")
    assert (
        "Error budget" in page
        and "optimistic" in page
        and "http" not in page.replace("http-equiv", "").replace("http://www.w3.org", "")
    )
    for name in (
        "scores.csv",
        "bands.csv",
        "curves.csv",
        "budget.csv",
        "ranking.csv",
        "maps/rgb_wiener_icon2.png",
        "models/rgb_wiener.npz",
    ):
        assert (out / name).stat().st_size > 50, name
    assert (
        command(
            paintings, "--from", "rgb", "--method", "wiener", "-o", out, "--no-budget"
        ).exit_code
        == 0
    )


def test_error_maps_are_bright_where_the_errors_are(whole):
    import io

    from PIL import Image

    from levkas.pages.estimation import draw_maps

    source = whole.sources[0]
    errors = next(e for e in source.scores[0].errors if e.object == "icon2")
    png = draw_maps(source)[f"maps/rgb_{source.scores[0].method}_icon2.png"]
    grey = np.asarray(Image.open(io.BytesIO(png)).convert("L"), float)
    shown = grey[errors.rows, errors.columns]
    assert np.corrcoef(shown, np.minimum(errors.metrics["rmse"], 0.1))[0, 1] > 0.8
