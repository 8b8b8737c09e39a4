"""Cross-correlation compared with NumPy's transforms."""

import numpy as np
import pytest

from terrafix.anchor.matching.fft import cross_correlation, spectra, template_spectra, transform_shape


@pytest.mark.parametrize("channels", [1, 2, 3, 8])
@pytest.mark.parametrize(("height", "width"), [(90, 90), (33, 64), (1, 7), (250, 121)])
def test_the_cross_correlation_equals_that_of_numpys_transforms_with_zero_padding(
    height: int, width: int, channels: int
) -> None:
    rng = np.random.default_rng(height)
    image, template = rng.normal(size=(2, channels, height, width)).astype(np.float32)
    template = template[:, : (height + 1) // 2, : (width + 1) // 2]
    shape = transform_shape(height, width)
    assert shape[0] >= height and shape[1] >= width
    theirs = np.fft.irfft2(
        (np.fft.rfft2(image.astype(float), shape) * np.fft.rfft2(template.astype(float), shape).conj()).sum(0), shape
    )
    ours = cross_correlation(spectra(image, shape), template_spectra(template, shape))
    assert ours.dtype == np.float32 and ours.shape == shape
    np.testing.assert_allclose(ours, theirs, atol=1e-5 * np.abs(theirs).max())


def test_the_peak_is_where_the_template_was_cut_from_the_image() -> None:
    image = np.random.default_rng(1).normal(size=(2, 40, 50)).astype(np.float32)
    shape = transform_shape(40, 50)
    surface = cross_correlation(spectra(image, shape), template_spectra(image[:, 7:20, 11:30], shape))
    assert np.unravel_index(int(np.argmax(surface)), shape) == (7, 11)
