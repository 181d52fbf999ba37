"""Each rule of docs/rasterizer.md in a hand-made scene: the native rasteriser against the twin.

That the twin follows the rule is tested in test_reference.py with closed forms; here the two must agree on it.
"""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgs.core.cameras import Camera
from rtgs.render.buffers import RasterOptions
from rtgs.render.reference.surfels import rasterize_surfels as twin
from rtgs.render.surfels import rasterize_surfels

from .comparison import pixel_error, relative_error
from .scenes import ALL_OUTPUTS, OUTPUTS, identity_camera, join, output, surfel
from .strategies import NAMES, Recipe, SurfelScene, SurfelTensors, wild
from .twin_runs import answer, expected, run

OPTIONAL = ("depth", "median_depth", "normal", "distortion", "weight_sum")
OFF = (0.013, -0.021)  # world offset that keeps hand-made surfels off exact pixel centres


def edge_on(x: float) -> SurfelTensors:
    return surfel((x, 0.03, 2.0), tangent_u=(1, 0, 0), tangent_v=(0, 0.03, 2.0))


def tilted(angle: float, **shape) -> SurfelTensors:
    return surfel((0.1, 0.15, 0.9), tangent_v=(0, math.cos(angle), math.sin(angle)), scales=(1.5, 3.0), **shape)


def stacked(opacity: float, count: int) -> SurfelTensors:
    return join(*(surfel((*OFF, 1.0 + i), opacity=opacity, features=(float(i),), scales=(3, 3)) for i in range(count)))


VISIBLE = surfel((0.05, 0.04, 3.0), opacity=0.5, features=(-2.0,))
RULES: dict[str, SurfelTensors] = {
    "fronto-parallel": surfel((*OFF, 2.0)),
    "low-pass disc": surfel((0.05, -0.02, 2.0), scales=(1e-5, 1e-5), opacity=0.9),
    "needle": surfel((*OFF, 2.0), scales=(0.8, 1e-7), opacity=0.9),
    "edge-on": join(edge_on(0.013), VISIBLE),
    "tangents neither unit nor orthogonal": surfel((*OFF, 2.0), tangent_u=(2, 0.3, 0.5), tangent_v=(0.4, 0.7, -0.1)),
    "crossing the camera plane": tilted(1.2),
    "hits before near": tilted(1.5, opacity=0.9),
    "two surfels back to front": join(
        surfel((*OFF, 5.0), scales=(2, 2), opacity=0.7), surfel((*OFF, 2.0), opacity=0.4)
    ),
    "stop rule": stacked(0.95, 6),
    "clamp": surfel((*OFF, 2.0), opacity=1.0),
    "opacity above one": surfel((*OFF, 2.0), opacity=3.0),
    "ties by row": join(surfel((*OFF, 2.0), opacity=0.5), surfel((*OFF, 2.0), opacity=0.5, features=(-1.0,))),
    "normal turned": join(surfel((*OFF, 2.0), tangent_u=(0, 1, 0.4), tangent_v=(1, 0, 0)), VISIBLE),
    "median": stacked(0.35, 4),
    "alpha cut": join(surfel((*OFF, 2.0), opacity=2 / 255), VISIBLE),
    "below the opacity cut": join(surfel((*OFF, 2.0), opacity=0.9 / 255), VISIBLE),
    "behind": join(surfel((0.0, 0.0, -2.0), scales=(3, 3)), VISIBLE),
    "before near": join(surfel((0.0, 0.0, 0.15), scales=(3, 3)), VISIBLE),
    "zero scale": join(surfel((*OFF, 2.0), scales=(0.5, 0.0)), VISIBLE),
    "negative scale": join(surfel((*OFF, 2.0), scales=(-0.5, 0.5)), VISIBLE),
    "nan mean": join(surfel((math.nan, 0.0, 2.0)), VISIBLE),
    "inf depth": join(surfel((0.0, 0.0, math.inf)), VISIBLE),
    "nan opacity": join(surfel((*OFF, 2.0), opacity=math.nan), VISIBLE),
    "inf tangent": join(surfel((*OFF, 2.0), tangent_u=(math.inf, 0, 0)), VISIBLE),
    "nan scale": join(surfel((*OFF, 2.0), scales=(math.nan, 0.5)), VISIBLE),
    "nan feature": join(surfel((*OFF, 2.0), features=(math.nan,)), VISIBLE),
}


