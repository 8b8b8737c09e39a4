"""Augmentation: season, illumination, camera and compression; photometric changes that leave the geometry unchanged.

Each change is drawn per image of a batch (B, 3, H, W), RGB, 0 to 1, and applied to a fraction of them. Camera and map
view are augmented independently, so that the network cannot rely on colour or brightness."""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Generator, Tensor

# Colours of vegetation in other seasons: straw, bare soil, dark wood, fresh grass, grey.
TINTS = ((0.76, 0.68, 0.46), (0.55, 0.43, 0.32), (0.16, 0.22, 0.15), (0.40, 0.55, 0.25), (0.50, 0.50, 0.48))
LUMA = (0.299, 0.587, 0.114)
# JPEG luminance quantisation at quality 50 (ITU-T T.81, annex K), approximated by a plane through the corners of the
# table, which is accurate enough for training.
JPEG_STEPS = (10.0, 8.0)  # step at the lowest frequency, and its increase per row and column index


def augment(view: Tensor, g: Generator) -> Tensor:
    """Applies all changes in physical order: ground, illumination, lens, sensor, file."""
    view = view.clone()
    for change, share in CHANGES:
        hit = torch.nonzero(_uniform(view, g, 0.0, 1.0).flatten() < share)[:, 0]
        if len(hit):
            view[hit] = change(view[hit], g).clamp(0.0, 1.0)
    return view


def season(view: Tensor, g: Generator) -> Tensor:
    """Gives vegetation the colour of another season and keeps its texture."""
    green = torch.sigmoid(25.0 * (2.0 * view[:, 1:2] - view[:, 0:1] - view[:, 2:3] - 0.02))
    tints = torch.tensor(TINTS, dtype=view.dtype, device=view.device)
    chosen = tints[torch.randint(len(TINTS), (len(view),), generator=g, device=view.device)][:, :, None, None]
    luma = brightness(view)
    repainted = chosen * (0.4 + 1.2 * luma)
    return torch.lerp(view, repainted, green * _uniform(view, g, 0.4, 1.0))


def other_place(view: Tensor, g: Generator) -> Tensor:
    """Transfers mean and standard deviation of each channel from another image of the batch (Reinhard et al., Color
    transfer between images, 2001, in RGB)."""
    order = torch.randperm(len(view), generator=g, device=view.device)
    mean, spread = view.mean((2, 3), keepdim=True), view.std((2, 3), keepdim=True) + 0.02
    return (view - mean) / spread * spread[order] + mean[order]


def snow(view: Tensor, g: Generator) -> Tensor:
    """Snow in patches, first on bright and flat areas; dark objects stay dark."""
    lying = torch.sigmoid(12.0 * (brightness(view) + 0.6 * _clouds(view, g, 12) - _uniform(view, g, 0.4, 1.0)))
    return torch.lerp(view, 0.85 + 0.15 * view, lying)


def shadows(view: Tensor, g: Generator) -> Tensor:
    """Shadows of clouds and tall objects: hard or soft, slightly blue."""
    dark = torch.sigmoid(_uniform(view, g, 10.0, 60.0) * (_clouds(view, g, 24) - _uniform(view, g, 0.5, 0.8)))
    depth = _uniform(view, g, 0.3, 0.7) * torch.tensor([1.0, 0.95, 0.8], device=view.device)[None, :, None, None]
    return view * (1.0 - dark * depth)


def sun(view: Tensor, g: Generator) -> Tensor:
    """Another sun azimuth: adds or subtracts brightness gradients of a few pixels, as on slopes and walls."""
    reach = int(torch.randint(1, 4, (1,), generator=g, device=view.device))
    luma = brightness(view)
    sides = (0, reach), (reach, 0), (reach, reach), (reach, -reach)
    chosen = sides[int(torch.randint(len(sides), (1,), generator=g, device=view.device))]
    return view + _uniform(view, g, -0.6, 0.6) * (torch.roll(luma, chosen, (2, 3)) - luma)


