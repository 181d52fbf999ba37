"""What the paper's rows of the third stage leave out, on a ball of glass: the guide, bounds of weights, silhouettes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from glass_cases import GlassScene, begun, glass_recipe, glass_scene
from reflective_cases import use

from rtgs.config import compose
from rtgs.mesh.container import ObjectMesh
from rtgs.mesh.triangles import TriangleMesh
from rtgs.methods import Mode, RenderOptions
from rtgs.methods.reads import as_lit
from rtgs.methods.settings import MethodSettings, TransmittanceSettings
from rtgs.methods.shading.mirror import SurfacePixels
from rtgs.methods.shading.straight import glass_weights
from rtgs.optics.settings import OpticsSettings

STEP = 40


@pytest.fixture(scope="module")
def made() -> GlassScene:
    return glass_scene()


def unguided() -> MethodSettings:
    """The small recipe with the keys of ablation=no_mesh_guide."""
    flipped = compose(["scene=ball_statue", "method=rtgs", "preset=smoke", "ablation=no_mesh_guide"])[0].method
    names = ("second_bounce", "second_offset", "first_surface", "normal", "split", "box", "opaque_share", "test_masks")
    chosen = {name: getattr(flipped.transmittance, name) for name in (*names, "max_gain")}
    base = glass_recipe(**chosen)
    transmittance = replace(
        base.transmittance, interface=replace(base.transmittance.interface, count=0), wall=flipped.transmittance.wall
    )
    loss = replace(base.loss, transmission_depth=flipped.loss.transmission_depth, transmission_depth_start=0.5)
    return replace(base, transmittance=transmittance, loss=loss)


def guided() -> MethodSettings:
    base = unguided()
    return replace(base, transmittance=replace(base.transmittance, second_bounce="mesh"))


def smaller(mesh: ObjectMesh) -> ObjectMesh:
    """Half as large around its middle, of coarser voxels."""
    middle = mesh.bounds.mean(0)
    shrunk = TriangleMesh(middle + 0.5 * (mesh.mesh.vertices - middle), mesh.mesh.faces)
    return replace(mesh, mesh=shrunk, voxel=3 * mesh.voxel)


def trained_on(settings: MethodSettings, made: GlassScene) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """The image and the loss terms of one training view, and the test view's image."""
    method = begun(settings, made)
    view, test = made.scene.train[1], made.scene.test[0]
    rendered = method.render(view.camera, STEP, Mode.TRAIN, RenderOptions(), view.mask)
    terms = {term.name: term.value for term in method.losses(rendered, view, STEP).terms}
    with torch.no_grad():
        judged = method.render(test.camera, STEP, Mode.EVALUATE, RenderOptions(), test.mask).image
    return torch.stack((rendered.image.detach(), judged)), terms


def test_without_the_guide_training_and_pictures_do_not_depend_on_the_mesh(made: GlassScene):
    other = replace(made, mesh=smaller(made.mesh))
    (image, terms), (same, same_terms) = (trained_on(unguided(), each) for each in (made, other))
    assert torch.equal(image, same)
    assert terms == same_terms
    assert "specular" in terms
    assert "transmission_depth" not in terms
    (image, _), (changed, _) = (trained_on(guided(), each) for each in (made, other))
    assert not torch.equal(image, changed)


def weights_of(roughness: torch.Tensor, bound: str) -> torch.Tensor:
    pixels = SurfacePixels(
        *(torch.zeros(3, 5), torch.ones(5), roughness), torch.full((5,), 0.2), *(torch.zeros(5),) * 2
    )
    cosine, inside = torch.full((5,), 0.4), torch.ones(5, dtype=torch.bool)
    return glass_weights(torch.zeros(5), cosine, pixels, inside, OpticsSettings(max_gain=16.0), 1.0, bound)[0]


def test_a_smooth_bound_teaches_the_roughness_where_a_clamp_does_not():
    start = torch.tensor([0.001, 0.003, 0.005, 0.02, 0.3])
    gradients, values = {}, {}
    for bound in ("clamp", "smooth"):
        leaf = start.clone().requires_grad_()
        found = weights_of(leaf, bound)
        found.sum().backward()
        assert leaf.grad is not None
        gradients[bound], values[bound] = leaf.grad, found.detach()
    assert bool((gradients["clamp"][:3] == 0).all())
    assert bool((gradients["smooth"] < 0).all())  # rougher is darker
    assert bool((values["smooth"] <= 1).all())
    assert bool((values["smooth"][:-1] > values["smooth"][1:]).all())
    torch.testing.assert_close(values["smooth"][-1], values["clamp"][-1], rtol=1e-3, atol=0)


def test_the_bound_is_in_a_recipe_only_where_weights_are_learned_and_bounded():
    plain = MethodSettings(name="rtgs")
    assert as_lit(plain).transmittance.weight_bound == "smooth"
    bare = replace(plain, transmittance=TransmittanceSettings(max_weight=0.0))
    assert as_lit(bare).transmittance.weight_bound == "clamp"
    for words in (["method=rtgs"], ["method=rtgs_printed"]):
        settings = compose(["scene=ball_statue", "preset=quick", *words])[0].method
        assert as_lit(settings).transmittance.weight_bound == "clamp"


def test_what_bounds_learned_weights_is_in_no_recipe_where_none_are():
    bounds = ["method.transmittance.max_gain=2.0", "method.transmittance.max_weight=0.5"]
    for light, read in (("fresnel", False), ("learned", True)):
        words = ["scene=ball_statue", "method=rtgs", f"method.transmittance.wall.light={light}"]
        plain, bounded = (as_lit(compose([*words, *more])[0].method) for more in ([], bounds))
        assert (plain != bounded) == read


def test_masks_as_trained_show_through_where_the_mesh_is_missed(made: GlassScene):
    """``given`` leaves a masked pixel dark whose ray misses the mesh; the paper knows no such rule."""
    other = replace(made, mesh=smaller(made.mesh))
    settings = guided()
    method, view = begun(settings, other), made.scene.test[0]
    assert view.mask is not None
    found = {}
    for way in ("given", "as_trained"):
        use(method, replace(settings, transmittance=replace(settings.transmittance, test_masks=way)))
        with torch.no_grad():
            maps = method.render(view.camera, STEP, Mode.EVALUATE, RenderOptions(layers=True), view.mask).maps
        assert maps["transparent"] is not None
        found[way] = maps["transparent"]
    assert torch.equal(found["as_trained"], view.mask)
    assert int(found["given"].sum()) < int(view.mask.sum())
