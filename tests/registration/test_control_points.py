"""Control points of three programs: a file as its program writes it is understood, others are refused."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levkas.registration.control_points import (
    ControlPoints,
    PointsRefused,
    format_points,
    parse_points,
    read_frames,
    read_points,
    sniff,
)

coordinate = st.floats(-1e5, 1e5, allow_nan=False, width=64)
#: The same point of the scene, half a pixel right of and below the middle of the top left pixel of
#: the reference, and (5, 1) of the other picture, as each program would write it.
FILES = {
    "levkas": b"x,y,name,reference_x,reference_y\n5,1,eye,0.5,0.5\n",
    "bigwarp": b'"Pt-0","true","5","1","0.5","0.5"\n',
    "qgis": b"#CRS: \nmapX,mapY,sourceX,sourceY,enable,dX,dY,residual\n1,-1,5.5,-1.5,1,0,0,0\n",
}


@given(st.lists(st.tuples(*[coordinate] * 4, st.booleans(), st.booleans()), max_size=6))
@settings(max_examples=40, deadline=None)
def test_what_is_written_is_what_is_read(rows):
    table = np.array([row[:4] for row in rows]).reshape(-1, 4)
    points = ControlPoints(table[:, :2], table[:, 2:], *zip(*(r[4:] for r in rows), strict=True))
    back = parse_points(format_points(points))
    for what in ("reference", "target", "enabled", "check"):
        np.testing.assert_array_equal(getattr(back, what), getattr(points, what))


@pytest.mark.parametrize("program", FILES)
def test_half_a_pixel_is_half_a_pixel_in_every_program(program):
    assert sniff(FILES[program]) == program
    points = parse_points(FILES[program])
    assert points.reference.tolist() == [[0.5, 0.5]] and points.target.tolist() == [[5.0, 1.0]]


BIGWARP = b""""Pt-0","true","281.716910229645","95.80208768267224","48.70146137787056","313.5204418371608","97.00407557411268","86.78014572025053"
"Pt-1","false","221.96116910229637","30.159081419624187","60.77035490605427","253.6870980375783","25.727196075156513","96.26193244258873"
"Pt-2","true","Infinity","Infinity","Infinity","372.04595298538624","24.74632158663877","96.26193244258873"
"""  # a template's landmarks as BigWarp's author published them, and a point set in one picture only


def test_bigwarp_takes_moving_for_the_target_and_leaves_out_what_has_no_pair():
    points = parse_points(BIGWARP)
    assert points.enabled.tolist() == [True, False]
    assert points.target[0].tolist() == [281.716910229645, 95.80208768267224]
    assert points.reference[1].tolist() == [253.6870980375783, 25.727196075156513]
    with_id = parse_points(b'"Pt-0","true","7","1.0","2.0","3.0","4.0"\n')
    assert with_id.target.tolist() == [[1.0, 2.0]] and with_id.reference.tolist() == [[3.0, 4.0]]


QGIS_310 = """mapX,mapY,pixelX,pixelY,enable,dX,dY,residual
0.53799722222222224,-50.87444444444444258,1543.36274509803934052,-1680.3137254901957931,1,0.00000000000045475,0.00000000000181899,0.00000000000187497
0.53805555555555551,-50.86722222222222456,1409.71568627451074462,-3495.21568627450915301,0,-0.00000000000181899,0.00000000000181899,0.00000000000257244
"""  # rows of QGIS issue 33607 (version 3.10), the map turned into a picture's frame


@pytest.mark.parametrize("text", [QGIS_310, "#CRS: \n" + QGIS_310.replace("pixel", "source")])
def test_points_of_old_and_new_qgis_are_read_alike(text):
    points = parse_points(text.encode())
    assert points.target[0].tolist() == [1543.3627450980393 - 0.5, 1680.3137254901958 - 0.5]
    assert points.reference[1].tolist() == [0.5380555555555555 - 0.5, 50.867222222222225 - 0.5]
    assert points.enabled.tolist() == [True, False]


SURVEY = b"#CRS: EPSG:32644\nmapX,mapY,sourceX,sourceY,enable\n392809.1,1413357.1,198.4,-399.9,1\n"
CSV = b"reference_x,reference_y,x,y\n"
BROKEN = {
    "empty": (b"", "E_UNREADABLE"),
    "picture": (b"\x89PNG\r\n\x1a\n" + bytes(100), "E_UNREADABLE"),
    "bigwarp text": (b'"Pt-0","true","1","2","3","four"\n', "E_UNREADABLE"),
    "nan": (CSV + b"1,2,3,nan\n", "E_UNREADABLE"),
    "far": (CSV + b"1,2,3,1e300\n", "E_VALUE"),
    "short row": (b"mapX,mapY,sourceX,sourceY\n1,2,3\n", "E_UNREADABLE"),
    "bytes": (CSV + b"1,2,3,\xff\n", "E_UNREADABLE"),
    "survey": (SURVEY, "E_UNREADABLE"),
    "many": (CSV + b"1,2,3,4\n" * 100_101, "E_UNREADABLE"),
    "empty lines": (b"mapX,mapY,pixelX,pixelY\n" + b"\n" * 1_000_000, "E_UNREADABLE"),
    "spaces": (b"c" + b" " * 1_000_000, "E_UNREADABLE"),
    "commas": (b"reference_x,reference_y,x,y" + b"," * 1_000_000, "E_UNREADABLE"),
    "missing": (None, "E_UNREADABLE"),
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_file_is_refused_soon_and_named(what, tmp_path):
    data, code = BROKEN[what]
    path = tmp_path / "a.points"
    if data is not None:
        path.write_bytes(data)
    began = time.process_time()
    with pytest.raises(PointsRefused) as refused:
        read_points(path)
    (problem,) = refused.value.problems
    assert (problem.code, problem.file) == (code, str(path))
    assert time.process_time() - began < 2  # quadratic ways took minutes


@pytest.mark.parametrize("program", FILES)
@given(junk=st.binary(max_size=300), at=st.integers(0, 200))
@settings(max_examples=30, deadline=None)
def test_a_damaged_file_is_read_or_refused_and_nothing_else(program, junk, at):
    good = FILES[program]
    try:
        points = parse_points(good[:at] + junk + good[at + len(junk) :])
    except PointsRefused:
        return
    assert np.isfinite(points.reference).all() and np.isfinite(points.target).all()


def test_a_table_of_a_hundred_thousand_frames_is_refused(tmp_path):
    path = tmp_path / "points.csv"
    lines = (f"o{i},c,1,2,3,4" for i in range(100_000))
    path.write_text("\n".join(["object,camera,reference_x,reference_y,x,y", *lines]))
    with pytest.raises(PointsRefused) as refused:
        read_frames(path, None, ())
    assert refused.value.problems[0].code == "E_SIZE"


@pytest.mark.parametrize("sides", [(1, 2), (100_001, 100_001)])
def test_points_that_do_not_pair_up_or_are_too_many_are_refused(sides):
    with pytest.raises(PointsRefused):
        ControlPoints(*(np.zeros((n, 2)) for n in sides))
