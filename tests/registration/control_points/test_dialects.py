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

SIZES = {"reference_size": (1392, 1040), "target_size": (3900, 2600)}
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
        reference_frame="icon reference.tif",
        target_frame='icon "target".tif',
        **SIZES,
    )


@pytest.mark.parametrize("dialect", DIALECTS)
@given(points=pairs())
@settings(max_examples=40, deadline=None)
def test_what_is_written_is_what_is_read(dialect, points):
    row = DIALECTS[dialect]
    files = list(format_points(points, dialect))
    assert len(files) == len(row.suffixes)
    back = parse_points(files, dialect=dialect, **SIZES)
    kept = points if "enabled" in row.keeps else points.keep(points.enabled)
    # half a pixel is added and taken off again: one rounding of a number up to 1e5, which is 1.5e-11
    np.testing.assert_allclose(back.reference, kept.reference, rtol=0, atol=1e-10)
    np.testing.assert_allclose(back.target, kept.target, rtol=0, atol=1e-10)
    for what in ("names", "weights", "enabled", "check"):
        if what in row.keeps:
            np.testing.assert_array_equal(getattr(back, what), getattr(kept, what))
    if "frames" in row.keeps:
        assert back.reference_frame == "icon reference.tif"
        assert back.target_frame.replace("'", '"') == 'icon "target".tif'
    assert (back.reference_size, back.target_size) == tuple(SIZES.values())


@pytest.mark.parametrize("dialect", DIALECTS)
@given(points=pairs())
@settings(max_examples=20, deadline=None)
def test_a_written_file_is_known_by_its_content(dialect, points):
    assert {sniff(data) for data in format_points(points, dialect)} == {dialect}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_no_points_at_all_are_written_and_read(dialect):
    none = ControlPoints(np.zeros((0, 2)), np.zeros((0, 2)), **SIZES)
    assert len(parse_points(list(format_points(none, dialect)), dialect=dialect, **SIZES)) == 0


@pytest.mark.parametrize("dialect", DIALECTS)
def test_the_same_points_give_the_same_bytes(dialect):
    points = ControlPoints([[1, 2]], [[3, 4]], **SIZES)
    assert format_points(points, dialect) == format_points(points, dialect)


# The same point of the scene, half a pixel right of and below the middle of the top left pixel of
# both pictures, as each program would write it.
HALF = {
    "levkas": b"reference_x,reference_y,x,y\n0.5,0.5,0.5,0.5\n",
    "bigwarp": b'"Pt-0","true","0.5","0.5","0.5","0.5"\n',
    "qgis": b"#CRS: \nmapX,mapY,sourceX,sourceY,enable,dX,dY,residual\n1,-1,1,-1,1,0,0,0\n",
    "hugin": b'i w4 h3 n"a"\ni w4 h3 n"b"\nc n0 N1 x0.5 y0.5 X0.5 Y0.5 t0\n',
    "elastix": b"point\n1\n0.5 0.5\n",
    "napari": b"index,axis-0,axis-1\n0.0,0.5,0.5\n",
    "butterfly": b"Butterfly Registrator\n1.1\ncontrol points\nAssumes\ntarget\na\nmoving\nb\nx|y|x|y\n1|1|1|1\n",
    "cpselect": b"moving_x,moving_y,fixed_x,fixed_y\n1.5,1.5,1.5,1.5\n",
}


