"""Scores of predictions made elsewhere, such as a network's, on the same pixels and with the same page.

A folder holds one cube a test painting, ``OBJECT_LAYER.mat`` (MATLAB 7.3, ``cube`` as (bands, width, height), as
``levkas export --for ntire`` writes them) or ``OBJECT_LAYER.npy`` (height, width, bands).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from levkas.core.problems import Problem
from levkas.database.layout import LayerId
from levkas.database.reader import Database
from levkas.database.splits import split_objects
from levkas.estimation.experiment import FEW_PIXELS, MOST_PIXELS, EstimationStep, named_seed
from levkas.estimation.plan import ExperimentPlan, choose_layers, title_of_database, wavelengths_of
from levkas.estimation.report import EstimationReport, SourceReport
from levkas.estimation.samples import EstimationRefused, PaintSamples, SampleSource, require_layers
from levkas.estimation.scores import (
    MethodScore,
    PixelErrors,
    distances,
    metamer_floor,
    score_pixels,
)
from levkas.estimation.splits import EstimationFold, EstimationSplit, Part, split_paintings
from levkas.readers.arrays import read_hdf5, read_npy

ENDINGS = (".mat", ".npy")
PLACES = ("", "Train_Spec", "Test_Spec", "Valid_Spec")
"""Folders below the one that is given in which predictions are looked for."""


@dataclass(frozen=True)
class Predictions:
    """Cubes of test paintings in a folder.

    Parameters
    ----------
    folder : Path
    files : dict of object to Path
    """

    folder: Path
    files: dict[str, Path]

    def read(self, name: str, shape: tuple[int, int, int]) -> np.ndarray:
        """Return the predicted cube of a painting, (height, width, bands).

        Raises
        ------
        UnreadableCapture
            Where it cannot be read, or is of another shape.
        """
        path = self.files[name]
        if path.suffix == ".mat":
            return read_hdf5(path, "cube", shape[::-1]).transpose(2, 1, 0)
        return read_npy(path, shape)


def score_predictions(plan: ExperimentPlan, folder: str | Path) -> Iterator[EstimationStep]:
    """Score the predictions in a folder for the test paintings of a database.

    Parameters
    ----------
    plan : ExperimentPlan
        `database`, `target`, `sources` (whose masks are used too), and `test`: default the published split.
    folder : path

    Yields
    ------
    step : EstimationStep
        The last one carries the report.

    Raises
    ------
    EstimationRefused
        Where predictions are missing, of another shape, or of training paintings: each file by its name.
    """
    database = Database(plan.database)
    target, groups = choose_layers(database, plan)
    sources = groups[0]
    names = require_layers(database, [*sources, target], "--from")
    split = _split(names, sources, plan)
    fold = split.folds[0]
    tested = [part.object for part in fold.test]
    found = find_predictions(Path(folder), target, tested, [p.object for p in fold.train])
    source = SampleSource(database, target, MOST_PIXELS)
    wavelengths = wavelengths_of(database, target)
    label = Path(folder).resolve().name
    parts = [source.read(part.object, sources).at_most(FEW_PIXELS) for part in fold.train]
    trained = np.concatenate([part.responses for part in parts])
    errors: list[PixelErrors] = []
    for done, name in enumerate(tested, 1):
        samples = source.read(name, sources)
        errors.append(_score(found, source, name, samples, trained))
        yield EstimationStep(f"{name}: predictions of {label}", done, len(tested))
    seed = named_seed(plan.seed, "metamers", *sources)
    report = SourceReport(
        sources,
        channels=samples.responses.shape[1],
        split=split,
        scores=(MethodScore(label, tuple(errors)),),
        floor=metamer_floor(samples, FEW_PIXELS, np.random.default_rng(seed)),
        step=source.step(tested[0]),
    )
    title = title_of_database(database)
    whole = EstimationReport(title, target, wavelengths, split.kind, (report,))
    yield EstimationStep("report", len(tested), len(tested), report=whole)


def find_predictions(
    folder: Path, target: str, tested: Sequence[str], trained: Sequence[str]
) -> Predictions:
    """Return the files of all test paintings; refuse missing ones and those of training paintings, by name."""
    if not folder.is_dir():
        raise EstimationRefused(
            Problem("E_MISSING", "there is no folder of predictions", str(folder), "--score")
        )
    files = {name: _file(folder, name, target) for name in (*tested, *trained)}
    key = LayerId.parse("OBJECT", target)
    problems = [
        Problem(
            "E_MISSING",
            f"there is no prediction of the test painting {name}",
            str(folder),
            "--score",
            expected=f"{LayerId(name, key.camera, key.setup).stem}.mat or .npy",
        )
        for name in tested
        if files[name] is None
    ]
    problems += [
        Problem(
            "E_SPLIT_LEAK",
            f"{name} is a training painting: its score would be meaningless",
            str(files[name]),
            "--score",
            found=name,
            expected=f"test paintings: {', '.join(tested)}",
            fix="Remove the file from the folder, or name the test paintings with --test.",
        )
        for name in trained
        if files[name] is not None
    ]
    if problems:
        raise EstimationRefused(*problems)
    return Predictions(folder, {n: path for n in tested if (path := files[n]) is not None})


def _split(names: Sequence[str], sources: tuple[str, ...], plan: ExperimentPlan) -> EstimationSplit:
    """Return the published split, training and validation against test, or the one that is given."""
    if plan.train or plan.test:
        return split_paintings(names, sources, train=plan.train, test=plan.test)
    published = split_objects(Database(plan.database))
    tested = [name for name in names if published[name] == "test"]
    if not tested:
        raise EstimationRefused(
            Problem(
                "E_SPLIT",
                "no painting with these layers is a test painting of the published split",
                str(plan.database),
                "--test",
                found=", ".join(f"{n}: {published[n]}" for n in names),
                fix="Name test paintings with --test.",
            )
        )
    train, test = (
        tuple(Part(n, sources) for n in names if (n in tested) == held) for held in (False, True)
    )
    note = "test paintings of the published split (splits.csv); all others are for training"
    return EstimationSplit("painting", (EstimationFold("published", train, test),), note=note)


def _score(
    found: Predictions,
    source: SampleSource,
    name: str,
    samples: PaintSamples,
    trained: np.ndarray,
) -> PixelErrors:
    wavelengths = wavelengths_of(source.database, source.target)
    height, width, bands = source.layer(name, source.target).shape
    cube = found.read(name, (height, width, bands))
    spectra = cube[samples.rows, samples.columns].astype(float)
    if not np.isfinite(spectra).all():
        raise EstimationRefused(
            Problem(
                "E_VALUE",
                "the prediction has pixels without a number where the painting was seen",
                str(found.files[name]),
                found=f"{int((~np.isfinite(spectra)).any(1).sum())} of {len(spectra)} scored pixels",
                expected="finite reflectance",
            )
        )
    far = distances(trained, samples.responses)
    return score_pixels(name, (spectra, None), samples, wavelengths, far)


def _file(folder: Path, name: str, target: str) -> Path | None:
    key = LayerId.parse(name, target)
    stem = LayerId(name, key.camera, key.setup).stem
    places = [folder / place / f"{stem}{ending}" for place in PLACES for ending in ENDINGS]
    return next((path for path in places if path.is_file()), None)
