"""What holds for every test and doctest."""

from collections.abc import Iterator

import numpy as np
import pytest


@pytest.fixture(autouse=True)
def numbers_as_numpy_prints_them() -> Iterator[None]:
    """colour-science turns NumPy's printing back by ten years for the whole process."""
    with np.printoptions(legacy=False):
        yield
