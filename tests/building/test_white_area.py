"""A white board that does not fill the view, in whole builds of every kind of camera."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from sigma_of_builds import Camera, write_campaign

from levkas.building import build, summarise
from levkas.core.cube import Flag
from levkas.database.spectral_tiff import read_tiff_pages

SHAPE, EDGE = (100, 140), 40


class Uncovered(Camera):
    """A camera whose white shows the panel in the first columns."""

    def __init__(self, shape, panel, **more):
        super().__init__(shape, **more)
        self.panel = panel

    def frame(self, reflectance, seconds, light=14_000.0, lamp=1.0):
        if np.ndim(reflectance) and np.all(reflectance == 1):
            reflectance = np.where(np.arange(self.shape[1]) < EDGE, self.panel, 1.0)
        return super().frame(reflectance, seconds, light, lamp)


@pytest.fixture(scope="module")
def panel():
    rng = np.random.default_rng(2)
    return np.kron(rng.uniform(0.1, 0.9, (20, 28)), np.ones((5, 5)))


@pytest.mark.parametrize("kind", ["bands", "mosaic", "cube"])
def test_where_the_white_shows_the_object_there_is_no_reflectance_and_it_is_said(
    tmp_path, panel, kind
):
    camera = Uncovered(SHAPE, panel)
    if kind == "cube":
        camera.response, camera.black = camera.response[:1], camera.black[:1]
    write_campaign(tmp_path / "c", kind, camera, panel, times=(0.02,) * 4)
    report = summarise(build(tmp_path / "c"))
    assert report.ok, report.problems
    (note,) = [w for w in report.warnings if "not the board" in w]
    assert "columns 0 to" in note
    folder = tmp_path / "c/database/objects/panel/native"
    flags = read_tiff_pages(folder / "panel_cam.flags.tif")
    assert (flags[:, : EDGE - 2] & Flag.OUTSIDE).all()
    assert not (flags[:, EDGE + 22 :] & Flag.OUTSIDE).any()
    values = read_tiff_pages(folder / "panel_cam.tif")
    inner = np.s_[:, EDGE + 24 : -4]
    assert np.abs(values[inner].mean(2) / panel[inner] - 1).mean() < 0.1


def test_a_white_that_is_the_object_is_refused_with_its_files(tmp_path, panel):
    class Same(Uncovered):
        def frame(self, reflectance, seconds, light=14_000.0, lamp=1.0):
            white = np.ndim(reflectance) and np.all(reflectance == 1)
            return Camera.frame(self, self.panel if white else reflectance, seconds, light, lamp)

    write_campaign(tmp_path / "c", "bands", Same(SHAPE, panel), panel)
    report = summarise(build(tmp_path / "c"))
    (problem,) = report.problems
    assert problem.code == "E_WHITE_DETAIL" and "white_450nm" in problem.file


@pytest.mark.parametrize("kind", ["bands", "mosaic"])
def test_a_white_with_a_hand_before_it_is_refused_by_name(tmp_path, panel, kind):
    class Hand(Camera):
        whites = 0

        def frame(self, reflectance, seconds, light=14_000.0, lamp=1.0):
            if np.all(reflectance == 1):
                self.whites += 1
                hand = np.ones(self.shape)
                hand[30:70, 50:110] = 0.4
                reflectance = hand if (self.whites - 1) // (4 if kind == "bands" else 1) == 2 else 1
            return super().frame(reflectance, seconds, light, lamp)

    write_campaign(tmp_path / "c", kind, Hand(SHAPE), panel)
    (problem, *_) = summarise(build(tmp_path / "c")).problems
    assert problem.code == "E_UNLIKE_SHOTS" and problem.file.endswith("_2.tif")


class Showing(Camera):
    """A camera before whose white stands something: (h, w) reflectance."""

    white = np.ones(SHAPE)

    def frame(self, reflectance, seconds, light=14_000.0, lamp=1.0):
        reflectance = self.white if np.all(reflectance == 1) else reflectance
        return super().frame(reflectance, seconds, light, lamp)


@pytest.mark.parametrize("kind", ["bands", "mosaic", "mirror"])
def test_another_painting_for_a_white_is_refused_with_its_files(tmp_path, panel, kind):
    camera = Showing(SHAPE)
    tones = np.random.default_rng(8).uniform(0.1, 0.9, (15, 22))
    camera.white = np.kron(tones, np.ones((7, 7)))[3 : SHAPE[0] + 3, 5 : SHAPE[1] + 5]
    write_campaign(tmp_path / "c", kind, camera, panel, times=(0.02,) * 4)
    report = summarise(build(tmp_path / "c"))
    (problem,) = report.problems
    assert problem.code == "E_WHITE_DETAIL" and "white" in problem.file
    assert "picture" in problem.message
