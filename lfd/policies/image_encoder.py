"""A small convolutional encoder of camera pictures: where in the picture are the things that matter?

Convolutions make K maps, and the spatial softmax makes of each map the place where it is large: 2 K numbers for the
network that follows, instead of thousands (Levine et al. 2016, "End-to-end training of deep visuomotor policies";
Finn et al. 2016, "Deep spatial autoencoders for visuomotor learning").
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from lfd.core.errors import PolicyError

HALVINGS = 2
"""Convolutions, from the first on, that halve the picture."""
GROUP = 16
"""Channels that are normalised together."""


class ImageEncoder(nn.Module):
    """Pictures, in [0, 1] or normalised, to the coordinates of `keypoints` learned points in them.

    3x3 convolutions to each of `channels`, with GroupNorm (which does not depend on the batch) and relu, and one more
    to the maps of the keypoints. While training, pictures are shifted by up to `shift` pixels at random (the draws are
    from torch's global generator, as dropout's are): a keypoint's place is then worth learning relative to others.

    Raises `PolicyError` for a shape that is no picture's, or one too small.
    """

    def __init__(
        self, shape: Sequence[int], channels: Sequence[int] = (32, 64, 64), keypoints: int = 32, shift: int = 0
    ):
        super().__init__()
        least = 2 ** (HALVINGS + 1)
        if len(shape) != 3 or min(shape[1:]) < least:
            raise PolicyError(
                f"a picture of shape {tuple(shape)}; expected channels, height, width, at least {least} pixels a side"
            )
        sizes = [shape[0], *channels]
        layers: list[nn.Module] = []
        for place, (before, after) in enumerate(pairwise(sizes)):
            stride = 2 if place < HALVINGS else 1
            groups = after // GROUP if after % GROUP == 0 else 1
            layers += [nn.Conv2d(before, after, 3, stride, padding=1), nn.GroupNorm(groups, after), nn.ReLU()]
        self.maps = nn.Sequential(*layers, nn.Conv2d(sizes[-1], keypoints, 3, padding=1))
        self.shift = shift
        self.features = 2 * keypoints

    def forward(self, pictures: Float[Tensor, "B C H W"]) -> Float[Tensor, "B F"]:
        if self.training and self.shift:
            offsets = torch.randint(-self.shift, self.shift + 1, (len(pictures), 2), device=pictures.device)
            pictures = shifted(pictures, offsets, self.shift)
        return spatial_softmax(self.maps(pictures)).flatten(1)


def spatial_softmax(maps: Float[Tensor, "B K H W"]) -> Float[Tensor, "B K 2"]:
    """Expected coordinates (x to the right, y down, both in [-1, 1]) under s = softmax of each map over its pixels.

    x = sum_ij s_ij x_j,   y = sum_ij s_ij y_i.
    """
    height, width = maps.shape[-2:]
    s = maps.flatten(2).softmax(-1).unflatten(-1, (height, width))
    y, x = (torch.linspace(-1, 1, n, dtype=maps.dtype, device=maps.device) for n in (height, width))
    return torch.stack([s.sum(-2) @ x, s.sum(-1) @ y], dim=-1)


def shifted(pictures: Float[Tensor, "B C H W"], offsets: Int[Tensor, "B 2"], limit: int) -> Float[Tensor, "B C H W"]:
    """Every picture moved by its offset (down, right) in pixels, at most `limit`; the border is repeated.

    What DrQ does to its pictures (Kostrikov et al. 2021, "Image augmentation is all you need").
    """
    padded = functional.pad(pictures, [limit] * 4, mode="replicate")
    height, width = pictures.shape[-2:]
    crops = padded.unfold(2, height, 1).unfold(3, width, 1)  # (B, C, 2 limit + 1, 2 limit + 1, H, W), a view
    down, right = (limit - offsets).unbind(-1)
    return crops[torch.arange(len(pictures), device=pictures.device), :, down, right]
