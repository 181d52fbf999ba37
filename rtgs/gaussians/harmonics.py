"""Real spherical harmonics to degree 3, in the sign convention of 3DGS: the view-dependent colour of a surfel.

Coefficient order is degree by degree, order -l .. l inside a degree. The functions are orthonormal on the unit sphere;
the convention carries the Condon-Shortley phase (odd orders are negative), as in 3DGS and its PLY files.
"""

from __future__ import annotations

import torch
from torch import Tensor

MAX_DEGREE = 3
SH_C0 = 0.28209479177387814
SH_C1 = 0.4886025119029199
SH_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
SH_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


def rest_count(degree: int) -> int:
    """Coefficients above degree 0: 0, 3, 8 or 15.

    Raises:
        ValueError: the degree is not in 0..3.
    """
    if degree not in range(MAX_DEGREE + 1):
        raise ValueError(f"SH degree {degree} is not supported; choose 0, 1, 2 or 3")
    return (degree + 1) ** 2 - 1


def rgb_to_sh_dc(rgb: Tensor) -> Tensor:
    """(N, 3) colours in 0..1 to the degree-0 coefficients that show them (method.md 2)."""
    return (rgb - 0.5) / SH_C0


def sh_dc_to_rgb(sh_dc: Tensor) -> Tensor:
    """The inverse of :func:`rgb_to_sh_dc`, not clamped."""
    return 0.5 + SH_C0 * sh_dc


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Basis functions 1 .. K of degrees 1 .. ``degree`` (degree 0 is the constant ``SH_C0``).

    Args:
        directions: (N, 3) unit vectors, any floating dtype.

    Returns:
        (N, K), K = (degree + 1)^2 - 1.
    """
    count = rest_count(degree)
    if degree == 0:
        return directions.new_zeros(len(directions), count)
    x, y, z = directions.unbind(-1)
    basis = [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis += [
            SH_C2[0] * x * y,
            SH_C2[1] * y * z,
            SH_C2[2] * (2 * zz - xx - yy),
            SH_C2[3] * x * z,
            SH_C2[4] * (xx - yy),
        ]
        if degree >= 3:
            basis += [
                SH_C3[0] * y * (3 * xx - yy),
                SH_C3[1] * x * y * z,
                SH_C3[2] * y * (4 * zz - xx - yy),
                SH_C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
                SH_C3[4] * x * (4 * zz - xx - yy),
                SH_C3[5] * z * (xx - yy),
                SH_C3[6] * x * (xx - 3 * yy),
            ]
    return torch.stack(basis, dim=-1)


def evaluate_sh(sh_dc: Tensor, sh_rest: Tensor, directions: Tensor, degree: int) -> Tensor:
    """Colour 0.5 + sum of coefficients times basis, not clamped.

    Args:
        sh_dc: (N, 3) degree-0 coefficients.
        sh_rest: (N, K, 3) coefficients above degree 0; those above ``degree`` are left out.
        directions: (N, 3) unit vectors from the camera to the surfel, world frame.
        degree: 0..3.

    Returns:
        (N, 3), same dtype.

    Raises:
        ValueError: ``sh_rest`` holds fewer coefficients than ``degree`` needs.
    """
    count = rest_count(degree)
    if sh_rest.shape[1] < count:
        raise ValueError(
            f"sh_rest holds {sh_rest.shape[1]} coefficients a surfel but degree {degree} needs {count}; "
            "evaluate a lower degree or allocate the surfels with a higher one"
        )
    color = sh_dc_to_rgb(sh_dc)
    if degree == 0:
        return color
    return color + (sh_basis(directions, degree)[..., None] * sh_rest[:, :count]).sum(dim=1)
