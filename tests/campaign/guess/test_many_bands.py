"""A cube of twenty thousand bands is looked at in the time that its header and some lines take."""

import time

import numpy as np

from levkas.campaign.guess import look


def test_a_cube_of_twenty_thousand_bands(tmp_path):
    bands = 20_000
    rng = np.random.default_rng(1)
    for name, most in (("dark", 50), ("white", 4000), ("icon1", 3000)):
        rng.integers(0, most, (4, bands, 4)).astype("<u2").tofile(tmp_path / f"{name}.raw")
        (tmp_path / f"{name}.hdr").write_text(
            f"ENVI\nsamples = 4\nlines = 4\nbands = {bands}\ninterleave = bil\ndata type = 12\n"
            f"byte order = 0\nwavelength = {{{', '.join(f'{400 + i / 20:g}' for i in range(bands))}}}\n"
        )
    began = time.process_time()
    found = look(tmp_path)
    assert time.process_time() - began < 5
    assert 'kind = "cube"' in found.text and '"icon1"' in found.text
