"""SH against scipy, orthonormality, known values, gradients."""

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from rtgs.gaussians.harmonics import SH_C0, evaluate_sh, rest_count, rgb_to_sh_dc, sh_basis, sh_dc_to_rgb


def unit_vectors(count: int) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(1)).double())


def scipy_basis(directions: np.ndarray) -> np.ndarray:
    """Real SH from scipy's complex ones, degrees 1..3; scipy's carry the Condon-Shortley phase, as 3DGS's do."""
    polar = np.arccos(directions[:, 2])
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    columns = []
    for degree in (1, 2, 3):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), polar, azimuth)
            part = value.real if order > 0 else value.imag
            columns.append(value.real if order == 0 else np.sqrt(2) * part)
    return np.stack(columns, axis=1)


def test_matches_scipy():
    directions = unit_vectors(200)
    np.testing.assert_allclose(sh_basis(directions, 3).numpy(), scipy_basis(directions.numpy()), atol=1e-13)


def test_orthonormal_on_the_sphere():
    # Gauss-Legendre in z times equal angles: exact for the products of two degree-3 functions.
    z, weight = np.polynomial.legendre.leggauss(8)
    angle = np.arange(16) * 2 * np.pi / 16
    zz, aa = np.meshgrid(z, angle, indexing="ij")
    radius = np.sqrt(1 - zz**2)
    directions = torch.from_numpy(np.stack((radius * np.cos(aa), radius * np.sin(aa), zz), -1).reshape(-1, 3))
    weights = torch.from_numpy(np.repeat(weight, 16) * 2 * np.pi / 16)
    basis = torch.cat((torch.full((len(directions), 1), SH_C0, dtype=torch.float64), sh_basis(directions, 3)), dim=1)
    gram = basis.T @ (weights[:, None] * basis)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=1e-12, rtol=0)


def test_known_values_along_the_axes():
    axes = torch.eye(3, dtype=torch.float64)
    basis = sh_basis(axes, 3)
    assert basis[2, 1] == pytest.approx(np.sqrt(3 / (4 * np.pi)))  # z along +z
    assert basis[0, 2] == pytest.approx(-np.sqrt(3 / (4 * np.pi)))  # -x along +x
    assert basis[1, 0] == pytest.approx(-np.sqrt(3 / (4 * np.pi)))  # -y along +y
    assert basis[2, 5] == pytest.approx(np.sqrt(5 / (4 * np.pi)))  # zonal functions at the pole
    assert basis[2, 11] == pytest.approx(np.sqrt(7 / (4 * np.pi)))


def test_lower_degree_is_a_prefix():
    directions = unit_vectors(10)
    full = sh_basis(directions, 3)
    for degree in range(4):
        assert torch.equal(sh_basis(directions, degree), full[:, : rest_count(degree)])


def test_degree_zero_shows_the_colour():
    rgb = torch.rand(5, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    color = evaluate_sh(rgb_to_sh_dc(rgb), torch.zeros(5, 15, 3, dtype=torch.float64), unit_vectors(5), 0)
    torch.testing.assert_close(color, rgb)
    torch.testing.assert_close(sh_dc_to_rgb(rgb_to_sh_dc(rgb)), rgb)


def test_evaluate_is_the_sum():
    directions = unit_vectors(7)
    dc, rest = torch.randn(7, 3).double(), torch.randn(7, 15, 3).double()
    expected = 0.5 + SH_C0 * dc
    for k, column in enumerate(sh_basis(directions, 2).T):
        expected = expected + column[:, None] * rest[:, k]
    torch.testing.assert_close(evaluate_sh(dc, rest, directions, 2), expected)


def test_gradcheck():
    arguments = (torch.randn(4, 3).double(), torch.randn(4, 15, 3).double(), unit_vectors(4))
    for argument in arguments:
        argument.requires_grad_()
    assert torch.autograd.gradcheck(lambda *a: evaluate_sh(*a, 3), arguments)


def test_too_few_coefficients_say_so():
    with pytest.raises(ValueError, match="holds 3 coefficients a surfel but degree 2 needs 8"):
        evaluate_sh(torch.zeros(1, 3), torch.zeros(1, 3, 3), torch.zeros(1, 3), 2)
    with pytest.raises(ValueError, match="SH degree 4"):
        rest_count(4)
