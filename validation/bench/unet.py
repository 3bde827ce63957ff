"""A small U-Net (Ronneberger, Fischer and Brox 2015, MICCAI, 234) that reads a stripe.

It is trained on other scenes, and needs PyTorch. Three levels of 12, 24 and 48 channels: 77 000 weights.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from noise_model.compiled.arrays import Float64, Integers
from validation.bench.scenes import BenchScene

WEIGHTS = Path(__file__).parent / "unet.npz"
"""Weights of half precision."""

CHANNELS = (12, 24, 48)

SIGMA_PX = 2.0
"""Sigma to which a stripe is scaled before the network sees it, px: stripes of all widths look alike then."""

CROP_PX, BATCH, STEPS, LEARNING_RATE, SEED = 128, 16, 1500, 2e-3, 0

MIN_PROBABILITY = 0.5
"""Probability of the stripe from which on a column has a centre."""


Example = tuple[np.ndarray, np.ndarray]
"""A frame as the network takes it, and its mask."""


def _torch() -> Any:
    try:
        import torch
    except ImportError:
        from arctrack.errors import ArctrackError

        raise ArctrackError("the U-Net needs PyTorch: pip install torch; or leave u-net out") from None
    return torch


def network() -> Any:
    """Return the network, without weights."""
    torch = _torch()
    nn = torch.nn

    def block(n_in: int, n_out: int) -> Any:
        layers = []
        for n in (n_in, n_out):
            layers += [nn.Conv2d(n, n_out, 3, padding=1), nn.BatchNorm2d(n_out), nn.ReLU()]
        return nn.Sequential(*layers)

    class UNet(nn.Module):  # type: ignore[misc, name-defined]
        def __init__(self) -> None:
            super().__init__()
            a, b, c = CHANNELS
            self.down = nn.ModuleList([block(1, a), block(a, b), block(b, c)])
            self.up = nn.ModuleList([block(c + b, b), block(b + a, a)])
            self.out = nn.Conv2d(a, 1, 1)

        def forward(self, x: Any) -> Any:
            first = self.down[0](x)
            second = self.down[1](nn.functional.max_pool2d(first, 2))
            x = self.down[2](nn.functional.max_pool2d(second, 2))
            for layer, beside in zip(self.up, (second, first), strict=True):
                x = nn.functional.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)
                x = layer(torch.cat([x, beside], 1))
            return self.out(x)

    return UNet()


def _scaled(image: Integers, width_px: float) -> tuple[np.ndarray, float]:
    """Return the image as the network takes it, sides multiples of 4, and its scale."""
    scale = min(SIGMA_PX / width_px, 1.0)
    size = [max(4, 4 * round(scale * n / 4)) for n in image.shape[::-1]]
    grey = cv2.resize(np.sqrt(image.astype(np.float32)), size, interpolation=cv2.INTER_AREA)
    return (grey - grey.mean()) / (grey.std() + 1e-6), size[1] / image.shape[0]


class UNetReader:
    """The trained network as a reader of stripes."""

    def __init__(self, weights: Path = WEIGHTS) -> None:
        torch = _torch()
        torch.set_num_threads(1)
        self._network = network()
        with np.load(weights) as arrays:
            state = {name: torch.from_numpy(arrays[name].astype(np.float32)) for name in arrays.files}
        self._network.load_state_dict(state, strict=False)
        self._network.eval()

    def __call__(self, image: Integers, width_px: float) -> Float64:
        """Return the stripe's row in each column (W,), NaN for none: the centroid of its probability."""
        torch = _torch()
        grey, scale = _scaled(image, width_px)
        with torch.no_grad():
            p = torch.sigmoid(self._network(torch.from_numpy(grey)[None, None]))[0, 0].numpy().astype(float)
        rows = np.arange(len(p))[:, np.newaxis]
        near = np.where(np.abs(rows - np.argmax(p, axis=0)) <= 3.0 * SIGMA_PX, p, 0.0)
        centre = (near * rows).sum(axis=0) / near.sum(axis=0)
        centre = np.where(p.max(axis=0) >= MIN_PROBABILITY, (centre + 0.5) / scale - 0.5, np.nan)
        columns = (np.arange(image.shape[1]) + 0.5) * p.shape[1] / image.shape[1] - 0.5
        place = np.clip(np.round(columns).astype(int), 0, p.shape[1] - 1)
        # The centre of the nearest column of the network's, moved along the line through its neighbours.
        slope = np.gradient(centre)
        return np.asarray(centre[place] + np.nan_to_num(slope[place]) * (columns - place))


def train(scenes: Sequence[BenchScene], on_step: Callable[[int], None], steps: int = STEPS) -> None:
    """Train the network on scenes' frames and write its weights; the loss is the cross entropy of pixels."""
    torch = _torch()
    torch.manual_seed(SEED)
    draw = np.random.default_rng(SEED)
    examples = [_example(scene, n) for scene in scenes for n in range(len(scene.frames))]
    net = network()
    optimiser = torch.optim.Adam(net.parameters(), lr=LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE, total_steps=steps)
    # A stripe covers few of the pixels.
    loss_of = torch.nn.BCEWithLogitsLoss(pos_weight=torch.tensor(4.0))
    for step in range(steps):
        crops = [_crop(examples[n], draw) for n in draw.integers(len(examples), size=BATCH)]
        images, masks = (torch.from_numpy(np.stack(each)[:, None]) for each in zip(*crops, strict=True))
        optimiser.zero_grad()
        loss_of(net(images), masks).backward()
        optimiser.step()
        schedule.step()
        on_step(step + 1)
    state = {name: value.numpy() for name, value in net.state_dict().items() if value.is_floating_point()}
    np.savez_compressed(WEIGHTS, **{name: value.astype(np.float16) for name, value in state.items()})


def _example(scene: BenchScene, n: int) -> Example:
    """Return a frame as the network takes it, and the mask of its stripe, 1 sigma to either side."""
    given = scene.frames[n]
    image = scene.upright(given.frame)
    grey, scale = _scaled(image, scene.width_px)
    wide = image.shape[1]
    columns = np.round((np.arange(grey.shape[1]) + 0.5) * wide / grey.shape[1] - 0.5)
    centre = (given.stripe_px[np.clip(columns, 0, wide - 1).astype(int)] + 0.5) * scale - 0.5
    rows = np.arange(grey.shape[0])[:, np.newaxis]
    half = max(scale * scene.width_px, 0.75)
    mask = np.abs(rows - np.nan_to_num(centre, nan=-math.inf)) <= half
    return grey.astype(np.float32), mask.astype(np.float32)


def _crop(example: Example, draw: np.random.Generator) -> Example:
    """Draw a square of a frame, mirrored at random, with more or less contrast."""
    padded = [np.pad(each, [(0, max(CROP_PX - n, 0)) for n in each.shape]) for each in example]
    low_v, low_u = (int(draw.integers(n - CROP_PX + 1)) for n in padded[0].shape)
    cut = [each[low_v : low_v + CROP_PX, low_u : low_u + CROP_PX] for each in padded]
    for axis in (0, 1):
        if draw.random() < 0.5:
            cut = [np.flip(each, axis) for each in cut]
    return np.ascontiguousarray(cut[0] * np.float32(draw.uniform(0.8, 1.25))), np.ascontiguousarray(cut[1])
