import json

import numpy as np
import pytest
from typer.testing import CliRunner

from levkas.cli import app
from levkas.database.reader import Database
from levkas.estimation.experiment import Paintings, run_experiment
from levkas.estimation.plan import ExperimentPlan
from levkas.estimation.samples import SampleSource
from levkas.estimation.training import sample_weights

METHODS = ("wiener", "pseudo-inverse")
pytestmark = pytest.mark.usefixtures("few_kernels")


def report_of(database, **options):
    options = {"methods": METHODS, "sources": ["rgb"], **options}
    return list(run_experiment(ExperimentPlan(database, **options)))[-1].report


def command(*arguments):
    return CliRunner().invoke(app, ["estimate", *map(str, arguments)])


@pytest.mark.slow
def test_each_painting_is_scored_while_it_is_held_out_above_the_reference_s_sigma(paintings):
    (source,) = report_of(paintings).sources
    assert [f.name for f in source.folds] == source.scores[0].objects == ["icon1", "icon2", "icon3"]
    assert 0.9 * 3 * (40 * 48 - 7) < source.pixels <= 3 * (40 * 48 - 7)
    assert source.ceiling == pytest.approx(0.004, rel=1e-3)  # as it was planted
    assert all(score.rmse > source.ceiling for score in source.scores)


@pytest.mark.slow
def test_linear_methods_are_fitted_to_every_pixel_of_paint(paintings):
    """The pseudo-inverse of all training pixels, worked out apart."""
    report = report_of(paintings, methods=["pseudo-inverse"], models=True)
    paint = Paintings(SampleSource(Database(paintings), "vis", 10**9), ("rgb",), 1)
    training = paint.training(list(Database(paintings)))
    root = np.sqrt(sample_weights(training))[:, None]
    expected = np.linalg.lstsq(root * training.responses, root * training.spectra, rcond=None)[0]
    (model,) = report.sources[0].models
    np.testing.assert_allclose(model.model.coefficients, expected, atol=1e-6)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_report_whatever_the_threads(paintings, monkeypatch):
    found = []
    for threads in ("1", "2"):
        monkeypatch.setenv("LEVKAS_THREADS", threads)
        methods = ("wiener", "matern", "gaussian-process")
        found.append(report_of(paintings, methods=methods, test=["icon1"]).to_dict())
    assert json.dumps(found[0]) == json.dumps(found[1])


@pytest.mark.parametrize(
    ("options", "code"),
    [
        (["--from", "rbg"], "E_VALUE"),
        (["--from", "raw"], "E_QUANTITY"),
        (["--to", "rgb"], "E_VALUE"),
        (["--from", "vis"], "E_VALUE"),
        (["--method", "wienr"], "E_METHOD"),
        (["--train", "icon1", "--test", "icon1"], "E_SPLIT_LEAK"),
    ],
)
def test_what_cannot_be_estimated_is_refused_with_status_1(paintings, options, code):
    ran = command(paintings, "--json", *options)
    assert ran.exit_code == 1 and json.loads(ran.stdout)["problems"][0]["code"] == code


@pytest.mark.slow
def test_the_command_writes_page_json_and_models(paintings, tmp_path):
    out = tmp_path / "out"
    ran = command(paintings, "--from", "rgb", "--method", "wiener", "--json", "-o", out)
    assert ran.exit_code == 0, ran.stderr
    record, kept = json.loads(ran.stdout), json.loads((out / "estimation.json").read_text())
    assert record["results"] == kept["results"] and record["command"] == "estimate"
    assert len(kept["results"][0]["methods"][0]["bands"]) == 16
    page = (out / "estimation.html").read_text(encoding="utf-8")
    assert "http" not in page.replace("http-equiv", "").replace("http://www.w3.org", "")
    assert (out / "models/rgb_wiener.npz").stat().st_size > 50
    again = command(paintings, "--from", "rgb", "--method", "wiener", "-o", out, "--overwrite")
    assert again.exit_code == 0
