"""Dense oriented-gradient descriptors: no weights, blind to contrast sign, colour and slow shading.

After CFOG (Ye, Bruzzone et al., "Fast and robust matching for multimodal remote sensing image registration",
IEEE TGRS 2019): soft-assigned gradient orientation modulo pi, smoothed, normalised per pixel."""

import cv2
import numpy as np

CHANNELS = 8
SMOOTH_SIGMA_PX = 1.2  # tolerance to a few degrees and per cent that the rectification leaves
SATURATION = 4.0  # grey levels of gradient: weaker texture than sensor noise fades out instead of being amplified


class GradientDescriber:
    name = "gradient"
    channels = CHANNELS
    stride = 1  # descriptor cells per image pixel: one

    def describe(self, image: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8 BGR -> (CHANNELS, H, W) float32, each pixel's vector of norm below 1."""
        gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        dx = cv2.Sobel(gray, cv2.CV_32F, 1, 0, ksize=3, scale=0.25)
        dy = cv2.Sobel(gray, cv2.CV_32F, 0, 1, ksize=3, scale=0.25)
        magnitude, angle = cv2.cartToPolar(dx, dy)
        position = angle
        position *= np.float32(CHANNELS / np.pi)
        np.subtract(position, CHANNELS, out=position, where=position >= CHANNELS)
        channels = np.empty((CHANNELS, *gray.shape), np.float32)
        share = np.empty_like(magnitude)  # in place throughout: a large map is described in flight
        for k in range(CHANNELS):
            np.abs(np.subtract(position, k, out=share), out=share)
            if k == 0:  # from the other side, too
                np.minimum(share, CHANNELS - share, out=share)
            np.maximum(np.subtract(1.0, share, out=share), 0.0, out=share)
            cv2.GaussianBlur(np.multiply(share, magnitude, out=share), (0, 0), SMOOTH_SIGMA_PX, channels[k])
        norm = np.sqrt(np.einsum("khw,khw->hw", channels, channels))
        channels /= norm + np.float32(SATURATION * 0.25)
        return channels
