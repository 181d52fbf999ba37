"""The interface: how it is turned, what holds its normals and its opacities."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from glass_cases import INTERFACE, GlassScene, begun, glass_recipe, glass_scene, held, new_glass_method, train_stages

from benchmarks.common.mirror_scene import BALL
from rtgs.gaussians.density import select_rows
from rtgs.methods.parts.interface_set import interface_surfels, normal_quaternions
from rtgs.train.method import Mode


@pytest.fixture(scope="module")
def made() -> GlassScene:
    return glass_scene()


def test_quaternions_turn_the_third_axis_to_the_normal():
    normals = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    normals = torch.cat((normals, torch.tensor([[0, 0, 1.0], [0, 0, -1.0]])))
    w, x, y, z = torch.nn.functional.normalize(normal_quaternions(normals), dim=1).unbind(1)
    third = torch.stack((2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)), dim=1)
    torch.testing.assert_close(third, normals, atol=1e-5, rtol=0)


def test_the_interface_is_held_to_the_normals_it_was_put_with(made: GlassScene):
    """Closed form: a surfel turned by an angle about one of its own axes costs 1 - cos of it, and is pulled back."""
    method = begun(held(3.0), made)
    interface = method.find("interface")
    assert interface is not None
    centre = torch.tensor([0.0, 0.0, -0.2])
    outwards = torch.nn.functional.normalize(interface.gaussians.means.detach() - centre, dim=1)
    assert float((interface.normals * outwards).sum(1).min()) > 0.95
    assert float(interface.turned().detach()) == pytest.approx(0, abs=1e-6)
    half, rows = torch.tensor(0.2), 15
    with torch.no_grad():  # q times a turn by 0.4 about the first tangent
        w, x, y, z = interface.gaussians.quaternions[:rows].clone().unbind(1)
        c, s = half.cos(), half.sin()
        interface.gaussians.quaternions[:rows] = torch.stack(
            (w * c - x * s, x * c + w * s, y * c + z * s, z * c - y * s), 1
        )
    turned = interface.turned()
    assert float(turned.detach()) == pytest.approx(float(1 - (2 * half).cos()) * rows / 150, rel=1e-4)
    turned.backward()
    gradient = interface.gaussians.quaternions.grad
    assert gradient is not None
    assert bool((gradient[:rows].norm(dim=1) > 1e-4).all())
    assert float(gradient[rows:].abs().max()) < 1e-6
    with torch.no_grad():
        interface.gaussians.quaternions -= gradient
        assert float(interface.turned()) < float(turned.detach())
        interface.gaussians.quaternions[0] = 0  # the identity, and no direction to go back in
    interface.gaussians.quaternions.grad = None
    interface.turned().backward()
    assert bool(torch.isfinite(interface.gaussians.quaternions.grad).all())


def test_the_floor_of_the_interface_is_the_settings_own(made: GlassScene):
    """Also of a set that goes on from a checkpoint."""
    recipe = glass_recipe(interface=replace(INTERFACE, floor=0.6))
    method = begun(recipe, made)
    resumed = new_glass_method(recipe, made)
    resumed.load({name: tensor.clone() for name, tensor in method.state().items()})
    for interface in (method.find("interface"), resumed.find("interface")):
        assert interface is not None
        interface.gaussians.opacity_logits.detach().fill_(-5.0)
        interface.step(31, 0)
        assert float(interface.gaussians.opacity_logits.detach().sigmoid().max()) == pytest.approx(0.6)


def test_what_holds_the_normals_is_counted_where_it_has_a_weight(made: GlassScene):
    view = made.scene.train[0]
    found = {}
    for name, recipe in {"hold": held(3.0), "raster": held(0.0, 0.2), "none": held(0.0)}.items():
        method = begun(recipe, made)
        terms = method.losses(method.render(view.camera, 35, Mode.TRAIN, mask=view.mask), view, 35).terms
        found[name] = {term.name: term.weight for term in terms if term.name.startswith("interface")}
    assert found == {"hold": {"interface_hold": 3.0}, "raster": {"interface_normal": 0.2}, "none": {}}
    method = begun(glass_recipe(interface=replace(held(3.0, 0.2).transmittance.interface, normal_loss_until=0.6)), made)
    for step, names in ((35, ["interface_hold", "interface_normal"]), (36, [])):
        terms = method.losses(method.render(view.camera, step, Mode.TRAIN, mask=view.mask), view, step).terms
        assert [term.name for term in terms if term.name.startswith("interface")] == names


def test_held_normals_stay_nearer_to_the_mesh(made: GlassScene):
    turned = []
    for weight in (0.0, 20.0):
        method = new_glass_method(held(weight), made)
        train_stages(method, made.scene)
        assert method.find("interface") is not None
        turned.append(float(method.find("interface").turned().detach()))
    assert turned[1] < 0.5 * turned[0]


def test_the_interface_begins_with_the_colours_of_what_is_next_to_it(made: GlassScene):
    """Of two base surfels on either side of the ball, each gives its own half its colour."""
    method = new_glass_method(glass_recipe(), made)
    base = select_rows(method["base"].gaussians, torch.tensor([0, 1]))
    with torch.no_grad():
        base.means.copy_(BALL + torch.tensor([[2.0, 0, 0], [-2.0, 0, 0]]))
        base.sh_dc.copy_(torch.tensor([[1.0, 0, 0], [0, 0, 1.0]]))
    glass = torch.ones(len(made.mesh.mesh.faces), dtype=torch.bool)
    generator = torch.Generator().manual_seed(0)
    surfels = interface_surfels(method.settings, made.mesh, glass, base, generator)  # type: ignore[arg-type]
    right = surfels.means[:, 0] > BALL[0]
    assert 0.3 < float(right.float().mean()) < 0.7
    assert torch.equal(surfels.sh_dc[:, 0] == 1, right)
    assert torch.equal(surfels.sh_dc[:, 2] == 1, ~right)
