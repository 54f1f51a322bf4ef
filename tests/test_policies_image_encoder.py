import time

import numpy as np
import pytest
import torch
from torch import nn

from lfd.core.errors import PolicyError
from lfd.policies.image_encoder import ImageEncoder, shifted, spatial_softmax


def test_the_spatial_softmax_is_the_expected_place_summed_pixel_by_pixel() -> None:
    maps = torch.randn(2, 3, 5, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    places = spatial_softmax(maps)
    for b in range(2):
        for k in range(3):
            weights = np.exp(maps[b, k].numpy())
            x = y = 0.0
            for i in range(5):
                for j in range(7):
                    x += weights[i, j] * (-1 + 2 * j / 6)
                    y += weights[i, j] * (-1 + 2 * i / 4)
            np.testing.assert_allclose(places[b, k], [x / weights.sum(), y / weights.sum()])


def test_a_bright_pixel_is_found_where_it_is() -> None:
    maps = torch.zeros(1, 1, 9, 9)
    maps[0, 0, 0, 8] = 100  # top right
    torch.testing.assert_close(spatial_softmax(maps), torch.tensor([[[1.0, -1.0]]]))


def test_shifted_pictures_are_moved_and_their_border_repeated() -> None:
    pictures = torch.arange(2 * 3 * 6 * 5, dtype=torch.float32).reshape(2, 3, 6, 5)
    offsets = torch.tensor([[2, -1], [0, 3]])
    moved = shifted(pictures, offsets, 3)
    for picture, after, (down, right) in zip(pictures, moved, offsets.tolist(), strict=True):
        for i in range(6):
            for j in range(5):
                source = picture[:, min(max(i - down, 0), 5), min(max(j - right, 0), 4)]
                torch.testing.assert_close(after[:, i, j], source, rtol=0, atol=0)


def test_shifts_happen_in_training_only_and_follow_torchs_seed() -> None:
    encoder = ImageEncoder((3, 32, 32), channels=(8, 8), keypoints=4, shift=4)
    pictures = torch.rand(5, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    encoder.train()
    torch.manual_seed(1)
    once = encoder(pictures)
    assert not torch.equal(once, encoder(pictures))
    torch.manual_seed(1)
    assert torch.equal(once, encoder(pictures))
    encoder.eval()
    assert torch.equal(encoder(pictures), encoder(pictures))


@pytest.mark.parametrize("shape", [(3, 84, 84), (1, 96, 128), (3, 128, 128), (3, 8, 9)])
def test_features_are_coordinates(shape) -> None:
    encoder = ImageEncoder(shape, keypoints=6)
    features = encoder(torch.rand(2, *shape))
    assert features.shape == (2, encoder.features) == (2, 12)
    assert features.abs().max() <= 1


@pytest.mark.parametrize("shape", [(84, 84), (3, 4, 84)])
def test_what_is_no_picture_is_refused(shape) -> None:
    with pytest.raises(PolicyError, match="expected channels, height, width, at least 8 pixels a side"):
        ImageEncoder(shape)


def test_the_encoder_learns_where_a_square_is() -> None:
    """A square at random places on a noisy ground; after some steps a linear layer tells the place."""
    torch.manual_seed(0)

    def draw(count: int) -> tuple[torch.Tensor, torch.Tensor]:
        corner = torch.randint(0, 26, (count, 2))
        pictures = torch.rand(count, 3, 32, 32) * 0.3
        for picture, (i, j) in zip(pictures, corner.tolist(), strict=True):
            picture[0, i : i + 6, j : j + 6] += 0.7
        return pictures, (corner + 2.5) / 15.5 - 1

    model = nn.Sequential(ImageEncoder((3, 32, 32), channels=(16, 16), keypoints=8), nn.Linear(16, 2))
    optimizer = torch.optim.Adam(model.parameters(), lr=3e-3)
    for _ in range(150):
        pictures, places = draw(32)
        loss = (model(pictures) - places).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    pictures, places = draw(200)
    error = (model(pictures) - places).abs().mean() * 15.5
    assert error.detach() < 1.5  # pixels; guessing the middle is wrong by 6.5


def test_a_batch_is_encoded_and_differentiated_well_under_a_second() -> None:
    encoder = ImageEncoder((3, 84, 84), shift=4)
    pictures = torch.rand(64, 3, 84, 84)
    seconds = []
    for _ in range(4):
        begin = time.process_time()
        encoder(pictures).sum().backward()
        seconds.append(time.process_time() - begin)
    assert min(seconds) < 1.0
