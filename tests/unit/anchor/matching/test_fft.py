"""Spectra compared with NumPy's."""

import numpy as np
import pytest

from terrafix.anchor.matching.fft import spectra, transform_shape


@pytest.mark.parametrize(("height", "width"), [(90, 90), (33, 64), (1, 7), (250, 121)])
def test_spectra_equal_numpys_rfft2_with_zero_padding(height: int, width: int) -> None:
    x = np.random.default_rng(height).normal(size=(3, 2, height, width)).astype(np.float32)
    shape = transform_shape(height, width)
    assert shape[0] >= height and shape[1] >= width and shape[0] % 2 == shape[1] % 2 == 0
    theirs = np.fft.rfft2(x.astype(float), shape)
    ours = spectra(x, shape)
    assert ours.dtype == np.complex64 and ours.shape == theirs.shape
    np.testing.assert_allclose(ours, theirs, atol=1e-6 * np.abs(theirs).max())
    np.testing.assert_allclose(spectra(x[0, 1], shape), ours[0, 1])
