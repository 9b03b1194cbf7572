"""Paths and names of the files of a database."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

KINDS = {"values": ".tif", "flags": ".flags.tif", "sigma": ".sigma.tif"}
"""Arrays of a Zarr layer, and the endings of the TIFFs that hold the same numbers."""
SIGMA = "sigma"
"""Among the facts of values: true where a sigma belongs to them, so that a missing one is noticed."""
STEP = "step_per_sigma"
"""Among the facts of values: the largest step that they are rounded to, a share of their sigma."""
MADE_OF = ".estimate.json"
"""Ending of the record of what an estimated layer was made of."""


@dataclass(frozen=True)
class LayerId:
    """Which layer of a database: `setup` is empty for the default one.

    >>> layer = LayerId("icon1", "d80", "raking")
    >>> layer.name, layer.stem
    ('d80@raking', 'icon1_d80_raking')
    >>> LayerId.parse("icon1", "d80@raking") == layer
    True
    """

    object: str
    camera: str
    setup: str = ""

    @classmethod
    def parse(cls, object: str, name: str) -> LayerId:
        """Return the layer of an object by its name, ``CAMERA`` or ``CAMERA@SETUP``."""
        camera, _, setup = name.partition("@")
        return cls(object, camera, setup)

    @property
    def name(self) -> str:
        """``CAMERA`` or ``CAMERA@SETUP``: of Zarr groups, registration records and frames."""
        return layer_name(self.camera, self.setup)

    @property
    def stem(self) -> str:
        """``OBJECT_CAMERA`` or ``OBJECT_CAMERA_SETUP``: how its files begin."""
        return _stem(self.object, self.camera, self.setup)

    @property
    def path(self) -> str:
        return f"objects/{self.object}/{self.stem}"

    @property
    def group(self) -> str:
        return f"zarr/{self.object}.zarr/{self.name}"

    @property
    def record(self) -> str:
        """Its registration record, without its ending, relative to the database."""
        return f"objects/{self.object}/registration/{self.name}"


@dataclass(frozen=True)
class Places:
    """Paths of one database, `output`, and of what is kept beside it."""

    output: Path

    @property
    def kept(self) -> Path:
        """Records and intermediate results of the build; may be deleted, costs only time."""
        return self.output.with_name(self.output.name + ".kept")

    def folder(self, name: str) -> Path:
        return self.output / "objects" / name

    def layer(self, name: str, camera: str, setup: str = "", *, kind: str = ".tif") -> Path:
        """Published file of one layer: ``.tif``, ``.flags.tif``, ``.sigma.tif`` or ``.png``."""
        return self.output / (LayerId(name, camera, setup).path + kind)

    def native(
        self,
        name: str,
        camera: str,
        setup: str,
        sensor: str,
        *,
        kind: str = ".tif",
        folder: Path | None = None,
    ) -> Path:
        """Calibrated, not resampled, one file a sensor; in the database unless another `folder` is given."""
        stem = _stem(name, camera, setup, sensor)
        return (folder or self.folder(name) / "native") / (stem + kind)

    def kept_native(self, name: str, layer: str, version: str = "") -> Path:
        """Folder of such files beside the database; `version` names what the workbench shows."""
        return self.kept / name / layer / "-".join(filter(None, ("native", version)))

    def registration(self, name: str, layer: str) -> Path:
        return self.folder(name) / "registration" / f"{layer}.json"

    def matches(self, name: str, layer: str, sensor: str = "") -> Path:
        """Matches of one layer; `sensor` names another than its first."""
        stem = ".".join(filter(None, (layer, sensor)))
        return self.folder(name) / "registration" / f"{stem}.matches.csv"

    def store(self, name: str) -> Path:
        return self.output / "zarr" / f"{name}.zarr"


def layer_name(camera: str, setup: str = "") -> str:
    """Return the name of a layer within an object: ``CAMERA``, or ``CAMERA@SETUP``."""
    return f"{camera}@{setup}" if setup else camera


def _stem(*parts: str) -> str:
    return "_".join(part for part in parts if part)
