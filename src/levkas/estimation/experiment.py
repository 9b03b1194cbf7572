"""An experiment: methods fitted on some paintings of a database and scored on others."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from levkas.core.machine import steady_libraries
from levkas.core.problems import Problem, Refused
from levkas.database.reader import Database
from levkas.estimation.methods import METHODS, EstimationMethod, Model
from levkas.estimation.plan import ExperimentPlan, choose_layers, choose_methods, wavelengths_of
from levkas.estimation.report import EstimationReport, SourceReport
from levkas.estimation.samples import PaintSamples, SampleSource, require_layers, training_of
from levkas.estimation.scores import MethodScore, PixelErrors, score_pixels
from levkas.estimation.splits import EstimationFold, split_paintings
from levkas.estimation.stored import StoredModel, bands_of
from levkas.estimation.training import Training
from levkas.estimation.uncertainty import (
    APART_PX,
    SAMPLES,
    ModelErrors,
    PredictionError,
    carry_on,
    channels_of,
    noise_of_residuals,
    slopes_of,
    training_rows,
)

MOST_PIXELS = 40_000
"""Of a painting that are scored."""
TRAINING_PIXELS = 60_000
"""Of all training paintings together, evenly; methods whose cost grows faster choose among them."""


@dataclass(frozen=True)
class EstimationStep:
    """Progress: one fold is done; the last step carries the report."""

    label: str
    done: int
    total: int
    finished: bool = True
    state: str = "done"
    report: EstimationReport | None = None

    @property
    def line(self) -> str:
        """The step as a line of a log."""
        return f"{self.done}/{self.total} {self.label}"


@dataclass
class Paintings:
    """Samples of paintings, whose responses are the channels of some layers, read once."""

    source: SampleSource
    sources: tuple[str, ...]
    seed: int
    _read: dict[str, PaintSamples] = field(default_factory=dict)

    def samples(self, name: str) -> PaintSamples:
        """Return the samples of a painting."""
        if name not in self._read:
            self._read[name] = self.source.read(name, self.sources)
        return self._read[name]

    def training(self, names: Sequence[str]) -> Training:
        """Return the training samples of some paintings; parameters are chosen on whole ones that are held out."""
        most = TRAINING_PIXELS // len(names)
        return training_of([self.samples(name).at_most(most) for name in names])


def named_seed(seed: int, *names: str) -> int:
    """Return a seed for one purpose, the same for the same names."""
    return zlib.crc32("\0".join((str(seed), *names)).encode())


def estimate(
    database: str | Path,
    sources: str | Sequence[str],
    target: str = "",
    *,
    method: str = "wiener",
    seed: int = 1,
) -> StoredModel:
    """Fit a model that estimates spectra from few channels, as ``levkas estimate`` does.

    Parameters
    ----------
    database : path
        Of at least two paintings: one is held out in turn, so that the errors of the model are known.
    sources : str or sequence of str
        Layers whose channels are its responses: ``"d80"``, ``["d80", "msbs"]``.
    target : str
        Layer whose spectra it estimates; default the reference camera where it is spectral.
    method : str
        A name of `levkas.estimation.methods.METHODS`.

    Returns
    -------
    model : StoredModel
        ``model.predict(cube)`` estimates, ``model.sigma`` is the error of each band on held-out paintings,
        ``model.save(path)`` keeps it for ``levkas estimate apply``.

    Raises
    ------
    EstimationRefused
        Where the layers or the method cannot be had, or too few paintings are there.

    Notes
    -----
    The model is fitted on all paintings that have the layers; its errors are those of models that were fitted without
    the painting in question. `levkas.estimation.methods.METHODS` has equation and source of each method.

    Examples
    --------
    Photographs in counts are not estimated:

    >>> try:
    ...     estimate(plates / "database", "photo", "infrared")
    ... except Refused as refused:
    ...     print(refused.problems[0].code)
    E_QUANTITY
    """
    group = (sources,) if isinstance(sources, str) else tuple(sources)
    plan = ExperimentPlan(*(database, [",".join(group)], target, [method]), models=True, seed=seed)
    *_, last = run_experiment(plan)
    assert last.report is not None
    return last.report.sources[0].models[0]


def run_experiment(plan: ExperimentPlan) -> Iterator[EstimationStep]:
    """Fit and score methods, fold by fold.

    Yields
    ------
    step : EstimationStep
        The last one carries the report.

    Raises
    ------
    EstimationRefused
        Where the layers, methods or the split cannot be had, or the split leaks.
    DatabaseRefused
        Where there is no database.
    """
    database = Database(plan.database)
    methods = choose_methods(plan.methods)
    target, sources = choose_layers(database, plan)
    splits = []
    for group in sources:
        names = require_layers(database, [*group, target], "--from")
        splits.append((group, split_paintings(names, train=plan.train, test=plan.test)))
    total, done, found = sum(len(folds) for _, folds in splits), 0, []
    for group, folds in splits:
        paintings = Paintings(SampleSource(database, target, MOST_PIXELS), group, plan.seed)
        scores: dict[str, list[PixelErrors]] = {}
        problems: list[Problem] = []
        for fold in folds:
            for name, errors in score_fold(paintings, fold, methods, problems).items():
                scores.setdefault(name, []).extend(errors)
            done += 1
            yield EstimationStep(f"{'+'.join(group)}: {fold.name}", done, total)
        if not scores:
            raise Refused(*dict.fromkeys(problems))
        report = _report_source(paintings, folds, scores, problems)
        if plan.models:
            report = replace(report, models=tuple(fit_models(paintings, report)))
        found.append(report)
    waves = wavelengths_of(database, target)
    title = database.path.resolve().name
    yield EstimationStep(
        "report", total, total, report=EstimationReport(title, target, waves, tuple(found))
    )


def score_fold(
    paintings: Paintings,
    fold: EstimationFold,
    methods: Sequence[EstimationMethod],
    problems: list[Problem],
) -> dict[str, list[PixelErrors]]:
    """Fit every method on a fold and return its errors; methods that refuse are put into `problems`."""
    seed = named_seed(paintings.seed, "painting", fold.name, *paintings.sources)
    wavelengths = wavelengths_of(paintings.source.database, paintings.source.target)
    scored = {}
    with steady_libraries():
        training = paintings.training(fold.train)
        tests = [(name, paintings.samples(name)) for name in fold.test]
        for method in methods:
            try:
                model = method.fit(training, np.random.default_rng(seed))
            except Refused as refused:
                problems.extend(refused.problems)
                continue
            scored[method.name] = [
                score_pixels(name, model(samples.responses)[0], samples, wavelengths)
                for name, samples in tests
            ]
    return scored


def fit_models(paintings: Paintings, report: SourceReport) -> Iterator[StoredModel]:
    """Fit the methods that were scored on every painting that took part, on whichever side, for estimating others."""
    source, sources = paintings.source, paintings.sources
    names = list(dict.fromkeys(n for fold in report.folds for n in (*fold.train, *fold.test)))
    seed = named_seed(paintings.seed, "all", *sources)
    bands = bands_of(source.layer(names[0], source.target))
    with steady_libraries():
        training = paintings.training(names)
        for score in report.ranked:
            model = METHODS[score.method].fit(training, np.random.default_rng(seed))
            sigma = tuple(float(e) for e in score.by_band())
            errors = _errors_of(source, model, training, sources, names, score)
            facts = score.method, model, sources, source.target, bands, tuple(names), sigma
            yield StoredModel(*facts, errors)


def _errors_of(
    source: SampleSource,
    model: Model,
    training: Training,
    sources: Sequence[str],
    names: Sequence[str],
    score: MethodScore,
) -> ModelErrors:
    """Return what the estimates of a model have in common, by its held-out errors and the budgets of its training."""
    some = training.take(np.linspace(0, len(training) - 1, SAMPLES).astype(int))
    noise = noise_of_residuals(
        slopes_of(model, some.responses), some.response_sigma, training.spectrum_sigma
    )
    root = source.database.path
    channels = [
        channels_of(source.layer(names[0], layer), layer, training_rows(root, names, layer))
        for layer in sources
    ]
    labels = [band.label for band in bands_of(source.layer(names[0], source.target))]
    return ModelErrors(
        PredictionError.measure(score.residuals(), noise, score.pairs(APART_PX)),
        tuple(training_rows(root, names, source.target)),
        tuple(carry_on(model, some.responses, channels, labels)),
    )


def _report_source(
    paintings: Paintings,
    folds: tuple[EstimationFold, ...],
    scores: dict[str, list[PixelErrors]],
    problems: Sequence[Problem],
) -> SourceReport:
    return SourceReport(
        paintings.sources,
        channels=paintings.samples(folds[0].test[0]).responses.shape[1],
        folds=folds,
        scores=tuple(MethodScore(name, tuple(errors)) for name, errors in scores.items()),
        problems=tuple(dict.fromkeys(problems)),
    )
