import json

import numpy as np
import pytest
from typer.testing import CliRunner

import levkas
from levkas.cli import app
from levkas.core.problems import Refused
from levkas.database.reader import Database
from levkas.estimation.experiment import Paintings, run_experiment
from levkas.estimation.methods import METHODS as EVERY_METHOD
from levkas.estimation.plan import ExperimentPlan, choose_layers
from levkas.estimation.samples import SampleSource, training_of
from levkas.estimation.splits import split_paintings
from levkas.estimation.training import mean_square, sample_weights

METHODS = ("wiener", "pseudo-inverse")
pytestmark = pytest.mark.usefixtures("few_kernels")


def report_of(database, **options):
    options = {"methods": METHODS, **options}
    return list(run_experiment(ExperimentPlan(database, **options)))[-1].report


def command(*arguments):
    return CliRunner().invoke(app, ["estimate", *map(str, arguments)])


@pytest.fixture(scope="module")
def whole(paintings, few_kernels):
    """The report of three methods."""
    return report_of(paintings, sources=["rgb"], methods=(*METHODS, "matern"))


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
    one = held.training(split_paintings(names, ("rgb",)).folds[0], mean_square)
    blocks = held.training(split_paintings(names[:1], ("rgb",)).folds[0], mean_square)
    assert len(np.unique(one.groups)) == len(names) - 1 < len(np.unique(blocks.groups))


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


@pytest.mark.slow
def test_the_same_seed_gives_the_same_report_whatever_the_threads(paintings, monkeypatch):
    found = []
    for threads in ("1", "2"):
        monkeypatch.setenv("LEVKAS_THREADS", threads)
        methods = ("wiener", "matern", "gaussian-process")
        found.append(report_of(paintings, sources=["rgb"], methods=methods, test=["icon1"]))
    one, other = found
    assert json.dumps(one.to_dict()) == json.dumps(other.to_dict())


@pytest.mark.slow
def test_layers_together_have_the_channels_of_both(paintings):
    report = report_of(paintings, sources=["rgb,cam2"], methods=["wiener"])
    assert report.sources[0].channels == 6 and report.sources[0].name == "rgb+cam2"


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
        (["--train", "icon1", "--test", "icon1"], "E_SPLIT_LEAK"),
        (["--test", "icon9"], "E_VALUE"),
        (["--method", "all", "--method", "wienr"], "E_METHOD"),
        (["--choose-by", "delta_e"], "E_VALUE"),
    ],
)
def test_what_cannot_be_estimated_is_refused_with_status_1(paintings, options, code):
    ran = command(paintings, "--json", *options)
    report = json.loads(ran.stdout)
    assert ran.exit_code == 1 and not report["ok"]
    assert report["problems"][0]["code"] == code


def test_suggestions_name_what_was_meant(paintings):
    assert "Did you mean 'wiener'?" in command(paintings, "--method", "wienr").stderr
    assert command(paintings, "--split", "random").exit_code == 2


@pytest.mark.slow
def test_fewer_samples_than_coefficients_are_refused_by_the_method(paintings, monkeypatch):
    monkeypatch.setattr("levkas.estimation.experiment.TRAINING_PIXELS", 4)
    with pytest.raises(Refused) as refused:
        report_of(paintings, sources=["rgb,cam2"], methods=["wiener"])
    assert refused.value.problems[0].code == "E_TOO_FEW_SAMPLES"


@pytest.mark.slow
def test_the_command_ranks_every_method_where_none_is_named(paintings):
    ran = command(paintings, "--from", "rgb", "--test", "icon1", "--json")
    assert ran.exit_code == 0, ran.stderr
    (result,) = json.loads(ran.stdout)["results"]
    errors = {one["method"]: one["metrics"]["rmse"]["mean"] for one in result["methods"]}
    assert errors.keys() == EVERY_METHOD.keys() and min(errors.values()) > 0
    assert max(errors.values()) < 0.2


@pytest.mark.slow
def test_the_command_writes_page_json_and_models(paintings, tmp_path):
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
    assert len(method["bands"]) == 16
    page = (out / "estimation.html").read_text(encoding="utf-8")
    assert "http" not in page.replace("http-equiv", "").replace("http://www.w3.org", "")
    for name in ("models/rgb_wiener.npz",):
        assert (out / name).stat().st_size > 50, name
    assert command(paintings, "--from", "rgb", "--method", "wiener", "-o", out).exit_code == 0