def light(view: Tensor, g: Generator) -> Tensor:
    """Exposure, gamma, haze, white balance."""
    gamma = torch.exp(_uniform(view, g, -0.6, 0.6))
    balance = torch.exp(0.15 * torch.randn(len(view), 3, 1, 1, generator=g, device=view.device))
    haze = _uniform(view, g, 0.0, 0.4)
    return (view.clamp(min=1e-4) ** gamma * balance * _uniform(view, g, 0.6, 1.4)).clamp(0.0, 1.0) * (1.0 - haze) + haze


def grey(view: Tensor, g: Generator) -> Tensor:
    """Partly or fully monochrome, as from cameras without colour."""
    return torch.lerp(view, brightness(view).expand_as(view), _uniform(view, g, 0.3, 1.0))


def blur(view: Tensor, g: Generator) -> Tensor:
    """Defocus or motion blur: separable Gaussian with independent sigmas per axis."""
    sigmas = torch.exp(torch.rand(2, generator=g, device=view.device) * 1.6 - 1.0).tolist()
    for axis, sigma in zip((2, 3), sigmas, strict=True):
        taps = torch.arange(-4, 5, device=view.device, dtype=view.dtype)
        kernel = torch.exp(-0.5 * (taps / sigma) ** 2)
        kernel = (kernel / kernel.sum()).reshape((1, 1, 9, 1) if axis == 2 else (1, 1, 1, 9)).expand(3, 1, -1, -1)
        pad = (0, 0, 4, 4) if axis == 2 else (4, 4, 0, 0)
        view = F.conv2d(F.pad(view, pad, mode="reflect"), kernel, groups=3)
    return view


def noise(view: Tensor, g: Generator) -> Tensor:
    """Gaussian sensor noise."""
    grain = torch.randn(view.shape, generator=g, device=view.device)
    return view + _uniform(view, g, 0.0, 0.06) * grain


def jpeg(view: Tensor, g: Generator) -> Tensor:
    """JPEG compression of a quality between about 20 and 80: DCT of 8 x 8 blocks, rounding, inverse DCT."""
    k = torch.arange(8, dtype=view.dtype, device=view.device)
    basis = torch.cos(math.pi / 8.0 * (k[None, :] + 0.5) * k[:, None]) * math.sqrt(2.0 / 8.0)
    basis[0] *= math.sqrt(0.5)
    b, c, h, w = view.shape
    blocks = view.reshape(b, c, h // 8, 8, w // 8, 8)
    waves = torch.einsum("ui,bchiwj,vj->bchuwv", basis, blocks, basis)
    steps = (JPEG_STEPS[0] + JPEG_STEPS[1] * (k[:, None] + k[None, :])).reshape(1, 1, 1, 8, 1, 8) / 255.0
    steps = steps * _uniform(view, g, 0.4, 2.5)[..., None, None]
    waves = torch.round(waves / steps) * steps
    return torch.einsum("ui,bchuwv,vj->bchiwj", basis, waves, basis).reshape(b, c, h, w)


# Change and the fraction of images that it is applied to.
CHANGES: tuple[tuple[Callable[[Tensor, Generator], Tensor], float], ...] = (
    (season, 0.5),
    (other_place, 0.3),
    (snow, 0.12),
    (sun, 0.4),
    (shadows, 0.3),
    (light, 0.8),
    (grey, 0.25),
    (blur, 0.4),
    (noise, 0.5),
    (jpeg, 0.5),
)


def brightness(view: Tensor) -> Tensor:
    """Luma: (B, 3, H, W) -> (B, 1, H, W)."""
    weights = torch.tensor(LUMA, dtype=view.dtype, device=view.device)
    return (view * weights[None, :, None, None]).sum(1, keepdim=True)


def _uniform(view: Tensor, g: Generator, low: float, high: float) -> Tensor:
    """(B, 1, 1, 1): one uniform random number per image."""
    return low + (high - low) * torch.rand(len(view), 1, 1, 1, generator=g, device=view.device)


def _clouds(view: Tensor, g: Generator, cells: int) -> Tensor:
    """Smooth random field (B, 1, H, W), 0 to 1."""
    coarse = torch.rand(len(view), 1, cells, cells, generator=g, device=view.device)
    return F.interpolate(coarse, size=view.shape[2:], mode="bicubic", align_corners=False).clamp(0.0, 1.0)