@pytest.mark.parametrize("dialect", HALF)
def test_half_a_pixel_is_half_a_pixel_in_every_dialect(dialect):
    files = [HALF[dialect]] * len(DIALECTS[dialect].suffixes)
    points = parse_points(files, reference_size=(4, 3), target_size=(4, 3))
    np.testing.assert_array_equal(points.reference, [[0.5, 0.5]])
    np.testing.assert_array_equal(points.target, [[0.5, 0.5]])


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_pixel_lies_where_the_dialect_says(dialect):
    """Reference (3, 2), target (5, 1): every axis, order and origin has a number of its own."""
    points = ControlPoints([[3, 2]], [[5, 1]], reference_size=(8, 8), target_size=(8, 8))
    data = format_points(points, dialect)
    shown = {
        "levkas": [",3.0,2.0,5.0,1.0,"],
        "bigwarp": ['"5.0","1.0","3.0","2.0"'],
        "qgis": ["3.5,-2.5,5.5,-1.5,"],
        "hugin": [" x3.0 y2.0 X5.0 Y1.0 "],
        "elastix": ["\n3.0 2.0\n", "\n5.0 1.0\n"],
        "napari": ["\n0,2.0,3.0,", "\n0,1.0,5.0"],
        "butterfly": ["3.5|2.5|5.5|1.5"],
        "cpselect": ["fixed_x,fixed_y,moving_x,moving_y,weight,enabled,check\n,4.0,3.0,6.0,2.0,"],
    }[dialect]
    for text, row in zip(data, shown, strict=True):
        assert row in text.decode()


BIGWARP = """"Pt-0","true","281.716910229645","95.80208768267224","48.70146137787056","313.5204418371608","97.00407557411268","86.78014572025053"
"Pt-1","false","221.96116910229637","30.159081419624187","60.77035490605427","253.6870980375783","25.727196075156513","96.26193244258873"
"Pt-2","true","Infinity","Infinity","Infinity","372.04595298538624","24.74632158663877","96.26193244258873"
"""  # a template's landmarks as BigWarp's author published them, and a point set in one picture only


def test_bigwarp_takes_moving_for_the_target_and_leaves_out_what_has_no_pair():
    points = parse_points([BIGWARP.encode()])
    assert points.names == ("Pt-0", "Pt-1") and points.enabled.tolist() == [True, False]
    assert points.target[0].tolist() == [281.716910229645, 95.80208768267224]
    assert points.reference[1].tolist() == [253.6870980375783, 25.727196075156513]
    with_id = parse_points([b'"Pt-0","true","7","1.0","2.0","3.0","4.0"\n'])
    assert with_id.target.tolist() == [[1.0, 2.0]] and with_id.reference.tolist() == [[3.0, 4.0]]


QGIS_310 = """mapX,mapY,pixelX,pixelY,enable,dX,dY,residual
0.53799722222222224,-50.87444444444444258,1543.36274509803934052,-1680.3137254901957931,1,0.00000000000045475,0.00000000000181899,0.00000000000187497
0.53805555555555551,-50.86722222222222456,1409.71568627451074462,-3495.21568627450915301,0,-0.00000000000181899,0.00000000000181899,0.00000000000257244
"""  # rows of QGIS issue 33607 (version 3.10), the map turned into a picture's frame


def test_points_of_old_and_new_qgis_are_read_alike():
    old = parse_points([QGIS_310.encode()])
    new = parse_points([b"#CRS: \n" + QGIS_310.replace("pixel", "source").encode()])
    bare = parse_points(["\n".join(QGIS_310.splitlines()[1:]).replace(",", "\t").encode()])
    for points in (old, new, bare):
        assert points.target[0].tolist() == [1543.3627450980393 - 0.5, 1680.3137254901958 - 0.5]
        assert points.reference[1].tolist() == [0.5380555555555555 - 0.5, 50.867222222222225 - 0.5]
        assert points.enabled.tolist() == [True, False]


def test_a_land_survey_is_no_reference_picture():
    survey = (
        b"#CRS: EPSG:32644\nmapX,mapY,sourceX,sourceY,enable\n392809.1,1413357.1,198.4,-399.9,1\n"
    )
    with pytest.raises(PointsRefused, match="reference system of the earth"):
        parse_points([survey])


HUGIN = """# hugin project file
#hugin_ptoversion 2
p f2 w3000 h1500 v360  k0 E0 R0 n"TIFF_m c:LZW r:CROP"
m i0
i w3900 h2600 f0 v50 Ra0 r0 p0 y0 TrX0 n"vis 1.tif"
i w1392 h1040 f0 v50 Ra0 r0 p0 y0 TrX0 n"nir.tif"
v Ra0
c n0 N1 x1066.5 y844.333 X239.52 Y804.64 t0
c n1 N0 x10 y20 X30 Y40 t0
c n0 N0 x1 y2 X3 Y4 t1
"""  # the c line of the documentation of Panotools::Script, in a project as Hugin writes it


