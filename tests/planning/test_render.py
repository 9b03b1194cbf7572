"""The closed forms against Mitsuba, where it is installed."""

import importlib
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mitsuba")

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def comparison():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        yield importlib.import_module("plan_render")


@pytest.mark.parametrize("number", [4, 5, 6, 9])
def test_irradiance_and_glare_are_mitsuba_s(comparison, number):
    from levkas.planning.render import load_mitsuba

    found, lost = comparison.compare(
        load_mitsuba("scalar_rgb"), comparison.SETUPS[number], pixels=(20, 15), samples=16
    )
    assert found["irradiance"] <= 0.005 and found["varnish"] <= 0.01 and found["gold"] <= 0.01
    assert lost <= 0.02


def test_crossed_sheets_leave_almost_nothing_of_a_metal_plate(bench):
    from levkas.planning.render import (
        camera_object,
        camera_sheet,
        lamp_objects,
        load_mitsuba,
    )

    mi = load_mitsuba("scalar_spectral_polarized")
    lighting = bench.lighting("crossed")
    level = {}
    for sheets in ("crossed", "parallel"):
        from dataclasses import replace

        changed = replace(lighting, camera_polariser=sheets)
        eye = np.array([0.0, 0.0, 1900.0])
        scene = {
            "type": "scene", "integrator": {"type": "volpath", "max_depth": 3},
            "sensor": camera_object(mi, eye, (40, 40), (4, 4), 64),
            "plate": {
                "type": "rectangle", "to_world": mi.ScalarTransform4f().scale([50, 50, 1]),
                "bsdf": {"type": "roughconductor", "material": "Au", "alpha": 0.2,
                         "distribution": "ggx"},
            },
            **camera_sheet(mi, changed, eye),
        }  # fmt: skip
        for i, lamp in enumerate(changed.lamps):
            scene |= lamp_objects(mi, lamp, f"lamp{i}")
        level[sheets] = float(np.array(mi.render(mi.load_dict(scene)))[..., 1].mean())
    assert level["parallel"] > 0 and level["crossed"] <= 0.002 * level["parallel"]
