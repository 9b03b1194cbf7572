"""Files with the calibrated bands of one layer in the pixels of its sensors."""

from __future__ import annotations

from glob import escape
from pathlib import Path

from levkas.core.problems import Problem, Refused
from levkas.database.layout import layer_name
from levkas.database.manifest import check_inside


class ComparisonRefused(Refused):
    """No layer on which methods could be compared."""


def native_files(
    database: Path, name: str, camera: str, setup: str, folder: Path | None = None
) -> dict[str, Path]:
    """Return the files with the native pixels of a layer, by the names of its sensors and tiles.

    They are those of the database unless another `folder` is given.
    """
    from levkas.database.described import open_tiff
    from levkas.database.layout import Places

    first = Places(database).native(name, camera, setup, "", folder=folder)
    found = {}
    for path in sorted(first.parent.glob(escape(first.stem) + "*.tif")):
        if path.name.endswith((".flags.tif", ".sigma.tif")):
            continue
        if folder is None:
            check_inside(database, path)
        facts = open_tiff(path).facts
        if (facts.get("camera", camera), facts.get("setup", setup) or "") == (camera, setup):
            found[path.stem.removeprefix(first.stem).removeprefix("_")] = path
    if not found:
        raise no_native(f"{name}/{layer_name(camera, setup)}", first)
    return found


def no_native(what: str, path: Path) -> ComparisonRefused:
    """Return the refusal of a layer, or of a database, that has no native pixels at `path`."""
    return ComparisonRefused(
        Problem(
            "E_UNREADABLE",
            f"{what} has no native pixels in the database",
            file=str(path),
            field="database.native",
            found="false",
            expected="true",
            fix="Set `native = true` under `[database]` in campaign.toml, and build again.",
        )
    )
