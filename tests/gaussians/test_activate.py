"""The native activation against its float64 twin, its rules at degenerate input, determinism."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from surfel_cases import random_surfels

from rtgs.gaussians.activate import activate_gaussians
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.surfels import ActivatedGaussians, Surfels, activate
from rtgs.native import core

CENTER = torch.tensor([0.1, -0.2, 0.3])
OUTPUTS = ("tangent_u", "tangent_v", "scales", "opacities", "colors")


def outputs_of(activated: ActivatedGaussians) -> list[torch.Tensor]:
    return [getattr(activated, name) for name in OUTPUTS]


def in_double(surfels: Surfels) -> Surfels:
    return type(surfels)(**{name: values.detach().double() for name, values in surfels.items()}).requires_grad_()


def upstream_for(outputs: list[torch.Tensor], seed: int = 1) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(values.shape, generator=generator) for values in outputs]


def gradients(surfels: Surfels, outputs: list[torch.Tensor], upstream: list[torch.Tensor]) -> list[torch.Tensor]:
    parameters = [values for _, values in surfels.items()]
    upstream = [values.to(outputs[0].dtype) for values in upstream]
    found = torch.autograd.grad(outputs, parameters, upstream, allow_unused=True)
    return [torch.zeros_like(p) if g is None else g for p, g in zip(parameters, found)]


def compare(surfels: Surfels, degree: int, tolerance: float = 1e-5) -> None:
    twin_surfels = in_double(surfels)
    native = outputs_of(activate_gaussians(surfels, CENTER, degree))
    twin = outputs_of(activate(twin_surfels, CENTER, degree))
    for name, a, b in zip(OUTPUTS, native, twin):
        error = (a.double() - b).abs()
        if name == "scales":
            error = error / b
        assert float(error.detach().max()) < tolerance, name
    upstream = upstream_for(native)
    found = gradients(surfels, native, upstream)
    expected = gradients(twin_surfels, twin, upstream)
    # Gradients cancel inside a row (projection on the unit sphere): compare with the largest of the parameter.
    for (name, _), a, b in zip(surfels.items(), found, expected):
        scale = float(b.abs().max()) if b.numel() else 0.0
        error = float((a.double() - b).abs().max()) if b.numel() else 0.0
        assert error <= tolerance * scale + 1e-30, f"gradient of {name}: {error} of {scale}"


@pytest.mark.parametrize(
    ("coefficients", "degree"), [(15, 3), (15, 2), (15, 1), (15, 0), (8, 2), (8, 1), (3, 1), (0, 0)]
)
@pytest.mark.parametrize("kind", [Surfels, Ellipsoids])
def test_matches_twin(isa, kind, coefficients, degree):
    compare(random_surfels(101, coefficients, kind=kind), degree)


@pytest.mark.parametrize("count", [0, 1, 2, 15, 16, 17, 33])
def test_any_count(isa, count):
    surfels = random_surfels(count)
    if count:
        compare(surfels, 3)
    else:
        activated = activate_gaussians(surfels, CENTER, 3)
        (activated.colors.sum() + activated.scales.sum()).backward()
        assert activated.tangent_u.shape == (0, 3)
        assert surfels.quaternions.grad.shape == (0, 4)


def spoil(surfels: Surfels, row: int, what: str) -> None:
    """Make one surfel degenerate."""
    if what == "quaternion":
        surfels.quaternions[row] = 0
    elif what == "centre":
        surfels.means[row] = CENTER
    elif what == "near":
        surfels.means[row] = CENTER + 1e-3 * surfels.means[row]
    elif what == "logit":
        surfels.opacity_logits[row] = -80.0 if row % 2 else 80.0
    elif what == "scale":
        surfels.log_scales[row] = torch.tensor([39.0, -60.0, 41.0])[: surfels.log_scales.shape[1]]
    elif what == "black":
        surfels.sh_dc[row] = -5.0


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(1, 40),
    degree=st.integers(0, 3),
    length=st.floats(-4, 4),
    spread=st.floats(0.1, 8),
    degenerate=st.lists(st.sampled_from(["quaternion", "centre", "near", "logit", "scale", "black"]), max_size=4),
    isa=st.sampled_from(core.available_isas()),
    kind=st.sampled_from([Surfels, Ellipsoids]),
)
def test_matches_twin_drawn(seed, count, degree, length, spread, degenerate, isa, kind):
    before = core.isa()
    core.select_isa(isa)
    try:
        surfels = random_surfels(count, seed=seed, kind=kind)
        with torch.no_grad():
            surfels.quaternions *= 10**length
            surfels.log_scales *= spread
            surfels.opacity_logits *= spread
            for row, what in enumerate(degenerate[:count]):
                spoil(surfels, row, what)
        # The length of a short quaternion, or of a mean near the camera, multiplies its own gradient only.
        compare(surfels, degree, tolerance=3e-5)
    finally:
        core.select_isa(before)


def test_sh_degree_above_the_stored_one_is_capped():
    surfels = random_surfels(5, coefficients=3)
    assert torch.equal(activate_gaussians(surfels, CENTER, 3).colors, activate_gaussians(surfels, CENTER, 1).colors)


def test_zero_quaternion_is_the_identity_without_gradient(isa):
    surfels = random_surfels(3)
    with torch.no_grad():
        surfels.quaternions[1] = 0
    for function, data in ((activate_gaussians, surfels), (activate, in_double(surfels))):
        outputs = outputs_of(function(data, CENTER, 3))
        assert outputs[0][1].tolist() == [1, 0, 0]
        assert outputs[1][1].tolist() == [0, 1, 0]
        found = gradients(data, outputs, upstream_for(outputs))[2]
        assert torch.isfinite(found).all()
        assert (found[1] == 0).all()
        assert (found[0] != 0).any()
    compare(surfels, 3)


def test_mean_at_the_camera_centre_has_the_colour_of_degree_zero(isa):
    surfels = random_surfels(20)
    with torch.no_grad():
        surfels.means[4] = CENTER
    compare(surfels, 3)
    outputs = activate_gaussians(surfels, CENTER, 3)
    expected = (0.5 + 0.28209479 * surfels.sh_dc[4]).clamp_min(0)
    torch.testing.assert_close(outputs.colors[4], expected)
    outputs.colors.sum().backward()
    assert (surfels.means.grad[4] == 0).all()


def test_extreme_values_stay_finite(isa):
    surfels = random_surfels(64)
    with torch.no_grad():
        for row, value in enumerate((1e38, -1e38, 3e38, 1e20, -1e20, 1e4, 100.0, -100.0, 90.0, -90.0, 1e-38, 1e-45)):
            for _, values in surfels.items():
                values[row] = 1e30 if values is surfels.sh_rest and value > 1e30 else value
            surfels.sh_rest[row] = max(min(value, 1e30), -1e30)
            surfels.sh_dc[row] = max(min(value, 1e30), -1e30)
    activated = activate_gaussians(surfels, CENTER, 3)
    outputs = outputs_of(activated)
    for name, values in zip(OUTPUTS, outputs):
        assert torch.isfinite(values).all(), name
    assert (activated.scales > 0).all()
    assert ((activated.opacities >= 0) & (activated.opacities <= 1)).all()
    for (name, _), values in zip(surfels.items(), gradients(surfels, outputs, [torch.ones_like(o) for o in outputs])):
        assert torch.isfinite(values).all(), name


def test_log_scales_beyond_the_limit_saturate(isa):
    surfels = random_surfels(4)
    with torch.no_grad():
        surfels.log_scales[0] = torch.tensor([41.0, -500.0])
    compare(surfels, 0)
    activate_gaussians(surfels, CENTER, 0).scales.sum().backward()
    assert (surfels.log_scales.grad[0] == 0).all()
    assert (surfels.log_scales.grad[1:] > 0).all()


def test_clamped_colours_pass_no_gradient(isa):
    surfels = random_surfels(3, coefficients=0)
    with torch.no_grad():
        surfels.sh_dc[:] = torch.tensor([[-10.0, 1.0, 0.0], [2.0, -3.0, -1.7], [0.0, 0.0, 0.0]])
    activated = activate_gaussians(surfels, CENTER, 0)
    activated.colors.sum().backward()
    shown = surfels.sh_dc.detach() * 0.28209479 + 0.5 > 0
    assert torch.equal(surfels.sh_dc.grad != 0, shown)
    assert torch.equal(activated.colors > 0, shown)


def test_same_bits_for_any_thread_count(isa):
    surfels = random_surfels(9003)  # fewer are not worth a thread
    results = []
    before = torch.get_num_threads()
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        outputs = outputs_of(activate_gaussians(surfels, CENTER, 3))
        results.append([*outputs, *gradients(surfels, outputs, upstream_for(outputs))])
    torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


def test_only_some_outputs_used():
    surfels = random_surfels(10)
    activate_gaussians(surfels, CENTER, 3).opacities.sum().backward()
    assert (surfels.opacity_logits.grad > 0).all()
    assert (surfels.sh_rest.grad == 0).all()
    assert (surfels.quaternions.grad == 0).all()


def test_without_gradient_keeps_no_graph():
    with torch.no_grad():
        assert not activate_gaussians(random_surfels(10), CENTER, 3).colors.requires_grad


def test_twin_gradcheck():
    surfels = random_surfels(4, dtype=torch.float64).requires_grad_(False)
    surfels.sh_dc[:] = 3.0  # no channel at the clamp
    names = [name for name, _ in surfels.items()]
    values = tuple(values.requires_grad_() for _, values in surfels.items())

    def function(*raw):
        return tuple(outputs_of(activate(Surfels(**dict(zip(names, raw))), CENTER, 3)))

    assert torch.autograd.gradcheck(function, values)


def test_tangents_are_orthonormal(isa):
    activated = activate_gaussians(random_surfels(50), CENTER, 3)
    u, v = activated.tangent_u, activated.tangent_v
    one, zero = torch.ones(50), torch.zeros(50)
    torch.testing.assert_close((u * u).sum(-1), one)
    torch.testing.assert_close((v * v).sum(-1), one)
    spacing = torch.finfo(torch.float32).eps  # each product and sum rounds by half of it, and so do both vectors
    torch.testing.assert_close((u * v).sum(-1), zero, atol=4 * spacing, rtol=0)


def test_other_dtypes_are_refused():
    with pytest.raises(TypeError, match=r"gaussians.means is torch.float64"):
        activate_gaussians(random_surfels(2, dtype=torch.float64), CENTER, 3)


def test_non_contiguous_parameters_and_gradients():
    surfels = random_surfels(9)
    strided = Surfels(**{n: v.detach().clone() for n, v in surfels.items()})
    strided.means = strided.means.T.contiguous().T
    strided.requires_grad_()
    a, b = (outputs_of(activate_gaussians(s, CENTER, 3)) for s in (surfels, strided))
    upstream = upstream_for(a)
    upstream[0] = upstream[0].T.contiguous().T
    for x, y in zip(gradients(surfels, a, upstream), gradients(strided, b, upstream)):
        assert torch.equal(x, y)
