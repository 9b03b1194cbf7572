"""Tables over wavelength and angle that look sound and are not."""

import numpy as np
import pytest

from levkas.core.problems import Refused
from levkas.quality.targets.charts import Chart, parse_reference
from levkas.stages.spectra import read_sensitivity, read_spectrum

CHART = Chart("two by two", 2, 2, (0, 1, 2, 3))


def sensitivity(path):
    return read_sensitivity(path, ["B1", "B2"])


def chart(path):
    return parse_reference(path.read_bytes().decode(), CHART, file=str(path))


@pytest.mark.parametrize(
    ("read", "text"),
    [
        (sensitivity, "nm,B1,B2\n400,0,1\n500,1,0\n500,1,1\n"),  # 500 nm twice
        (sensitivity, "nm,B1,B2\n400,0,1\n,1,0\n"),  # no wavelength
        (sensitivity, "nm,B1,B2\n0,0,1\n500,1,0\n"),
        (sensitivity, "nm,B1,B2\n400,0,1\n500,1e999,0\n"),
        (sensitivity, "nm,x,y,B1,B2\n400,0,1,2\n500,1,0,3\n"),  # more headings than columns
        (read_spectrum, "400,0.9\n600,0.5\n600,0.7\n"),
        (chart, "nm,A1,B1,A2,B2\n400,1,2,3,4\n400,5,6,7,8\n"),
        (chart, "nm,A1,B1,A2,B2\n-1,1,2,3,4\n400,5,6,7,8\n"),
        (chart, "nm,A1\x0cB1\n#\x01\rA2,B2\r\r,1,2,3,4\n400,5"),
    ],
)
def test_a_table_that_says_no_value_or_two_of_one_place_is_refused(tmp_path, read, text):
    path = tmp_path / "table.csv"
    path.write_bytes(text.encode())
    with pytest.raises(Refused):
        read(path)


def test_rows_of_sensitivities_may_stand_in_any_order(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("nm,B2,B1\n500,1,0\n400,0.5,\n600,2,3\n")
    wavelengths, values = sensitivity(path)
    assert wavelengths.tolist() == [400, 500, 600]
    np.testing.assert_array_equal(values, [[0, 0.5], [0, 1], [3, 2]])
