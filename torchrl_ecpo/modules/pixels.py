"""What a network sees of pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor, nn
from torchrl.modules import ConvNet

from torchrl_ecpo.checks import check_counts

CHANNELS = (16, 32, 32, 32)
"""Of convolutions each of which halves height and width."""


class PixelEncoder(nn.Module):
    """A small convolutional network over images: bytes, which it scales, or numbers from 0 to 1.

    Four convolutions of 3 x 3 pixels with a stride of 2, and ELU, TorchRL's: 96 x 96 pixels become
    6 x 6 x 32 numbers.

    Args:
        shape: ``(C, H, W)`` of an image; of any height and width.

    Attributes:
        size: how many numbers an image becomes.

    Raises:
        ValueError: unless the shape is of three dimensions.

    Examples:
        >>> import torch
        >>> encoder = PixelEncoder((3, 96, 96))
        >>> encoder(torch.zeros(2, 5, 3, 96, 96, dtype=torch.uint8)).shape
        torch.Size([2, 5, 1152])
    """

    def __init__(self, shape: Sequence[int]) -> None:
        super().__init__()
        sizes = check_counts("shape", shape)
        if len(sizes) != 3:
            raise ValueError(f"shape must be (channels, height, width), got {tuple(shape)}.")
        channels, *sides = sizes
        self.convolutions = ConvNet(
            in_features=channels, num_cells=CHANNELS, kernel_sizes=3, strides=2, paddings=1
        )
        halvings = 2 ** len(CHANNELS)
        self.size = CHANNELS[-1] * math.prod(math.ceil(side / halvings) for side in sides)

    def forward(self, pixels: Tensor) -> Tensor:
        """From ``[..., C, H, W]`` to ``[..., size]``."""
        return self.convolutions(pixels if pixels.is_floating_point() else pixels / 255)
