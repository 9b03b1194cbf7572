"""Libraries of spectra, as the programs that write them have them."""

import numpy as np
import pytest
import xarray
from spectral.io import envi

import levkas
from levkas.core.problems import Refused

NM = np.arange(400.0, 701.0, 10.0)
VALUES = np.stack([np.linspace(0.1, 0.9, 31), 0.5 + 0.3 * np.sin(NM / 40)])


def library():
    coords = {"spectrum": ["azurite", "lead white, new"], "wavelength": NM}
    return xarray.DataArray(VALUES, coords, ("spectrum", "wavelength"))


@pytest.mark.parametrize("suffix", [".sli", ".csv"])
def test_what_is_written_is_read(tmp_path, suffix):
    levkas.write_spectra(tmp_path / f"a{suffix}", library())
    read = levkas.read_spectra(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(read.values, VALUES, rtol=1e-15)
    assert read.wavelength.values.tolist() == NM.tolist()
    assert read.spectrum.values[0] == "azurite"


def test_spectral_python_reads_a_library_of_ours_and_we_read_its(tmp_path):
    levkas.write_spectra(tmp_path / "ours.sli", library())
    theirs = envi.open(str(tmp_path / "ours.hdr"), str(tmp_path / "ours.sli"))
    np.testing.assert_allclose(theirs.spectra, VALUES, rtol=1e-6)
    assert theirs.bands.centers == NM.tolist() and theirs.names[0] == "azurite"
    header = {
        "wavelength": (NM / 1000).tolist(),
        "wavelength units": "Micrometers",
        "spectra names": ["a", "b"],
    }
    envi.SpectralLibrary(VALUES.astype("f4"), header).save(str(tmp_path / "micro"))
    read = levkas.read_spectra(tmp_path / "micro.sli")
    np.testing.assert_allclose(read.wavelength.values, NM)
    np.testing.assert_allclose(read.values, VALUES, rtol=1e-6)


@pytest.mark.parametrize("content", [b"", b"a,b\nx,y\n", b"ENVI\n", b"\x00\xff" * 300])
def test_files_that_are_none_are_refused_by_name(tmp_path, content):
    (tmp_path / "no.csv").write_bytes(content)
    with pytest.raises(Refused):
        levkas.read_spectra(tmp_path / "no.csv")
    with pytest.raises(Refused):
        levkas.read_spectra(tmp_path / "absent.sli")
