"""Dense oriented-gradient descriptors: no weights; invariant to contrast sign, colour and slow shading.

After CFOG (Ye, Bruzzone et al., "Fast and robust matching for multimodal remote sensing image registration",
IEEE TGRS 2019): soft-assigned gradient orientation modulo pi, smoothed, normalised per pixel."""

import cv2
import numpy as np

CHANNELS = 8
SMOOTH_SIGMA_PX = 1.2  # tolerates the residual rotation (degrees) and scale (per cent) after rectification
SATURATION = 4.0  # grey levels of gradient: texture weaker than sensor noise is attenuated instead of amplified


class GradientDescriber:
    name = "gradient"
    channels = CHANNELS
    stride = 1  # image pixels per descriptor cell
    grayscale = True  # takes grey images
    context_px = 8  # gradients and their blur reach six pixels

    def describe(self, image: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8 BGR, or (H, W) grey -> (CHANNELS, H, W) float32; the norm of each pixel's vector is below
        1."""
        gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        dx = cv2.Sobel(gray, cv2.CV_32F, 1, 0, ksize=3, scale=0.25)
        dy = cv2.Sobel(gray, cv2.CV_32F, 0, 1, ksize=3, scale=0.25)
        magnitude, angle = cv2.cartToPolar(dx, dy)
        position = angle
        position *= np.float32(CHANNELS / np.pi)
        np.subtract(position, CHANNELS, out=position, where=position >= CHANNELS)
        channels = np.empty((CHANNELS, *gray.shape), np.float32)
        weight = np.empty_like(magnitude)  # all operations in place, because a large map is described in flight
        for k in range(CHANNELS):
            np.abs(np.subtract(position, k, out=weight), out=weight)
            if k == 0:  # orientation is periodic
                np.minimum(weight, CHANNELS - weight, out=weight)
            np.maximum(np.subtract(1.0, weight, out=weight), 0.0, out=weight)
            cv2.GaussianBlur(np.multiply(weight, magnitude, out=weight), (0, 0), SMOOTH_SIGMA_PX, channels[k])
        norm = np.sqrt(np.einsum("khw,khw->hw", channels, channels))
        channels /= norm + np.float32(SATURATION * 0.25)
        return channels
