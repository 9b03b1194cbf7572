"""One layer as the formats take it: planes, bands, sampling."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.cube import Band
from levkas.core.problems import Problem, Refused
from levkas.database.layout import LayerId
from levkas.database.manifest import check_inside

KINDS = {"values": "", "flags": ".flags", "sigma": ".sigma"}


class ExportRefused(Refused):
    """A layer cannot be written in the requested format."""


def missing_library(name: str) -> ExportRefused:
    """Return the refusal of a format whose library, of the extra ``export``, is not installed."""
    return ExportRefused(
        Problem(
            "E_MISSING",
            f"this format needs {name}, which is not installed",
            fix="Run: pip install 'levkas[export]'",
        )
    )


@dataclass(frozen=True)
class ExportLayer:
    """One layer, read from its TIFFs.

    Parameters
    ----------
    object, camera, setup : str
    bands : tuple of Band
    facts : dict
        What the TIFF says of itself: quantity, px_per_mm and others.
    path : Path
        Of the TIFF with the values; flags and sigma stand beside it.
    campaign : Path, optional
        campaign.toml of the database, where it is known.
    """

    object: str
    camera: str
    setup: str
    bands: tuple[Band, ...]
    facts: dict[str, Any]
    path: Path
    campaign: Path | None = None

    @classmethod
    def read(cls, database: Path, name: str, camera: str, setup: str) -> ExportLayer:
        """Open a layer; raises TiffRefused."""
        from levkas.database.described import open_tiff

        stem = LayerId(name, camera, setup).stem
        path = database / "objects" / name / f"{stem}.tif"
        if not path.is_file():
            raise ExportRefused(
                Problem(
                    "E_MISSING", f"the layer {stem} has no TIFF", str(path), fix="Build it again."
                )
            )
        check_inside(
            database, path, *(path.with_name(f"{stem}{ending}.tif") for ending in KINDS.values())
        )
        described = open_tiff(path)
        return cls(name, camera, setup, described.bands, described.facts, path)

    @property
    def stem(self) -> str:
        """Name of its files without an ending."""
        return self.path.stem

    @property
    def quantity(self) -> str:
        """``"reflectance"`` or ``"counts"``."""
        return str(self.facts.get("quantity", "values"))

    @property
    def px_per_mm(self) -> float | None:
        """Sampling of the grid, where it is known."""
        scale = self.facts.get("px_per_mm")
        return float(scale) if scale else None

    @property
    def labels(self) -> list[str]:
        """Labels of the bands."""
        return [band.label for band in self.bands]

    @property
    def wavelengths(self) -> list[float] | None:
        """Centres in nm; None where the channels are broad."""
        centres = [band.wavelength for band in self.bands]
        return None if any(c != c for c in centres) else centres

    @property
    def shape(self) -> tuple[int, int, int]:
        """(height, width, bands)."""
        from levkas.database.tiff_pages import open_pages

        return open_pages(self.path).shape

    @property
    def kinds(self) -> list[str]:
        """Which of values, flags and sigma there are."""
        return [kind for kind in KINDS if self.file(kind).is_file()]

    def file(self, kind: str) -> Path:
        """Path of the TIFF with values, flags or sigma."""
        return self.path.with_name(f"{self.path.stem}{KINDS[kind]}.tif")

    def planes(self, kind: str = "values") -> Iterator[np.ndarray]:
        """Yield band after band, (height, width): float32, of flags uint8."""
        from levkas.database.tiff_pages import open_pages

        pages = open_pages(self.file(kind))
        for index in range(len(pages)):
            yield pages.read_page(index)
