"""An experiment: methods fitted on some paintings of a database and scored on others."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter

import numpy as np

from levkas.core.machine import steady_libraries
from levkas.core.problems import Problem, Refused
from levkas.database.reader import Database
from levkas.estimation.budget import Budget, measure_budget
from levkas.estimation.charts import read_chart
from levkas.estimation.methods import METHODS, EstimationMethod, Model
from levkas.estimation.plan import (
    ExperimentPlan,
    choose_layers,
    choose_methods,
    criterion_of,
    questions_of,
    splits_of,
    title_of_database,
    wavelengths_of,
)
from levkas.estimation.report import EstimationReport, SourceReport
from levkas.estimation.samples import (
    PaintSamples,
    SampleSource,
    training_of,
)
from levkas.estimation.scores import (
    MethodScore,
    PixelErrors,
    distances,
    metamer_floor,
    score_pixels,
)
from levkas.estimation.splits import (
    EstimationFold,
    EstimationSplit,
    Part,
    group_pixels,
)
from levkas.estimation.stored import StoredModel, bands_of
from levkas.estimation.training import Criterion, Training, mean_square, select_training
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
"""Of a painting that are scored and drawn."""
FEW_PIXELS = 4_000
"""Of a painting in the comparison with random pixels, in the error budget and in the metamer floor."""
TRAINING_PIXELS = 60_000
"""Of all training paintings together, evenly; methods whose cost grows faster choose among them."""
NEIGHBOURS = 1_000
"""Training samples, chosen by farthest points, from which the distance of a test pixel is taken."""


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
    """Samples of paintings and charts, read once.

    Parameters
    ----------
    source : SampleSource
    seed : int
    """

    source: SampleSource
    seed: int
    _read: dict[tuple[str, tuple[str, ...]], PaintSamples] = field(default_factory=dict)

    def samples(self, part: Part, grouping: str = "") -> PaintSamples:
        """Return the samples of one side of a fold in one painting."""
        key = (part.object, part.sources)
        if key not in self._read:
            self._read[key] = self._chart(part) if part.chart else self.source.read(*key)
        samples = self._read[key]
        if part.group is None:
            return samples
        groups = group_pixels(samples, grouping, named_seed(self.seed, part.object))
        return samples.take((groups == part.group) == part.held)

    def _chart(self, part: Part) -> PaintSamples:
        return read_chart(self.source.database.path, part.object, part.sources, self.source.target)

    def training(self, fold: EstimationFold, grouping: str, criterion: Criterion) -> Training:
        """Return the training samples of a fold: paint without gold.

        Parameters are chosen on what is held out as the test is: paintings, blocks of one, or, where the
        test has random pixels, single pixels.
        """
        parts = [self.samples(part, grouping) for part in fold.train]
        paint = [part.take(~part.gold) for part in parts]
        most = TRAINING_PIXELS // len(paint)
        made = replace(training_of([part.at_most(most) for part in paint]), criterion=criterion)
        return replace(made, groups=None) if grouping == "random" else made


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
    seed : int

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
    plan = ExperimentPlan(
        *(database, [",".join(group)], target, [method]),
        budget=False,
        models=True,
        seed=seed,
    )
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
    criterion = criterion_of(plan.choose_by, wavelengths_of(database, target))
    splits = [splits_of(database, plan, target, group) for group in questions_of(plan, sources)]
    total = sum(len(split.folds) for pair in splits for split in pair) + plan.budget * len(splits)
    done, found = 0, []
    for main, random in splits:
        paintings = Paintings(SampleSource(database, target, MOST_PIXELS), plan.seed)
        scores: dict[str, dict[str, list[PixelErrors]]] = {}
        problems: list[Problem] = []
        seconds: dict[str, float] = {}
        for split in (main, random):
            for fold in split.folds:
                results = score_fold(paintings, split, fold, methods, problems, criterion)
                for name, (errors, taken) in results.items():
                    scores.setdefault(split.kind, {}).setdefault(name, []).extend(errors)
                    seconds[name] = seconds.get(name, 0.0) + taken
                done += 1
                label = f"{'+'.join(fold.test[0].sources)}: {split.kind}, {fold.name}"
                yield EstimationStep(label, done, total)
        if not scores.get(main.kind):
            raise Refused(*dict.fromkeys(problems))
        budget = None
        if plan.budget:
            budget = budget_of(paintings, main, methods, plan.seed, criterion)
            done += 1
            yield EstimationStep(
                f"{'+'.join(main.folds[0].test[0].sources)}: error budget", done, total
            )
        report = _report_source(paintings, (main, random), scores, budget, problems)
        if plan.models:
            report = replace(report, models=tuple(_models_of(paintings, report, criterion)))
        found.append(report)
    whole = EstimationReport(
        title_of_database(database),
        target,
        wavelengths_of(database, target),
        plan.split,
        tuple(found),
        choose_by=plan.choose_by,
    )
    yield EstimationStep("report", total, total, report=whole)


def score_fold(
    paintings: Paintings,
    split: EstimationSplit,
    fold: EstimationFold,
    methods: Sequence[EstimationMethod],
    problems: list[Problem],
    criterion: Criterion = mean_square,
) -> dict[str, tuple[list[PixelErrors], float]]:
    """Fit every method on a fold and return its errors; methods that refuse are put into `problems`."""
    seed = named_seed(paintings.seed, split.kind, fold.name, *fold.test[0].sources)
    with steady_libraries():
        training = paintings.training(fold, split.grouping, criterion)
        near = select_training(training, NEIGHBOURS, np.random.default_rng(seed)).responses
        wavelengths = wavelengths_of(paintings.source.database, paintings.source.target)
        tests = []
        for part in fold.test:
            samples = paintings.samples(part, split.grouping)
            samples = samples.at_most(FEW_PIXELS) if split.optimistic else samples
            tests.append((part.object, samples, distances(near, samples.responses)))

        scored = {}
        for method in methods:
            began = perf_counter()
            try:
                model = method.fit(training, np.random.default_rng(seed))
            except Refused as refused:
                problems.extend(refused.problems)
                continue
            errors = [
                score_pixels(name, model(samples.responses), samples, wavelengths, far)
                for name, samples, far in tests
            ]
            scored[method.name] = errors, perf_counter() - began
    return scored


def budget_of(
    paintings: Paintings,
    split: EstimationSplit,
    methods: Sequence[EstimationMethod],
    seed: int,
    criterion: Criterion,
) -> Budget:
    """Measure the error budget of one fold: that of the middle of the split."""
    fold = split.folds[len(split.folds) // 2]
    train, test = (
        [
            (p.object, paintings.samples(p, split.grouping).at_most(FEW_PIXELS))
            for p in parts
            if not p.chart
        ]
        for parts in (fold.train, fold.test)
    )
    names = [part.object for part in fold.test]
    position = paintings.source.position_sigma(names, fold.test[0].sources)
    with steady_libraries():
        made = measure_budget(
            paintings.source, train or test, test, methods, seed, criterion=criterion
        )
    return replace(made, position_sigma=position)


def fit_models(
    paintings: Paintings,
    part: Part,
    names: Sequence[str],
    scores: Sequence[MethodScore],
    criterion: Criterion = mean_square,
) -> Iterator[StoredModel]:
    """Fit the methods that were scored on all paintings, for estimating others."""
    source = paintings.source
    fold = EstimationFold("all", tuple(Part(name, part.sources) for name in names), ())
    seed = named_seed(paintings.seed, "all", *part.sources)
    bands = bands_of(source.layer(names[0], source.target))
    with steady_libraries():
        training = paintings.training(fold, "", criterion)
        for score in scores:
            model = METHODS[score.method].fit(training, np.random.default_rng(seed))
            sigma = tuple(float(e) for e in score.by_band()[0])
            errors = _errors_of(source, model, training, part.sources, names, score)
            facts = score.method, model, part.sources, source.target, bands, tuple(names), sigma
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


def _models_of(
    paintings: Paintings, report: SourceReport, criterion: Criterion
) -> Iterator[StoredModel]:
    """Fit on every painting that took part, on whichever side."""
    parts = [p for fold in report.split.folds for p in (*fold.train, *fold.test) if not p.chart]
    part = report.split.folds[0].test[0]
    names = list(dict.fromkeys(p.object for p in parts))
    return fit_models(paintings, part, names, report.ranked, criterion)


def _report_source(
    paintings: Paintings,
    splits: tuple[EstimationSplit, EstimationSplit],
    scores: dict[str, dict[str, list[PixelErrors]]],
    budget: Budget | None,
    problems: Sequence[Problem],
) -> SourceReport:
    main, random = splits
    part = main.folds[0].test[0]
    samples = paintings.samples(part)
    rng = np.random.default_rng(named_seed(paintings.seed, "metamers", *part.sources))
    return SourceReport(
        part.sources,
        channels=samples.responses.shape[1],
        split=main,
        scores=tuple(MethodScore(name, tuple(e)) for name, e in scores[main.kind].items()),
        random=tuple(
            MethodScore(name, tuple(e)) for name, e in scores.get(random.kind, {}).items()
        ),
        floor=metamer_floor(samples, FEW_PIXELS, rng),
        budget=budget,
        step=paintings.source.step(part.object),
        problems=tuple(dict.fromkeys(problems)),
    )
