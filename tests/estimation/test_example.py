import importlib
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.mark.slow
@pytest.mark.usefixtures("few_kernels")
def test_the_example_draws_the_errors_of_every_camera(paintings, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    script = importlib.import_module("estimate_spectra")
    figure = script.main(paintings, tmp_path / "out.png")
    assert (tmp_path / "out.png").stat().st_size > 5_000
    for axes in figure.axes:
        errors = {line.get_label(): line.get_ydata() for line in axes.lines}
        assert errors["matern"].mean() < errors["wiener"].mean()
        assert min(errors["matern"]) > errors["noise of the reference"][0]