def test_hugin_points_are_ordered_by_picture_and_lines_left_out():
    points = parse_points([HUGIN.encode()])
    assert points.reference.tolist() == [[1066.5, 844.333], [30, 40]]
    assert points.target.tolist() == [[239.52, 804.64], [10, 20]]
    assert (points.reference_frame, points.target_frame) == ("vis 1.tif", "nir.tif")
    assert (points.reference_size, points.target_size) == ((3900, 2600), (1392, 1040))


def test_a_project_of_three_pictures_is_refused():
    with pytest.raises(PointsRefused, match="2 pairs of pictures"):
        parse_points([(HUGIN + "c n0 N2 x1 y2 X3 Y4 t0\n").encode()])


def test_elastix_files_and_the_table_of_transformix_are_read():
    fixed = b"point\n2\n84.390    168.780   32.500\n96.030    136.770   170.000\n"
    moving = b"index\n2\n87 174 13\n99 141 68\n"  # both of the regnet thread, 3-D
    points = parse_points([fixed, moving])
    assert points.reference.tolist() == [[84.39, 168.78], [96.03, 136.77]]
    assert points.target.tolist() == [[87, 174], [99, 141]]
    table = (
        b"Point\t0\t; InputIndex = [ 10 20 ]\t; InputPoint = [ 10.5 20.25 ]\t; OutputIndexFixed = "
        b"[ 11 21 ]\t; OutputPoint = [ 11.125 21.5 ]\t; Deformation = [ 0.625 1.25 ]\n"
    )
    points = parse_points([table])
    assert points.reference.tolist() == [[10.5, 20.25]] and points.target.tolist() == [
        [11.125, 21.5]
    ]


def test_napari_axes_are_rows_first_and_a_stack_is_cut_to_its_last_two():
    reference = b"index,axis-0,axis-1,axis-2,label\n0.0,3.0,340.25,284.13,eye\n"
    target = b"index,axis-0,axis-1\n0.0,261.6,360.36\n"
    points = parse_points([reference, target])
    assert points.reference.tolist() == [[284.13, 340.25]]
    assert points.target.tolist() == [[360.36, 261.6]]


BUTTERFLY = """Butterfly Registrator
1.0.2
control points
Assumes moving image(s) resized and padded to match target image dimensions
target
s0039V1962_b_crop.png
moving
s0039V1962_Zn_MAXRF.png|s0039V1962_Br_MAXRF.png
x|y|x|y
100.0|80.0|100.0|80.0
"""  # the header of its `save_points`, the files of its tutorial


def test_butterfly_undoes_the_fitting_into_the_reference():
    # 500 × 300 into 1000 × 800: twice as large, so that the edge 100 of the fitted picture is 50
    points = parse_points([BUTTERFLY.encode()], reference_size=(1000, 800), target_size=(500, 300))
    assert points.reference.tolist() == [[99.5, 79.5]]
    assert points.target.tolist() == [[49.5, 39.5]]
    assert points.target_frame == "s0039V1962_Zn_MAXRF.png"
    with pytest.raises(PointsRefused, match="sizes of both pictures"):
        parse_points([BUTTERFLY.encode()])


