"""The two lights in which colours may be mixed."""

import numpy as np
import pytest
import torch

from rtgs.methods.shading.mirror import specular_change
from rtgs.native import core
from rtgs.optics.light import CLIPPED_FROM, beyond_the_sensor, decoded, decoded_twin, encoded, encoded_twin
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


def test_what_a_photo_cut_off_gets_the_light_that_is_asked_for_and_nothing_else_does():
    color = torch.tensor([0.0, 0.5, CLIPPED_FROM, 0.985, 1.0, 1.2, 1.6], dtype=torch.float64, requires_grad=True)
    found = beyond_the_sensor(color, 2.0)
    torch.testing.assert_close(found[:3], color[:3])
    light = decoded(found.detach(), "linear")
    assert 1.0 < float(light[3]) < 2.0
    assert float(light[4]) == pytest.approx(2.0)
    assert float(light[5]) == pytest.approx(2.0)
    assert float(found[6].detach()) == 1.6, "it is brighter already"
    assert bool((beyond_the_sensor(torch.linspace(0.9, 1.5, 500), 2.0).diff() >= 0).all())
    found.sum().backward()
    assert color.grad is not None
    rising = float((found[3] / color[3]).detach())
    torch.testing.assert_close(color.grad[[0, 1, 3, 6]], torch.tensor([1, 1, rising, 1], dtype=torch.float64))
    assert torch.equal(beyond_the_sensor(color, 1.0), color)


def test_a_half_mirror_of_white_over_black_is_half_the_light():
    surface = torch.zeros(3, 1), torch.tensor([0.5])
    white = torch.ones(3, 1)
    assert float(specular_change(*surface, white, None)[0]) == 0.5
    assert abs(float(specular_change(*surface, white, None, "linear")[0]) - 0.735357) < 1e-5, "sRGB of half the light"


def test_added_light_takes_nothing_from_the_surface_s_own():
    surface = torch.full((3, 1), 0.5), torch.tensor([0.25])
    light = torch.full((3, 1), 0.8)
    assert float(specular_change(*surface, light, None, additive=True)[0]) == pytest.approx(0.25 * 0.8)
    assert float(specular_change(*surface, light, None)[0]) == pytest.approx(0.25 * (0.8 - 0.5))
    own = float(decoded_twin(torch.tensor(0.5)))
    sum_of_both = float(encoded_twin(torch.tensor(own + 0.25 * 0.8)))
    assert float(specular_change(*surface, light, None, "linear", additive=True)[0]) == pytest.approx(sum_of_both - 0.5)


@pytest.mark.parametrize("blend", ["srgb", "linear"])
@pytest.mark.parametrize("additive", [False, True])
def test_gradients_of_the_mixture_are_those_of_finite_differences(blend: str, additive: bool):
    generator = torch.Generator().manual_seed(6)
    diffuse, light = (0.1 + 0.8 * torch.rand(3, 4, generator=generator, dtype=torch.float64) for _ in range(2))
    specular = 0.1 + 0.8 * torch.rand(4, generator=generator, dtype=torch.float64)

    def change(diffuse: torch.Tensor, specular: torch.Tensor, light: torch.Tensor) -> torch.Tensor:
        return specular_change(diffuse, specular, light, None, blend, additive=additive) + 0 * diffuse

    given = [each.requires_grad_() for each in (diffuse, specular, light)]
    assert torch.autograd.gradcheck(change, given, eps=1e-7, atol=1e-6)


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize(("native", "twin"), [(decoded, decoded_twin), (encoded, encoded_twin)])
@pytest.mark.parametrize("count", [0, 1, 15, 16, 33, 20_001])
def test_native_curves_and_their_gradients_are_those_of_the_twins(native, twin, count: int):
    given = torch.cat((torch.linspace(-0.2, 3, count), torch.tensor([0.0404, 0.0405, 0.00313, 0.00314, 50.0])))
    found, exact = given.clone().requires_grad_(), given.double().requires_grad_()
    values, expected = native(found, "linear"), twin(exact)
    upstream = torch.randn(len(given), generator=torch.Generator().manual_seed(1))
    values.backward(upstream)
    expected.backward(upstream.double())
    torch.testing.assert_close(values.double(), expected, rtol=2e-6, atol=1e-7)
    assert found.grad is not None
    torch.testing.assert_close(found.grad.double(), exact.grad, rtol=2e-6, atol=1e-7)


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("curve", [decoded, encoded])
def test_not_a_number_is_handed_on_and_nothing_else_becomes_one(curve):
    given = torch.tensor([float("nan"), float("inf"), -float("inf"), 3e38, -3e38, 1e-42, 0.0, -0.0])
    found = curve(given, "linear")
    assert found[0].isnan()
    assert not found[1:].isnan().any()
    assert float(found[1]) > 1e8


@pytest.mark.parametrize("curve", [decoded, encoded])
def test_threads_change_no_bit(isa, curve):
    given = 2 * torch.rand(3, 40_001, generator=torch.Generator().manual_seed(0))
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            leaf = given.clone().requires_grad_()
            result = curve(leaf, "linear")
            result.sum().backward()
            found.append((result.detach(), leaf.grad))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(one, other) for each in found[1:] for one, other in zip(found[0], each, strict=True))


@pytest.mark.parametrize("curve", [decoded, encoded])
def test_any_shape_and_stride_will_do(curve):
    whole = torch.rand(6, 5, generator=torch.Generator().manual_seed(0))
    expected = curve(whole, "linear")
    assert torch.equal(curve(whole.T, "linear"), expected.T)
    assert torch.equal(curve(whole[::2, 1], "linear"), expected[::2, 1])
    assert curve(whole[:0], "linear").shape == (0, 5)
    single = whole[0, 0].clone().requires_grad_()
    curve(single.expand(7), "linear").sum().backward()
    alone = whole[0, 0].clone().requires_grad_()
    curve(alone, "linear").backward()
    torch.testing.assert_close(single.grad, 7 * alone.grad)


def test_other_sizes_are_refused():
    with pytest.raises(ValueError, match="as many numbers must come out as go in"):
        core.srgb_decode(torch.zeros(3).numpy(), torch.zeros(4).numpy(), 1)
