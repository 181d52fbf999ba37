"""The two lights in which colours may be mixed."""

import numpy as np
import torch

from rtgs.methods.shading.mirror import SurfacePixels, specular_change
from rtgs.optics.light import decoded, encoded
from rtgs.scenes.truth import srgb_from_linear


def test_the_curve_is_that_of_the_path_tracer_and_goes_round():
    light = torch.linspace(0, 1, 1001, dtype=torch.float64)
    np.testing.assert_allclose(encoded(light, "linear").numpy(), srgb_from_linear(light.numpy()), atol=1e-6)
    color = torch.linspace(-0.2, 3, 1001, dtype=torch.float64)
    torch.testing.assert_close(encoded(decoded(color, "linear"), "linear"), color, atol=1e-6, rtol=0)
    assert decoded(color, "srgb") is color
    assert encoded(color, "srgb") is color


def test_gradients_are_finite_and_right_at_black_and_beyond_white():
    color = torch.tensor([0.0, 1e-3, 0.03, 0.06, 0.5, 1.7], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda c: decoded(c, "linear"), color)
    assert torch.autograd.gradcheck(lambda c: encoded(c, "linear"), color)


def test_a_half_mirror_of_white_over_black_is_half_the_light():
    pixels = SurfacePixels(
        torch.zeros(3, 1), torch.tensor([0.5]), torch.zeros(1), torch.zeros(1), torch.zeros(3, 1), torch.ones(1)
    )
    white = torch.ones(3, 1)
    assert float(specular_change(pixels, white, None)[0]) == 0.5
    assert abs(float(specular_change(pixels, white, None, "linear")[0]) - 0.735357) < 1e-5, "sRGB of half the light"
