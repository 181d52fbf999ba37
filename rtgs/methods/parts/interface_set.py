"""The interface: opaque surfels with materials on the transparent object's mesh (decision 31)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from scipy.spatial import KDTree
from torch import Tensor

from rtgs.gaussians.activate import activate_geometry
from rtgs.gaussians.density import logit
from rtgs.gaussians.harmonics import rest_count
from rtgs.gaussians.initialize import neighbor_distance
from rtgs.gaussians.materials import with_materials
from rtgs.gaussians.surfels import Surfels
from rtgs.mesh.container import ObjectMesh
from rtgs.methods.parts.gaussian_set import GaussianSet
from rtgs.methods.settings import MethodSettings

_NORMALS = "normals"  # in the state


class InterfaceSet(GaussianSet):
    """A set without density control whose opacities stay at or above ``floor``.

    ``normals``: (N, 3) unit, those that the surfels were put on the mesh with.
    """

    floor: float = 0.9
    normals: Tensor

    def put(self, floor: float) -> InterfaceSet:
        """The set as it begins: what it is now is what it is held to."""
        self.floor = floor
        self.normals = self._normals().detach()
        return self

    def turned(self) -> Tensor:
        """() mean of 1 - n . n(as put), of the surfels themselves: what lies around them is not bent with them."""
        return (1 - (self._normals() * self.normals).sum(-1)).mean()

    def _normals(self) -> Tensor:
        active = activate_geometry(self.gaussians)
        return torch.linalg.cross(active.tangent_u, active.tangent_v)

    def state(self) -> dict[str, Tensor]:
        return super().state() | {f"{self.name}.{_NORMALS}": self.normals}

    def load(self, state: Mapping[str, Tensor]) -> None:
        super().load(state)
        key = f"{self.name}.{_NORMALS}"
        if key not in state:
            raise ValueError(
                f"the checkpoint has no {key}: it was written by another version; train again from the start"
            )
        self.normals = state[key].clone()

    @torch.no_grad()
    def _clamp(self) -> None:
        super()._clamp()
        self.gaussians.opacity_logits.clamp_(min=logit(self.floor))


def normal_quaternions(normals: Tensor) -> Tensor:
    """(N, 4) w, x, y, z of rotations whose third column is the unit normal (N, 3); the shortest ones from +z."""
    x, y, z = normals.unbind(1)
    turned = torch.stack((1 + z, -y, x, torch.zeros_like(x)), dim=1)
    half_turn = torch.tensor([0.0, 1.0, 0.0, 0.0]).to(normals)  # -z: any axis in the plane
    return torch.where((z < -1 + 1e-6)[:, None], half_turn, turned)


def interface_surfels(
    settings: MethodSettings, mesh: ObjectMesh, glass: Tensor, colors_of: Surfels, generator: torch.Generator
) -> Surfels:
    """Surfels spread over the faces ``glass`` (F,) bool of the mesh, with its normals, the colour of the nearest of
    ``colors_of``, and materials of their own."""
    own = settings.transmittance.interface
    points, normals = mesh.sample(own.count, generator, glass.numpy())
    _, nearest = KDTree(colors_of.means.detach().double().numpy()).query(points.double().numpy())
    spacing = own.scale * neighbor_distance(points, settings.init.neighbors)
    plain = Surfels(
        means=points,
        log_scales=spacing.log()[:, None].repeat(1, 2),
        quaternions=normal_quaternions(normals),
        opacity_logits=torch.full((len(points),), logit(own.opacity)),
        sh_dc=colors_of.sh_dc.detach()[torch.from_numpy(nearest)].clone(),
        sh_rest=torch.zeros(len(points), rest_count(settings.init.sh_degree), 3),
    )
    materials = replace(settings.materials, specular=own.specular, f0=own.f0, roughness=own.roughness)
    return with_materials(plain, materials)
