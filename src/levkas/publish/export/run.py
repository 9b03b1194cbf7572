"""Export of chosen layers in one format into one folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

from levkas.core.problems import Problem, closest_match, unknown_name
from levkas.publish.export.layer import ExportLayer, ExportRefused

FORMS = {
    "envi": "levkas.publish.export.envi:write_envi",
    "qgis": "levkas.publish.export.qgis:write_qgis",
    "netcdf": "levkas.publish.export.netcdf:write_netcdf",
    "photoshop": "levkas.publish.export.photoshop:write_photoshop",
    "ngff": "levkas.publish.export.ngff:write_ngff",
}
"""Name of a format → where the function is that writes one layer into a folder and returns its files."""

Writer = Callable[[ExportLayer, Path], list[Path]]


@dataclass(frozen=True)
class Exported:
    """One layer that was written; `done` of `total` are."""

    name: str
    files: tuple[Path, ...]
    done: int
    total: int
    finished: bool = True
    state: str = "done"

    @property
    def label(self) -> str:
        """The layer."""
        return self.name

    @property
    def line(self) -> str:
        """One line for a log."""
        return f"{self.name}: {', '.join(path.name for path in self.files) or 'read'}"


def export(
    database: str | Path,
    form: str,
    *,
    output: str | Path | None = None,
    objects: Sequence[str] = (),
    cameras: Sequence[str] = (),
    overwrite: bool = False,
) -> Iterator[Exported]:
    """Write layers of a database as another program wants them, yielding layer after layer.

    Parameters
    ----------
    database : path
        A database, also a published one, or the folder of its campaign, from which the
        form ``ngff`` calibrates native pixels that the database does not hold.
    form : str
        One of `FORMS`.
    output : path, optional
        Folder; default ``DATABASE.FORM`` beside the database. Other files in it stay.
    objects, cameras : sequence of str
        Only these; default all.
    overwrite : bool
        Whether files that are there may be replaced.

    Raises
    ------
    ExportRefused
        Where nothing of that name is in the database, or a layer does not fit the format.
    WriteRefused
        Where a file is there already, or the disk refuses.
    """
    from levkas.core.files import before_writing
    from levkas.core.ownership import new_files
    from levkas.database.catalogue import database_of
    from levkas.database.reader import Database
    from levkas.database.remote import is_remote

    root = database_of(database)
    root = root if is_remote(root) else root.resolve()
    opened = Database(root)
    layers = [
        (name, *key)
        for name in opened
        for key in opened[name].layers
        if (not objects or name in objects) and (not cameras or key[0] in cameras)
    ]
    _check_names(root, opened, objects, cameras)
    writer = load_writer(form)
    beside = Path(root.name) if is_remote(root) else root
    folder = Path(output or beside.with_name(f"{root.name}.{form}")).resolve()
    if folder == root or root in folder.parents:
        raise ExportRefused(
            Problem(
                "E_UNWRITABLE",
                "an export cannot be written into the database: the manifest would no longer match",
                file=str(folder),
                fix="Give another folder with -o.",
            )
        )
    check = new_files(folder, overwrite=overwrite)
    for done, (name, camera, setup) in enumerate(layers, 1):
        layer = ExportLayer.read(root, name, camera, setup)
        with before_writing(check):
            files = writer(layer, folder)
        yield Exported(layer.stem, tuple(files), done, len(layers))
    finish = getattr(import_module(FORMS[form].partition(":")[0]), "finish", None)
    if finish is not None:
        with before_writing(check):
            campaign = _campaign(database, root) if form == "ngff" else None
            read = (ExportLayer.read(root, *layer) for layer in layers)
            files = finish([replace(layer, campaign=campaign) for layer in read], folder)
        yield Exported(form, tuple(files), len(layers), len(layers))


def _campaign(given: str | Path, root: Path) -> Path | None:
    """Return campaign.toml where a campaign was given, and its database is up to date."""
    from levkas.database.remote import is_remote
    from levkas.publish.run import find_subject

    return None if is_remote(root) else find_subject(given).campaign


def load_writer(form: str) -> Writer:
    """Return the function of a format."""
    if form not in FORMS:
        raise ExportRefused(unknown_name("unknown format", form, FORMS, field="--for"))
    module, _, function = FORMS[form].partition(":")
    writer: Writer = getattr(import_module(module), function)
    return writer


def _check_names(
    root: Path, opened: object, objects: Sequence[str], cameras: Sequence[str]
) -> None:
    from levkas.database.reader import Database

    assert isinstance(opened, Database)
    there = {camera for name in opened for camera, _ in opened[name].layers}
    for field, wanted, known in (
        ("--object", objects, list(opened)),
        ("--camera", cameras, sorted(there)),
    ):
        if missing := [name for name in wanted if name not in known]:
            found, expected = ", ".join(missing), ", ".join(known)
            raise ExportRefused(
                Problem(
                    "E_VALUE",
                    "the database has no such name",
                    str(root),
                    field,
                    found,
                    expected,
                    closest_match(missing[0], known),
                )
            )
