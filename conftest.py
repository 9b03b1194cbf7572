"""What holds for every test and doctest."""

from collections.abc import Iterator

from levkas.core.instructions import hold_instructions

hold_instructions()  # before NumPy is loaded: what tests build in this process is what commands build

import numpy as np  # noqa: E402
import pytest  # noqa: E402


@pytest.fixture(autouse=True)
def numbers_as_numpy_prints_them() -> Iterator[None]:
    """colour-science turns NumPy's printing back by ten years for the whole process."""
    with np.printoptions(legacy=False):
        yield
