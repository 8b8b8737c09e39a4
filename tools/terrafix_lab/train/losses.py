"""Training loss: the likelihood of the true place among all places of all maps of the batch.

It is what the matcher decides by, computed as the matcher does: zero-mean normalised correlation of the whole frame,
standardised by the spread of its wrong places, times a learnt slope; so the loss is in nats, and the slope is the
calibration of the belief. The wrong places of the search itself are the negatives: those that nearly win have nearly
all of the gradient (Barsan et al., Learning to localize using a LiDAR intensity map, CoRL 2018; OrienterNet, Sarlin et
al., CVPR 2023)."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from terrafix_lab.train.network import FeatureNetwork
from terrafix_lab.train.views import MAP_CELLS, OFFSETS, STRIDE, Views

NEAR_CELLS = 1.2  # distance from the true place within which a place counts as right
EXCLUDED_CELLS = 4.0  # within which it is no wrong place either
FLAT_VARIANCE = 0.05  # that of the matcher
FIRST_SLOPE = 1.5  # nats a standard deviation


@dataclass(frozen=True)
class PlaceScores:
    """``z`` (B, B, OFFSETS, OFFSETS): standardised correlation of frame i with map j; ``distance`` (B, OFFSETS,
    OFFSETS): cells from the true place, in the frame's own map."""

    z: Tensor
    distance: Tensor

    @property
    def wrong(self) -> Tensor:
        """(B, B, OFFSETS, OFFSETS) bool."""
        own = torch.eye(len(self.z), dtype=torch.bool, device=self.z.device)[:, :, None, None]
        return ~own | (self.distance[:, None] > EXCLUDED_CELLS)


class TrainingLoss(nn.Module):
    """Negative log likelihood of the true place, nats, with the learnt slope."""

    def __init__(self) -> None:
        super().__init__()
        self.log_slope = nn.Parameter(torch.log(torch.tensor(FIRST_SLOPE)))

    def forward(self, network: FeatureNetwork, views: Views) -> tuple[Tensor, PlaceScores]:
        seen = views.mask.repeat_interleave(STRIDE, 0).repeat_interleave(STRIDE, 1)  # a rectified frame is black beyond
        with torch.autocast(views.camera.device.type, torch.bfloat16):
            camera, ground = network(views.camera * seen), network(views.ground)
        scores = place_scores(camera.float(), ground.float(), views)
        return self.nats(scores), scores

    def nats(self, scores: PlaceScores) -> Tensor:
        logits = scores.z * self.log_slope.exp()
        near = scores.distance <= NEAR_CELLS
        own = logits.diagonal(dim1=0, dim2=1).permute(2, 0, 1)
        right = own.masked_fill(~near, -1e4).flatten(1).logsumexp(1)
        wrong = logits.masked_fill(~scores.wrong, -1e4).flatten(1).logsumexp(1)
        return (torch.logaddexp(right, wrong) - right).mean()


def place_scores(camera: Tensor, ground: Tensor, views: Views) -> PlaceScores:
    """Correlation of every frame with every map. ``camera`` (B, C, CELLS, CELLS), ``ground`` (B, C, MAP_CELLS,
    MAP_CELLS)."""
    mask = views.mask
    count = mask.sum()
    centred = (camera - (camera * mask).sum((2, 3), keepdim=True) / count) * mask
    shape = (MAP_CELLS, MAP_CELLS)
    maps = torch.fft.rfft2(ground, shape)
    products = torch.einsum("ickl,jckl->ijkl", torch.fft.rfft2(centred, shape).conj(), maps)
    covariance = torch.fft.irfft2(products, shape)[..., :OFFSETS, :OFFSETS]
    of_mask = torch.fft.rfft2(mask, shape).conj()
    sums = torch.fft.irfft2(maps * of_mask, shape)[..., :OFFSETS, :OFFSETS]
    squares = torch.fft.irfft2(torch.fft.rfft2((ground**2).sum(1), shape) * of_mask, shape)[..., :OFFSETS, :OFFSETS]
    variance = squares - (sums**2).sum(1) / count
    energy = (centred**2).sum((1, 2, 3))[:, None, None, None].clamp(min=1e-6)
    floored = torch.maximum(variance[None], FLAT_VARIANCE * energy)
    correlation = covariance / torch.sqrt(floored * energy)
    axis = torch.arange(OFFSETS, dtype=torch.float32, device=camera.device)
    rows = axis[None, :, None] - views.place[:, 0, None, None]
    columns = axis[None, None, :] - views.place[:, 1, None, None]
    scores = PlaceScores(correlation, torch.hypot(rows, columns))
    used = scores.wrong.float()
    total = used.sum((1, 2, 3), keepdim=True)
    mean = (correlation * used).sum((1, 2, 3), keepdim=True) / total
    spread = torch.sqrt((((correlation - mean) * used) ** 2).sum((1, 2, 3), keepdim=True) / total + 1e-8)
    return PlaceScores((correlation - mean) / spread, scores.distance)