def single(surfels: SurfelTensors, camera: Camera, background: bool = False) -> SurfelScene:
    """The scene in float32."""
    behind = torch.linspace(0.2, 0.7, surfels.features.shape[1]) if background else None
    return SurfelScene(SurfelTensors(*(t.float() for t in surfels.all())), camera, behind)


def assert_agrees(scene: SurfelScene, flagged_share: float = 0.25) -> None:
    """Native pictures and gradients equal the twin's wherever nothing is flagged."""
    expected = answer(scene)
    assert expected.flagged.double().mean() <= flagged_share
    native = run(rasterize_surfels, scene, torch.float32, expected.upstream)
    for name in OUTPUTS:
        error = pixel_error(native.pictures[name], expected.exact.pictures[name])
        assert error[~expected.flagged].max() <= 1e-5, name
    for name, gradient in expected.exact.gradients.items():
        assert relative_error(native.gradients[name], gradient).max() <= 1e-4, name
    assert relative_error(native.weight_sum, expected.exact.weight_sum).max() <= 1e-4


@pytest.mark.parametrize("rule", RULES)
def test_rule(isa: str, rule: str):
    assert_agrees(single(RULES[rule], identity_camera(21, 19, fx=11.0, fy=13.0, cx=8.4, cy=10.7)))


def test_background_and_many_tiles(isa: str):
    """A picture of 5 x 3 partial tiles, one surfel over all of them, one at the far corner."""
    corner = surfel((1.73, 0.96, 3.0), scales=(0.05, 0.05), opacity=0.8, features=(0.5, 2.0))
    wide = surfel((*OFF, 5.0), scales=(4, 3), opacity=0.9, features=(-1.0, 1.0))
    assert_agrees(single(join(wide, corner), identity_camera(70, 41, fx=60.0, fy=55.0), background=True))


def test_turned_camera_with_nothing_in_view(isa: str):
    rotation = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))
    camera = replace(identity_camera(18, 9), rotation=rotation)
    scene = single(VISIBLE, camera, background=True)
    native = run(rasterize_surfels, scene, torch.float32, answer(scene).upstream)
    assert not native.pictures["alpha"].any()
    assert (native.pictures["features"] == scene.background[:, None, None]).all()  # type: ignore[index]
    assert not any(gradient.any() for gradient in native.gradients.values())


def test_no_surfels(isa: str):
    scene = single(VISIBLE.rows(torch.empty(0, dtype=torch.long)), identity_camera(), background=True)
    buffers = rasterize_surfels(*scene.surfels.all(), scene.camera, background=scene.background)
    torch.testing.assert_close(buffers.features, scene.background[:, None, None].expand(1, 7, 9))  # type: ignore[index]
    assert not buffers.alpha.any()


@pytest.mark.parametrize("near", [0.02, 0.2, 2.5])
def test_near_and_far_options(isa: str, near: float):
    options = RasterOptions(near=near, far=20.0, depth=True, distortion=True)
    values = SurfelTensors(*(t.float() for t in stacked(0.4, 4).all()))
    camera = identity_camera(21, 19)
    expected = twin(*(t.double() for t in values.all()), camera, options=options)
    native = rasterize_surfels(*values.all(), camera, options=options)
    for name in ("features", "alpha", "depth", "distortion"):
        error = pixel_error(getattr(native, name), getattr(expected, name))
        assert (error > 1e-5).double().mean() <= 0.02, name


@pytest.mark.parametrize("name", ["depth", "median_depth", "normal", "distortion", "weight_sum"])
def test_optional_outputs_alone_are_the_same_and_the_others_none(isa: str, name: str):
    values = SurfelTensors(*(t.float() for t in stacked(0.4, 4).all()))
    camera = identity_camera(21, 19)
    alone = rasterize_surfels(*values.all(), camera, options=RasterOptions(**{name: True}))
    expected = twin(*(t.double() for t in values.all()), camera, options=RasterOptions(**{name: True}))
    for other in ("depth", "median_depth", "normal", "distortion", "weight_sum"):
        assert (getattr(alone, other) is None) is (other != name)
    assert (relative_error(getattr(alone, name), getattr(expected, name)) > 1e-5).double().mean() <= 0.02


