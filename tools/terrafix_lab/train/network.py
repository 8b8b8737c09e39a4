"""The network: image -> one descriptor per cell of four pixels.

It is small (0.2 million parameters) because it shares two cores with the whole system: what a frame and its map need in
flight is a window of some hundred cells a side, described once and kept."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

CHANNELS = 16
STRIDE = 4
POOL_PX = 8  # pixels over which brightness and contrast are averaged first
NORMALISATION_POOLS = 5  # window of the local normalisation; small, so that a single map tile gives the same result
MIN_CONTRAST = 0.02  # floor, so that sensor noise is not amplified


class FeatureNetwork(nn.Module):
    """``width``: channels at a quarter of the image resolution."""

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        self.fine = nn.Sequential(_step(3, width // 2, 2), _step(width // 2, width, 2), _step(width, width))
        self.middle = nn.Sequential(_step(width, 3 * width // 2, 2), _step(3 * width // 2, 3 * width // 2))
        self.wide = nn.Sequential(_step(3 * width // 2, 2 * width, 2), _step(2 * width, 2 * width))
        self.from_wide = _step(2 * width, 3 * width // 2, kernel=1)
        self.from_middle = _step(3 * width // 2, width, kernel=1)
        self.joined = nn.Sequential(_step(width, width), nn.Conv2d(width, CHANNELS, 1))

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W), RGB, 0 to 1, sides multiples of 16 -> descriptors (B, CHANNELS, H/4, W/4) of norm 1."""
        fine = self.fine(normalise_contrast(image))
        middle = self.middle(fine)
        middle = middle + _doubled(self.from_wide(self.wide(middle)))
        return F.normalize(self.joined(fine + _doubled(self.from_middle(middle))), dim=1, eps=1e-4)


def normalise_contrast(image: Tensor) -> Tensor:
    """Local brightness and contrast normalisation. It is local, not over the whole image, so that a frame and a map
    tile of another size have the same descriptors where they show the same ground."""
    coarse = F.avg_pool2d(image, POOL_PX)
    squares = F.avg_pool2d(image**2, POOL_PX)
    around = {
        "kernel_size": NORMALISATION_POOLS,
        "stride": 1,
        "padding": NORMALISATION_POOLS // 2,
        "count_include_pad": False,
    }
    mean = F.avg_pool2d(coarse, **around)
    variance = (F.avg_pool2d(squares, **around) - mean**2).mean(1, keepdim=True)
    contrast = torch.sqrt(variance.clamp(min=0.0) + MIN_CONTRAST**2)
    mean, contrast = (
        F.interpolate(one, scale_factor=float(POOL_PX), mode="bilinear", align_corners=False)
        for one in (mean, contrast)
    )
    return (image - mean) / contrast


def _doubled(features: Tensor) -> Tensor:
    return F.interpolate(features, scale_factor=2.0, mode="bilinear", align_corners=False)


def _step(inputs: int, outputs: int, stride: int = 1, kernel: int = 3) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )
