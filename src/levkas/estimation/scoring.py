"""Scores of predictions made elsewhere, such as a network's, on the same pixels and with the same page.

A folder holds one cube a test painting, ``OBJECT_LAYER.mat`` (MATLAB 7.3, ``cube`` as (bands, width, height), as
``levkas export --for ntire`` writes them) or ``OBJECT_LAYER.npy`` (height, width, bands).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from levkas.core.problems import Problem
from levkas.database.layout import LayerId
from levkas.database.reader import Database
from levkas.database.splits import split_objects
from levkas.estimation.experiment import FEW_PIXELS, MOST_PIXELS, EstimationStep, named_seed
from levkas.estimation.plan import ExperimentPlan, choose_layers, title_of_database, wavelengths_of
from levkas.estimation.report import EstimationReport, SourceReport
from levkas.estimation.samples import EstimationRefused, SampleSource, require_layers
from levkas.estimation.scores import MethodScore, distances, metamer_floor, score_pixels
from levkas.estimation.splits import EstimationFold, EstimationSplit, Part, split_paintings
from levkas.readers.arrays import read_hdf5, read_npy

PLACES = ("", "Train_Spec", "Test_Spec", "Valid_Spec")
"""Folders below the one that is given in which predictions are looked for."""


def score_predictions(plan: ExperimentPlan, folder: str | Path) -> Iterator[EstimationStep]:
    """Score the predictions in a folder for the test paintings of a database; the last step carries the report.

    Of `plan` count `database`, `target`, `sources` (whose masks are used too), and `test`: default the published
    split. Raises EstimationRefused where predictions are missing, of another shape, or of training paintings: each
    file by its name.
    """
    database = Database(plan.database)
    target, groups = choose_layers(database, plan)
    sources = groups[0]
    split = _split(require_layers(database, [*sources, target], "--from"), sources, plan)
    tested, trained = (
        [p.object for p in part] for part in (split.folds[0].test, split.folds[0].train)
    )
    files = find_predictions(Path(folder), target, tested, trained)
    source = SampleSource(database, target, MOST_PIXELS)
    wavelengths = wavelengths_of(database, target)
    label = Path(folder).resolve().name
    known = np.concatenate(
        [source.read(name, sources).at_most(FEW_PIXELS).responses for name in trained]
    )
    errors = []
    for done, name in enumerate(tested, 1):
        samples = source.read(name, sources)
        path, shape = files[name], source.layer(name, target).shape
        if path.suffix == ".mat":
            cube = read_hdf5(path, "cube", shape[::-1]).transpose(2, 1, 0)
        else:
            cube = read_npy(path, shape)
        spectra = cube[samples.rows, samples.columns].astype(float)
        if lost := int((~np.isfinite(spectra)).any(1).sum()):
            why = "the prediction has pixels without a number where the painting was measured"
            found = f"{lost} of {len(spectra)} scored pixels"
            raise EstimationRefused(
                Problem("E_VALUE", why, str(path), None, found, "finite reflectance")
            )
        far = distances(known, samples.responses)
        errors.append(score_pixels(name, (spectra, None), samples, wavelengths, far))
        yield EstimationStep(f"{name}: predictions of {label}", done, len(tested))
    rng = np.random.default_rng(named_seed(plan.seed, "metamers", *sources))
    report = SourceReport(
        sources, channels=samples.responses.shape[1], split=split, scores=(MethodScore(label, tuple(errors)),),
        floor=metamer_floor(samples, FEW_PIXELS, rng), step=source.step(tested[0]),
    )  # fmt: skip
    title = title_of_database(database)
    whole = EstimationReport(title, target, wavelengths, split.kind, (report,))
    yield EstimationStep("report", len(tested), len(tested), report=whole)


def find_predictions(
    folder: Path, target: str, tested: Sequence[str], trained: Sequence[str]
) -> dict[str, Path]:
    """Return the file of each test painting; refuse missing ones and those of training paintings, by name."""
    key, files, problems = LayerId.parse("OBJECT", target), {}, []
    for name in (*tested, *trained):
        stem = LayerId(name, key.camera, key.setup).stem
        places = [folder / place / f"{stem}{end}" for place in PLACES for end in (".mat", ".npy")]
        path = next((path for path in places if path.is_file()), None)
        if name in tested and path is None:
            why, expected = (
                f"there is no prediction of the test painting {name}",
                f"{stem}.mat or .npy",
            )
            problems.append(
                Problem("E_MISSING", why, str(folder), "PREDICTIONS", expected=expected)
            )
        elif name in tested and path is not None:
            files[name] = path
        elif path is not None:
            why = f"{name} is a training painting: its score would be meaningless"
            wanted = f"test paintings: {', '.join(tested)}"
            fix = "Remove the file from the folder, or name the test paintings with --test."
            problems.append(
                Problem("E_SPLIT_LEAK", why, str(path), "PREDICTIONS", name, wanted, fix)
            )
    if problems:
        raise EstimationRefused(*problems)
    return files


def _split(names: Sequence[str], sources: tuple[str, ...], plan: ExperimentPlan) -> EstimationSplit:
    """Return the published split, training and validation against test, or the one that is given."""
    if plan.train or plan.test:
        return split_paintings(names, sources, train=plan.train, test=plan.test)
    published = split_objects(Database(plan.database))
    parts = [(Part(name, sources), published[name] == "test") for name in names]
    train, test = (
        tuple(part for part, held in parts if held == wanted) for wanted in (False, True)
    )
    if not test:
        why = "no painting with these layers is a test painting of the published split"
        found = ", ".join(f"{name}: {published[name]}" for name in names)
        fix = "Name test paintings with --test."
        raise EstimationRefused(
            Problem("E_SPLIT", why, str(plan.database), "--test", found, fix=fix)
        )
    note = "test paintings of the published split (splits.csv); all others are for training"
    return EstimationSplit("painting", (EstimationFold("published", train, test),), note=note)
