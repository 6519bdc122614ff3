"""NeuralRTI, reproduced: a network that shows each pixel under a light from nine codes.

T. G. Dulecha et al.: Neural reflectance transformation imaging (The Visual Computer 36, 2020). For
n photos, a coder takes the 3 n values of a pixel through three layers of 3 n units to nine codes; a
decoder takes the codes, and x and y of a light, through three such layers to a colour. Units are
ELU, weights are rounded to 16 bits.
"""

import time
from collections.abc import Iterator
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

Array = NDArray[Any]

CODES = 9
EPOCHS = 30
# Theirs show all pixels under all lights in an epoch, 64 of these pairs in a step, with a rate that
# falls when progress ends: for 50 photos 25 times as many pairs as here.
SHARE = 0.5  # of the pixels, in each epoch
LIGHTS = 4  # of each pixel, drawn anew
BATCH = 256  # pixels of a step
RATE = 2e-3  # of Adam at the start; it falls to 0 as a cosine


class Network(NamedTuple):
    """The codes (H, W, 9) of pixels, the decoder, and the seconds of training."""

    codes: Array
    decoder: nn.Sequential
    seconds: float

    @property
    def weights(self) -> int:
        """The number of weights of the decoder."""
        return sum(p.numel() for p in self.decoder.parameters())

    def shown(self, codes: Array, lights: Array) -> Iterator[Array]:
        """Show pixels with these codes (H, W, 9) under lights (m, 3): pictures (H, W, 3)."""
        rows = torch.from_numpy(codes.reshape(-1, CODES).astype(np.float32))
        for light in torch.from_numpy(lights[:, :2].astype(np.float32)):
            with torch.no_grad():
                colors = self.decoder(torch.cat([rows, light.expand(len(rows), 2)], 1))
            yield colors.numpy().reshape(*codes.shape[:2], 3)


def train(photos: Array, lights: Array) -> Network:
    """Train a coder and a decoder on photos (n, H, W, 3) in [0, 1] under lights (n, 3)."""
    torch.manual_seed(0)
    count, height, width, _ = photos.shape
    units, pixels = 3 * count, height * width
    coder = _layers(units, units, units, units, CODES)
    decoder = _layers(CODES + 2, units, units, units, 3)[:-1]
    colors = torch.from_numpy(np.moveaxis(photos, 0, 2).reshape(pixels, count, 3))
    values, sides = colors.flatten(1), torch.from_numpy(lights[:, :2].astype(np.float32))
    optimizer = torch.optim.Adam([*coder.parameters(), *decoder.parameters()], RATE)
    steps = max(1, int(pixels * SHARE) // BATCH)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, EPOCHS * steps)
    started = time.perf_counter()
    for _ in range(EPOCHS):
        for some in torch.randperm(pixels)[: steps * BATCH].split(BATCH):
            drawn = torch.randint(count, (len(some), LIGHTS))
            codes = coder(values[some])[:, None].expand(-1, LIGHTS, -1)
            shown = decoder(torch.cat([codes, sides[drawn]], 2))
            optimizer.zero_grad()
            nn.functional.mse_loss(shown, colors[some[:, None], drawn]).backward()
            optimizer.step()
            schedule.step()
    with torch.no_grad():
        codes = coder(values).numpy().reshape(height, width, CODES)
    return Network(codes, decoder.half().float(), time.perf_counter() - started)


def _layers(*sizes: int) -> nn.Sequential:
    linear = [nn.Linear(a, b) for a, b in pairwise(sizes)]
    for layer in linear:
        nn.init.xavier_uniform_(layer.weight)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(*(part for layer in linear for part in (layer, nn.ELU())))
