"""Maps of many bands laid out: the same tables however many are held, and none held twice."""

import weakref

import numpy as np
import pytest

from levkas.geometry import pixel_maps
from levkas.geometry.pixel_maps import lay, lay_runs
from levkas.geometry.transforms import Affine, Composed, Lens

SHAPE = (90, 130)


def band_map(band):
    """A lens whose magnification hangs on the band."""
    lens = Lens(np.array([65.0, 45.0]), 90.0, (0.004 + 0.0002 * band, -0.002), (1e-4, 2e-4))
    return Composed(Affine.scaling(1 + 0.002 * band), lens)


MAPS = [band_map(band) for band in range(37)]


@pytest.mark.parametrize("threads", ["1", "3"])
@pytest.mark.parametrize("most_bytes", [0, 1e6, np.inf])
def test_bands_lie_where_they_lie_by_themselves(monkeypatch, threads, most_bytes):
    monkeypatch.setenv("LEVKAS_THREADS", threads)
    seen = 0
    for lattice in lay_runs(MAPS, SHAPE, most_bytes):
        assert lattice.first == seen
        for band in range(lattice.count):
            alone = lay(MAPS[seen + band], SHAPE).lattices[0]
            assert alone.segment == lattice.segment
            assert np.array_equal(lattice.table[..., band], alone.table)
        seen += lattice.count
    assert seen == len(MAPS)


def test_tables_of_single_bands_are_let_go_before_they_are_used(monkeypatch):
    made = []

    def noted(*arguments, lay_band=pixel_maps._lay_band):
        lattice = lay_band(*arguments)
        made.append(weakref.ref(lattice.table))
        return lattice

    monkeypatch.setattr(pixel_maps, "_lay_band", noted)
    for _ in lay_runs(MAPS, SHAPE, 0):
        assert made
        assert not any(table() is not None for table in made)
