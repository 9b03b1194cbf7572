"""Every dialect: what is written is what is read, and a file as its program writes it is understood."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levkas.registration.control_points import (
    DIALECTS,
    ControlPoints,
    PointsRefused,
    format_points,
    losses,
    parse_points,
    read_points,
    sniff,
    write_points,
)
from levkas.registration.control_points.layers import read_frames

coordinate = st.floats(-1e5, 1e5, allow_nan=False, width=64)
name = st.text(st.characters(categories=["L", "N", "P", "S", "Zs"]), max_size=12).filter(
    str.isprintable
)


@st.composite
def pairs(draw):
    n = draw(st.integers(1, 6))

    def column(values):
        return draw(st.lists(values, min_size=n, max_size=n))

    return ControlPoints(
        column(st.tuples(coordinate, coordinate)),
        column(st.tuples(coordinate, coordinate)),
        names=column(name),
        weights=column(st.floats(1e-3, 1e3)),
        enabled=column(st.booleans()),
        check=column(st.booleans()),
    )


@pytest.mark.parametrize("dialect", DIALECTS)
@given(points=pairs())
@settings(max_examples=40, deadline=None)
def test_what_is_written_is_what_is_read(dialect, points):
    row = DIALECTS[dialect]
    kept, back = points, parse_points(format_points(points, dialect), dialect=dialect)
    # half a pixel is added and taken off again: one rounding of a number up to 1e5, which is 1.5e-11
    np.testing.assert_allclose(back.reference, kept.reference, rtol=0, atol=1e-10)
    np.testing.assert_allclose(back.target, kept.target, rtol=0, atol=1e-10)
    for what in ("names", "weights", "enabled", "check"):
        if what in row.keeps:
            np.testing.assert_array_equal(getattr(back, what), getattr(kept, what))


@pytest.mark.parametrize("dialect", DIALECTS)
@given(points=pairs())
@settings(max_examples=20, deadline=None)
def test_a_written_file_is_known_by_its_content(dialect, points):
    assert sniff(format_points(points, dialect)) == dialect


@pytest.mark.parametrize("dialect", DIALECTS)
def test_no_points_at_all_are_written_and_read(dialect):
    none = ControlPoints(np.zeros((0, 2)), np.zeros((0, 2)))
    assert len(parse_points(format_points(none, dialect), dialect=dialect)) == 0


@pytest.mark.parametrize("dialect", DIALECTS)
def test_the_same_points_give_the_same_bytes(dialect):
    points = ControlPoints([[1, 2]], [[3, 4]])
    assert format_points(points, dialect) == format_points(points, dialect)


# The same point of the scene, half a pixel right of and below the middle of the top left pixel of
# both pictures, as each program would write it.
HALF = {
    "levkas": b"reference_x,reference_y,x,y\n0.5,0.5,0.5,0.5\n",
    "bigwarp": b'"Pt-0","true","0.5","0.5","0.5","0.5"\n',
    "qgis": b"#CRS: \nmapX,mapY,sourceX,sourceY,enable,dX,dY,residual\n1,-1,1,-1,1,0,0,0\n",
}


@pytest.mark.parametrize("dialect", HALF)
def test_half_a_pixel_is_half_a_pixel_in_every_dialect(dialect):
    points = parse_points(HALF[dialect])
    np.testing.assert_array_equal(points.reference, [[0.5, 0.5]])
    np.testing.assert_array_equal(points.target, [[0.5, 0.5]])


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_pixel_lies_where_the_dialect_says(dialect):
    """Reference (3, 2), target (5, 1): every axis, order and origin has a number of its own."""
    points = ControlPoints([[3, 2]], [[5, 1]])
    data = format_points(points, dialect)
    shown = {
        "levkas": ",3.0,2.0,5.0,1.0,",
        "bigwarp": '"5.0","1.0","3.0","2.0"',
        "qgis": "3.5,-2.5,5.5,-1.5,",
    }[dialect]
    assert shown in data.decode()


BIGWARP = """"Pt-0","true","281.716910229645","95.80208768267224","48.70146137787056","313.5204418371608","97.00407557411268","86.78014572025053"
"Pt-1","false","221.96116910229637","30.159081419624187","60.77035490605427","253.6870980375783","25.727196075156513","96.26193244258873"
"Pt-2","true","Infinity","Infinity","Infinity","372.04595298538624","24.74632158663877","96.26193244258873"
"""  # a template's landmarks as BigWarp's author published them, and a point set in one picture only


def test_bigwarp_takes_moving_for_the_target_and_leaves_out_what_has_no_pair():
    points = parse_points(BIGWARP.encode())
    assert points.names == ("Pt-0", "Pt-1") and points.enabled.tolist() == [True, False]
    assert points.target[0].tolist() == [281.716910229645, 95.80208768267224]
    assert points.reference[1].tolist() == [253.6870980375783, 25.727196075156513]
    with_id = parse_points(b'"Pt-0","true","7","1.0","2.0","3.0","4.0"\n')
    assert with_id.target.tolist() == [[1.0, 2.0]] and with_id.reference.tolist() == [[3.0, 4.0]]


QGIS_310 = """mapX,mapY,pixelX,pixelY,enable,dX,dY,residual
0.53799722222222224,-50.87444444444444258,1543.36274509803934052,-1680.3137254901957931,1,0.00000000000045475,0.00000000000181899,0.00000000000187497
0.53805555555555551,-50.86722222222222456,1409.71568627451074462,-3495.21568627450915301,0,-0.00000000000181899,0.00000000000181899,0.00000000000257244
"""  # rows of QGIS issue 33607 (version 3.10), the map turned into a picture's frame


def test_points_of_old_and_new_qgis_are_read_alike():
    old = parse_points(QGIS_310.encode())
    new = parse_points(b"#CRS: \n" + QGIS_310.replace("pixel", "source").encode())
    bare = parse_points("\n".join(QGIS_310.splitlines()[1:]).replace(",", "\t").encode())
    for points in (old, new, bare):
        assert points.target[0].tolist() == [1543.3627450980393 - 0.5, 1680.3137254901958 - 0.5]
        assert points.reference[1].tolist() == [0.5380555555555555 - 0.5, 50.867222222222225 - 0.5]
        assert points.enabled.tolist() == [True, False]


def test_a_land_survey_is_no_reference_picture():
    survey = (
        b"#CRS: EPSG:32644\nmapX,mapY,sourceX,sourceY,enable\n392809.1,1413357.1,198.4,-399.9,1\n"
    )
    with pytest.raises(PointsRefused, match="reference system of the earth"):
        parse_points(survey)


BROKEN = {
    "empty": (b"", "format of these control points is unknown"),
    "picture": (b"\x89PNG\r\n\x1a\n" + bytes(100), "format of these control points is unknown"),
    "bigwarp text": (b'"Pt-0","true","1","2","3","four"\n', "'four' in line 1"),
    "nan": (b"reference_x,reference_y,x,y\n1,2,3,nan\n", "'nan' in y"),
    "far": (b"reference_x,reference_y,x,y\n1,2,3,1e300\n", "not a valid position"),
    "short row": (b"mapX,mapY,sourceX,sourceY\n1,2,3\n", "3 columns"),
    "weight": (b"reference_x,reference_y,x,y,weight\n1,2,3,4,0\n", "a weight must be > 0"),
    "mat": (b"MATLAB 5.0 MAT-file" + bytes(200), "format of these control points is unknown"),
    "bytes": (b"reference_x,reference_y,x,y\n1,2,3,\xff\n", "UTF-8"),
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_file_is_refused_with_what_was_found(what):
    data, said = BROKEN[what]
    with pytest.raises(PointsRefused, match=said):
        parse_points(data)


@pytest.mark.parametrize("dialect", DIALECTS)
@given(junk=st.binary(max_size=300), at=st.integers(0, 600))
@settings(max_examples=40, deadline=None)
def test_a_damaged_file_is_read_or_refused_and_nothing_else(dialect, junk, at):
    good = format_points(ControlPoints([[1, 2], [3, 4]], [[5, 6], [7, 8]]), dialect)
    try:
        points = parse_points(good[:at] + junk + good[at + len(junk) :], dialect=dialect)
    except PointsRefused:
        return
    assert np.isfinite(points.reference).all() and np.isfinite(points.target).all()


MEGABYTE = 1_000_000
ENDLESS = {
    "empty lines": b"\n" * MEGABYTE,
    "empty lines behind a header": b"mapX,mapY,pixelX,pixelY\n" + b"\n" * MEGABYTE,
    "spaces": b"c" + b" " * MEGABYTE,
    "commas": b"reference_x,reference_y,x,y" + b"," * MEGABYTE,
}


@pytest.mark.parametrize("what", ENDLESS)
def test_a_file_of_much_and_no_points_is_refused_by_the_work_that_it_asks_for(what, tmp_path):
    path = tmp_path / "a.points"
    path.write_bytes(ENDLESS[what])
    began = time.process_time()
    for dialect in (None, *DIALECTS):
        with pytest.raises(PointsRefused) as refused:
            read_points(path, dialect=dialect)
        assert refused.value.problems[0].file == str(path)
    # Two seconds are the bound for one reading; four were made. Quadratic ways took minutes.
    assert time.process_time() - began < 4 * 2


def test_a_table_of_a_hundred_thousand_frames_is_refused(tmp_path):
    path = tmp_path / "points.csv"
    lines = (f"o{i},c,1,2,3,4" for i in range(100_000))
    path.write_text("\n".join(["object,camera,reference_x,reference_y,x,y", *lines]))
    with pytest.raises(PointsRefused, match="too many frames"):
        read_frames(path, None, ())


def test_too_many_points_are_refused():
    with pytest.raises(PointsRefused, match="too many points"):
        ControlPoints(np.zeros((100_001, 2)), np.zeros((100_001, 2)))


def test_points_of_one_side_do_not_pair_up():
    with pytest.raises(PointsRefused, match="numbers of points differ"):
        ControlPoints([[0, 0]], [[0, 0], [1, 1]])


def test_what_a_dialect_cannot_hold_is_said():
    points = ControlPoints(
        [[0, 0]] * 3, [[0, 0]] * 3, names=["a", "", "c"], weights=[1, 2, 1], check=[1, 0, 0]
    )
    assert losses(points, "levkas") == []
    assert losses(points, "bigwarp") == ["1 weights not kept", "1 marks as check point not kept"]


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_file_that_is_written_is_read(dialect, tmp_path):
    write_points(ControlPoints([[1, 2]], [[3, 4.5]]), tmp_path / "eyes.file", dialect)
    np.testing.assert_allclose(read_points(tmp_path / "eyes.file").target, [[3, 4.5]], atol=1e-12)


def test_a_refusal_names_the_file(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text("reference_x,reference_y,x,y\n1,2,3,oops\n")
    with pytest.raises(PointsRefused, match=r"points\.csv"):
        read_points(path)
    with pytest.raises(PointsRefused, match="no such file"):
        read_points(tmp_path / "nothing.csv")
