"""The network: image -> cell descriptors, keypoints, reliability per cell, and one descriptor of the whole image.

The first three outputs are those of XFeat (Potje et al., CVPR 2024), so that it can replace XFeat. The network is small
(0.3 million parameters, 1.5 GMAC for 640 x 640) because it shares two cores with the whole system."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

CHANNELS, TILE_CHANNELS = 64, 128
STRIDE = 8
NORMALISATION_CELLS = (
    5  # window of the local normalisation in cells; small, so that a single map tile gives the same result
)
MIN_CONTRAST = 0.02  # floor, so that sensor noise is not amplified


class FeatureNetwork(nn.Module):
    """``width``: channels at an eighth of the image resolution."""

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self.fine = nn.Sequential(
            _step(3, width // 4, 2),
            _step(width // 4, width // 2, 2),
            _step(width // 2, width // 2),
            _step(width // 2, width, 2),
        )
        self.near = nn.Sequential(_step(width, width), _step(width, width))
        self.wide = nn.Sequential(_step(width, width, 2), _step(width, width), _step(width, width))
        self.joined = nn.Sequential(_step(width, width), nn.Conv2d(width, CHANNELS, 1))
        self.reliability = nn.Conv2d(width, 1, 1)
        self.keypoints = nn.Sequential(_step(STRIDE**2, width, kernel=1), nn.Conv2d(width, STRIDE**2 + 1, 1))
        self.tile = nn.Conv2d(width, TILE_CHANNELS, 1)
        self.tile_power = nn.Parameter(torch.tensor(3.0))
        self.tile_white = nn.Linear(TILE_CHANNELS, TILE_CHANNELS)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(B, 3, H, W), RGB, 0 to 1, sides multiples of 16 -> descriptors (B, 64, H/8, W/8) of norm 1, keypoint logits
        (B, 65, H/8, W/8), reliability (B, 1, H/8, W/8) in 0 to 1, tile descriptor (B, 128) of norm 1."""
        level = normalise_contrast(image)
        fine = self.fine(level)
        wide = F.interpolate(self.wide(fine), scale_factor=2.0, mode="bilinear", align_corners=False)
        features = self.near(fine) + wide
        descriptors = F.normalize(self.joined(features), dim=1, eps=1e-4)
        logits = self.keypoints(F.pixel_unshuffle(level.mean(1, keepdim=True), STRIDE))
        return descriptors, logits, torch.sigmoid(self.reliability(features)), self._tile(features)

    def _tile(self, features: Tensor) -> Tensor:
        """Generalised mean (GeM) over all cells, then whitening, because means of positive values are highly correlated
        (Radenovic et al., Fine-tuning CNN image retrieval, TPAMI 2018)."""
        power = self.tile_power.clamp(1.0, 8.0)
        positive = F.softplus(self.tile(features)) + 1e-3
        return F.normalize(self.tile_white((positive**power).mean((2, 3)) ** (1.0 / power)), dim=1, eps=1e-4)


def normalise_contrast(image: Tensor) -> Tensor:
    """Local brightness and contrast normalisation. It is local, not over the whole image, so that a frame and a map
    tile of another size have the same descriptors where they show the same ground."""
    coarse = F.avg_pool2d(image, STRIDE)
    squares = F.avg_pool2d(image**2, STRIDE)
    around = {
        "kernel_size": NORMALISATION_CELLS,
        "stride": 1,
        "padding": NORMALISATION_CELLS // 2,
        "count_include_pad": False,
    }
    mean = F.avg_pool2d(coarse, **around)
    variance = (F.avg_pool2d(squares, **around) - mean**2).mean(1, keepdim=True)
    contrast = torch.sqrt(variance.clamp(min=0.0) + MIN_CONTRAST**2)
    mean, contrast = (
        F.interpolate(one, scale_factor=float(STRIDE), mode="bilinear", align_corners=False) for one in (mean, contrast)
    )
    return (image - mean) / contrast


def _step(inputs: int, outputs: int, stride: int = 1, kernel: int = 3) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )
