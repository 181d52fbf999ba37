"""PSNR and SSIM against scikit-image, against closed forms, and what they refuse."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from rtgs.evaluate.metrics import absolute_error, psnr, quantized, ssim, ssim_map
from rtgs.train import reference_losses

HALF_WINDOW = 5
PIXEL_ERROR = 3e-4  # of the float32 kernel
MEAN_ERROR = 2e-6


def random_pair(seed: int, height: int = 40, width: int = 33, noise: float = 0.1) -> tuple[torch.Tensor, torch.Tensor]:
    """A smooth target in [0, 1] and a noisy, unclamped render of it."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, 6, 5, generator=generator)
    target = torch.nn.functional.interpolate(coarse, size=(height, width), mode="bilinear")[0].clamp(0, 1)
    return target + noise * torch.randn(3, height, width, generator=generator), target


@given(seed=st.integers(0, 10_000), noise=st.floats(1e-3, 1.0))
@settings(max_examples=20, deadline=None)
def test_psnr_agrees_with_scikit_image(seed: int, noise: float) -> None:
    image, target = random_pair(seed, noise=noise)
    expected = peak_signal_noise_ratio(target.double().numpy(), image.clamp(0, 1).double().numpy(), data_range=1.0)
    assert psnr(image, target) == pytest.approx(expected, abs=1e-9)


@given(seed=st.integers(0, 10_000), noise=st.floats(1e-3, 1.0))
@settings(max_examples=15, deadline=None)
def test_ssim_map_agrees_with_scikit_image_away_from_the_border(seed: int, noise: float) -> None:
    image, target = random_pair(seed, noise=noise)
    _, expected = structural_similarity(
        target.double().permute(1, 2, 0).numpy(),
        image.clamp(0, 1).double().permute(1, 2, 0).numpy(),
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        full=True,
    )
    inside = (slice(HALF_WINDOW, -HALF_WINDOW),) * 2  # the border differs: scikit-image reflects, 3DGS pads with zeros
    expected = expected.mean(2)[inside]
    twin = reference_losses.ssim_map(image.clamp(0, 1).double(), target.double()).mean(0)
    np.testing.assert_allclose(twin[inside].numpy(), expected, atol=1e-10)
    ours = ssim_map(image, target)[inside].numpy()
    np.testing.assert_allclose(ours, expected, atol=PIXEL_ERROR)
    assert ours.mean() == pytest.approx(expected.mean(), abs=MEAN_ERROR)


def test_ssim_pads_with_zeros() -> None:
    """On a zero-padded copy scikit-image's interior is the whole of our map."""
    image, target = random_pair(3)
    padded = [torch.nn.functional.pad(tensor.clamp(0, 1).double(), (20,) * 4) for tensor in (image, target)]
    _, expected = structural_similarity(
        padded[1].numpy(),
        padded[0].numpy(),
        channel_axis=0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        full=True,
    )
    expected = float(expected[:, 20:-20, 20:-20].mean())
    assert ssim(image, target) == pytest.approx(expected, abs=MEAN_ERROR)
    twin = reference_losses.ssim(image.clamp(0, 1).double(), target.double())
    assert float(twin) == pytest.approx(expected, abs=1e-10)


def test_ssim_of_flat_bright_pictures_keeps_its_digits() -> None:
    """Where E[x^2] - E[x]^2 cancels most."""
    target = torch.full((3, 64, 64), 0.98)
    image = (target + 1e-3 * torch.randn(3, 64, 64, generator=torch.Generator().manual_seed(2))).clamp(0, 1)
    twin = reference_losses.ssim(image.double(), target.double())
    assert ssim(image, target) == pytest.approx(float(twin), abs=1e-5)


def test_known_values() -> None:
    target = torch.full((3, 16, 16), 0.5)
    assert psnr(target + 0.1, target) == pytest.approx(20.0, abs=1e-5)
    assert psnr(target, target) == pytest.approx(100.0)
    assert ssim(target, target) == pytest.approx(1.0)


def test_render_is_clamped() -> None:
    target = torch.ones(3, 12, 12)
    assert psnr(torch.full((3, 12, 12), 7.0), target) == pytest.approx(100.0)


def test_mask_restricts_the_average() -> None:
    target = torch.full((3, 20, 20), 0.5)
    image = target.clone()
    image[:, :10] += 0.1  # the upper half is wrong
    upper = torch.zeros(20, 20, dtype=torch.bool)
    upper[:10] = True
    assert psnr(image, target, mask=upper) == pytest.approx(20.0, abs=1e-5)
    assert psnr(image, target, mask=~upper) == pytest.approx(100.0)
    whole = torch.ones_like(upper)
    assert psnr(image, target, mask=whole) == pytest.approx(psnr(image, target))
    assert ssim(image, target, mask=whole) == pytest.approx(ssim(image, target))
    expected = ssim_map(image, target)[:10].mean()
    assert ssim(image, target, mask=upper) == pytest.approx(float(expected))


def test_quantized_is_what_an_8bit_file_holds() -> None:
    values = torch.tensor([-0.3, 0.0, 0.5, 1.0, 1.7, 0.001]).reshape(1, 1, 6).expand(3, 2, 6)
    assert torch.equal(quantized(values) * 255, (values.clamp(0, 1) * 255).round())
    image, target = random_pair(5)
    assert abs(psnr(quantized(image), quantized(target)) - psnr(image, target)) < 0.05


def test_absolute_error_is_the_channel_mean() -> None:
    target = torch.zeros(3, 8, 8)
    image = torch.stack([torch.full((8, 8), value) for value in (0.0, 0.3, 0.6)])
    assert torch.allclose(absolute_error(image, target), torch.full((8, 8), 0.3, dtype=torch.float64), atol=1e-7)


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_what_is_refused(metric) -> None:
    good = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0))
    with pytest.raises(TypeError, match="divide 8-bit values by 255"):
        metric((good * 255).to(torch.uint8), good)
    with pytest.raises(ValueError, match=r"expected \[0, 1\]"):
        metric(good, good * 255)
    with pytest.raises(ValueError, match="differ in size"):
        metric(good, good[:, :8])
    with pytest.raises(ValueError, match=r"expected \(3, H, W\)"):
        metric(good.permute(1, 2, 0), good.permute(1, 2, 0))
    with pytest.raises(ValueError, match="NaN or inf"):
        metric(good * math.nan, good)
    with pytest.raises(ValueError, match="mask is empty"):
        metric(good, good, mask=torch.zeros(16, 16, dtype=torch.bool))
    with pytest.raises(ValueError, match=r"expected torch\.bool"):
        metric(good, good, mask=torch.ones(16, 16))
