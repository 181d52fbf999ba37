"""What a sensor cuts off: the native kernel against plain torch."""

from __future__ import annotations

import pytest
import torch

from rtgs.native import core
from rtgs.train.terms import as_the_sensor, as_the_sensor_twin


def test_the_kernel_cuts_as_plain_torch_does_to_the_bit():
    generator = torch.Generator().manual_seed(4)
    photo = torch.randint(253, 256, (3, 97, 101), generator=generator) / 255
    image = 2 * torch.rand(3, 97, 101, generator=generator)
    image[0, 0, :3], photo[0, 0, :3] = torch.tensor([torch.nan, 1.0, torch.inf]), 1.0
    upstream = torch.randn(3, 97, 101, generator=generator)
    leaves = [image.clone().requires_grad_() for _ in range(2)]
    found, plain = as_the_sensor(leaves[0], photo), as_the_sensor_twin(leaves[1], photo)
    assert torch.equal(found.nan_to_num(7), plain.nan_to_num(7))
    assert int((plain != image).sum()) > 1000
    for each in (found, plain):
        each.backward(upstream)
    assert torch.equal(*(each.grad for each in leaves))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="sensor: photo holds 3 numbers, expected 4"):
        core.cut_light(*(torch.zeros(count).numpy() for count in (4, 3)), 1.0, torch.zeros(4).numpy(), 1)
