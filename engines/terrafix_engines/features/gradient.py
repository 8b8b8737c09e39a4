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
        gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
        dx = cv2.Sobel(gray, cv2.CV_32F, 1, 0, ksize=3, scale=0.25)
        dy = cv2.Sobel(gray, cv2.CV_32F, 0, 1, ksize=3, scale=0.25)
        magnitude, angle = cv2.cartToPolar(dx, dy)
        position = np.mod(angle, np.float32(np.pi)) * np.float32(CHANNELS / np.pi)
        channels = np.empty((CHANNELS, *gray.shape), np.float32)
        for k in range(CHANNELS):
            distance = np.abs(position - k)
            share = np.maximum(1.0 - np.minimum(distance, CHANNELS - distance), 0.0)
            channels[k] = cv2.GaussianBlur(share * magnitude, (0, 0), SMOOTH_SIGMA_PX)
        norm = np.sqrt(np.einsum("khw,khw->hw", channels, channels))
        channels /= norm + SATURATION * 0.25
        return channels