@pytest.mark.parametrize(
    "wanted",
    [
        (),
        ("weight_sum",),
        ("normal",),
        ("depth",),
        ("median_depth",),
        ("distortion",),
        ("depth", "normal", "weight_sum"),
    ],
    ids=lambda wanted: "+".join(wanted) or "none",
)
def test_gradients_with_only_some_outputs(isa: str, wanted: tuple[str, ...]):
    """Each combination that training asks for has record layouts and kernels of its own."""
    exact = expected(Recipe("crowded", 7, 150, 49, 35, 3))
    options = replace(ALL_OUTPUTS, **{name: name in wanted for name in OPTIONAL})
    pictures = ["features", "alpha", *(name for name in wanted if name != "weight_sum")]
    gradients = []
    for rasterizer, dtype in ((rasterize_surfels, torch.float32), (twin, torch.float64)):
        leaves = exact.scene.surfels.leaves(dtype).all()
        probe = torch.zeros(len(leaves[0]), 2, dtype=dtype, requires_grad=True)
        buffers = rasterizer(*leaves, exact.scene.camera, options=options, screen_probe=probe)
        loss = sum((output(buffers, name) * exact.upstream[name].to(dtype)).sum() for name in pictures)
        gradients.append(torch.autograd.grad(loss, (*leaves, probe)))  # type: ignore[arg-type]
    for name, native, reference in zip((*NAMES, "screen_probe"), *gradients, strict=True):
        assert relative_error(native, reference).max() <= 1e-4, name


def test_nothing_is_nan_or_inf_for_any_finite_input(isa: str):
    """Values from 1e-30 to 1e30 anywhere; the twin in float64 has room for all of them and must be finite as well."""

    @settings(max_examples=200, deadline=None, derandomize=True, database=None)
    @given(seed=st.integers(0, 2**31), count=st.integers(1, 30))
    def draw(seed: int, count: int) -> None:
        scene = wild(seed, count)
        generator = torch.Generator().manual_seed(seed)
        shapes = dict.fromkeys(OUTPUTS, ()) | {"features": (4,), "normal": (3,)}
        upstream = {name: torch.randn(*shapes[name], 19, 24, generator=generator) for name in OUTPUTS}
        native = run(rasterize_surfels, scene, torch.float32, upstream)
        for group in (native.pictures, native.gradients, {"weight_sum": native.weight_sum}):
            for name, values in group.items():
                assert values.isfinite().all(), name

    draw()


def test_the_number_of_threads_does_not_change_a_bit(isa: str):
    answered = expected(Recipe("crowded", 7, 150, 49, 35, 12))
    runs = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        runs.append(run(rasterize_surfels, answered.scene, torch.float32, answered.upstream))
    for other in runs[1:]:
        for name, picture in runs[0].pictures.items():
            assert torch.equal(other.pictures[name], picture), name
        for name, gradient in runs[0].gradients.items():
            assert torch.equal(other.gradients[name], gradient), name
        assert torch.equal(other.weight_sum, runs[0].weight_sum)


def test_the_order_of_rows_does_not_change_a_bit(isa: str):
    """Without ties in depth a pixel adds up the same numbers in the same order."""
    answered = expected(Recipe("crowded", 7, 150, 49, 35, 12))
    order = torch.randperm(150, generator=torch.Generator().manual_seed(2))
    straight = run(rasterize_surfels, answered.scene, torch.float32, answered.upstream)
    shuffled_scene = replace(answered.scene, surfels=answered.scene.surfels.rows(order))
    shuffled = run(rasterize_surfels, shuffled_scene, torch.float32, answered.upstream)
    for name, picture in straight.pictures.items():
        assert torch.equal(shuffled.pictures[name], picture), name
    for name, gradient in straight.gradients.items():
        assert torch.equal(shuffled.gradients[name], gradient[order]), name


def test_gradients_of_culled_rows_are_zero(isa: str):
    values = SurfelTensors(*(t.float() for t in RULES["nan mean"].all())).leaves(torch.float32)
    rasterize_surfels(*values.all(), identity_camera()).features.sum().backward()
    for name in NAMES:
        gradient = getattr(values, name).grad
        assert gradient is not None
        assert not gradient[0].any(), name