def test_cpselect_reads_points_as_matlab_exports_them(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text("moving_x,moving_y,fixed_x,fixed_y\n215.5,262.25,164.5,113\n")
    points = read_points(path)
    assert points.target.tolist() == [[214.5, 261.25]]
    assert points.reference.tolist() == [[163.5, 112.0]]


BROKEN = {
    "empty": (b"", "format of these control points is unknown"),
    "picture": (b"\x89PNG\r\n\x1a\n" + bytes(100), "format of these control points is unknown"),
    "bigwarp text": (b'"Pt-0","true","1","2","3","four"\n', "'four' in line 1"),
    "nan": (b"reference_x,reference_y,x,y\n1,2,3,nan\n", "'nan' in y"),
    "far": (b"reference_x,reference_y,x,y\n1,2,3,1e300\n", "not a valid position"),
    "short row": (b"mapX,mapY,sourceX,sourceY\n1,2,3\n", "3 columns"),
    "count": (b"point\n3\n1 2\n3 4\n", "two, of the fixed"),
    "weight": (b"reference_x,reference_y,x,y,weight\n1,2,3,4,0\n", "a weight must be > 0"),
    "mat": (b"MATLAB 5.0 MAT-file" + bytes(200), "format of these control points is unknown"),
    "one layer": (b"index,axis-0,axis-1\n0,1,2\n", "two CSV files"),
    "bytes": (b"reference_x,reference_y,x,y\n1,2,3,\xff\n", "UTF-8"),
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_file_is_refused_with_what_was_found(what):
    data, said = BROKEN[what]
    with pytest.raises(PointsRefused, match=said):
        parse_points([data])


@pytest.mark.parametrize("dialect", DIALECTS)
@given(junk=st.binary(max_size=300), at=st.integers(0, 600))
@settings(max_examples=40, deadline=None)
def test_a_damaged_file_is_read_or_refused_and_nothing_else(dialect, junk, at):
    good = format_points(ControlPoints([[1, 2], [3, 4]], [[5, 6], [7, 8]], **SIZES), dialect)
    files = [data[:at] + junk + data[at + len(junk) :] for data in good]
    try:
        points = parse_points(files, dialect=dialect, **SIZES)
    except PointsRefused:
        return
    assert np.isfinite(points.reference).all() and np.isfinite(points.target).all()


MEGABYTE = 1_000_000
ENDLESS = {
    "empty lines": b"\n" * MEGABYTE,
    "empty lines behind a point file": b"point\n" + b"\n" * MEGABYTE,
    "empty lines behind a header": b"mapX,mapY,pixelX,pixelY\n" + b"\n" * MEGABYTE,
    "spaces": b"c" + b" " * MEGABYTE,
    "one line of pictures": b"c " + b"n1 " * (MEGABYTE // 3),
    "brackets": b"InputPoint OutputPoint " + b"OutputPoint = [" * (MEGABYTE // 15),
    "one word after another": b"point 3 " + b"1 " * MEGABYTE,
    "commas": b"reference_x,reference_y,x,y" + b"," * MEGABYTE,
}


@pytest.mark.parametrize("what", ENDLESS)
def test_a_file_of_much_and_no_points_is_refused_by_the_work_that_it_asks_for(what, tmp_path):
    path = tmp_path / "a.points"
    path.write_bytes(ENDLESS[what])
    began = time.process_time()
    for dialect in (None, *DIALECTS):
        with pytest.raises(PointsRefused) as refused:
            read_points(path, dialect=dialect, **SIZES)
        assert refused.value.problems[0].file == str(path)
    # Two seconds are the bound for one reading; nine were made. Quadratic ways took minutes.
    assert time.process_time() - began < 9 * 2


def test_a_table_of_a_hundred_thousand_frames_is_refused(tmp_path):
    path = tmp_path / "points.csv"
    lines = (f"o{i},c,1,2,3,4" for i in range(100_000))
    path.write_text("\n".join(["object,camera,reference_x,reference_y,x,y", *lines]))
    with pytest.raises(PointsRefused, match="too many frames"):
        read_frames(path, None, {})


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
def test_files_are_written_and_found_again_by_the_name_of_one(dialect, tmp_path):
    points = ControlPoints([[1, 2]], [[3, 4.5]], **SIZES)
    paths = write_points(points, tmp_path / "eyes.file", dialect)
    assert len(paths) == len(DIALECTS[dialect].suffixes) == len(list(tmp_path.iterdir()))
    back = read_points(paths[0], **SIZES)
    np.testing.assert_allclose(back.target, [[3, 4.5]], atol=1e-12)


def test_a_refusal_names_the_file(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text("reference_x,reference_y,x,y\n1,2,3,oops\n")
    with pytest.raises(PointsRefused, match=r"points\.csv"):
        read_points(path)
    with pytest.raises(PointsRefused, match="no such file"):
        read_points(tmp_path / "nothing.csv")
