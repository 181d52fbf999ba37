"""The native ellipsoid rasteriser against its twin: hypothesis-drawn scenes, errors pooled over all examples of a test.

Ordinary scenes: pictures within 1e-5 of their maximum on all but 1e-3 of the pixels, gradients within 1e-4 of their
largest element. Degenerate scenes: the larger of these and four times the error of the twin itself run in float32.
Pixels on a discontinuity are flagged, counted, and given no upstream gradient.
"""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgs.render.buffers import EllipsoidOptions
from rtgs.render.ellipsoids import rasterize_ellipsoids
from rtgs.render.reference.ellipsoids import rasterize_ellipsoids as twin

from .comparison import relative_error
from .ellipsoid_runs import ANTIALIASED, PICTURES, PLAIN, expected, rounded, run, wild_ellipsoids
from .strategies import MODIFIERS, Recipe, recipes
from .twin_runs import Pools

PIXEL_TOLERANCE, PIXEL_SHARE = 1e-5, 1e-3
GRADIENT_TOLERANCE = 1e-4
SLACK = 4.0  # of degenerate scenes, over the twin in float32
# Known shortfall, of the largest gradient alone: 1.8e-4 and, on the portable path, 2.7e-4 measured. What lies behind an
# entry is the rounded picture less what was passed; its error, some 3e-7, is divided by 1 - alpha. Opacities below 0.3:
# 3e-6; above 0.9: up to 2e-3.
ILL_CONDITIONED_TOLERANCE = {"huge": 5e-4, "crossing": 5e-4}
VARIANTS = {
    "plain": PLAIN,
    "antialiased": ANTIALIASED,
    "radius": replace(PLAIN, radius_sigmas=2.0),
    "wide": replace(ANTIALIASED, dilation=2.0, near=1.0),
}


def pool_examples(
    kind: str, examples: int, options: EllipsoidOptions, *, with_twin: bool = False
) -> tuple[Pools, Pools]:
    """Errors of the native kernel over drawn scenes of a kind, and of the float32 twin if asked for."""
    native, in_float32 = Pools(PICTURES), Pools(PICTURES)

    @settings(max_examples=examples, deadline=None, derandomize=True, database=None)
    @given(recipe=recipes(kind))
    def draw(recipe: Recipe) -> None:
        answer = expected(recipe, options)
        native.add(run(rasterize_ellipsoids, answer.scene, torch.float32, answer.upstream, options), answer)
        if with_twin:
            in_float32.add(rounded(recipe, options), answer)

    draw()
    return native, in_float32


@pytest.mark.parametrize("options", VARIANTS.values(), ids=VARIANTS)
def test_ordinary_scenes(isa: str, options: EllipsoidOptions):
    pools, _ = pool_examples("ordinary", 25, options)
    assert pools.pictures["alpha"].total > 5000
    assert pools.flagged_share < 0.1
    for name, pool in pools.pictures.items():
        assert pool.share_beyond(PIXEL_TOLERANCE) <= PIXEL_SHARE, f"{name}: worst {pool.worst:.1e}"
    for name, pool in pools.gradients.items():
        assert pool.worst <= GRADIENT_TOLERANCE, name
    assert pools.weight_sum.share_beyond(PIXEL_TOLERANCE) <= PIXEL_SHARE


@pytest.mark.parametrize("options", [PLAIN, ANTIALIASED], ids=["plain", "antialiased"])
@pytest.mark.parametrize("kind", MODIFIERS)
def test_degenerate_scenes(isa: str, kind: str, options: EllipsoidOptions):
    pools, in_float32 = pool_examples(kind, 10, options, with_twin=True)
    assert pools.flagged_share < 0.5
    for name, pool in pools.pictures.items():
        allowed = max(PIXEL_SHARE, SLACK * in_float32.pictures[name].share_beyond(PIXEL_TOLERANCE))
        assert pool.share_beyond(PIXEL_TOLERANCE) <= allowed, f"{name}: worst {pool.worst:.1e}"
    for name, pool in pools.gradients.items():
        tolerance = ILL_CONDITIONED_TOLERANCE.get(kind, GRADIENT_TOLERANCE)
        assert pool.worst <= max(tolerance, SLACK * in_float32.gradients[name].worst), f"{name} {pool.worst:.1e}"


def test_crowded_picture(isa: str):
    """Many ellipsoids per pixel over 4 x 3 tiles: long tile lists, and pixels that stop early."""
    answer = expected(Recipe("crowded", 7, 150, 49, 35, 12))
    assert (answer.exact.pictures["alpha"] > 1 - 1e-4).double().mean() > 0.2
    pools = Pools(PICTURES)
    pools.add(run(rasterize_ellipsoids, answer.scene, torch.float32, answer.upstream), answer)
    assert pools.flagged_share < 0.5
    for name, pool in pools.pictures.items():
        assert pool.share_beyond(PIXEL_TOLERANCE) <= PIXEL_SHARE, f"{name}: worst {pool.worst:.1e}"
    for name, pool in pools.gradients.items():
        assert pool.worst <= GRADIENT_TOLERANCE, name


@pytest.mark.parametrize("channels", range(1, 33))
def test_every_channel_count(isa: str, channels: int):
    """With the depth as one more channel."""
    answer = expected(Recipe("ordinary", 100 + channels, 12, 19, 17, channels))
    pools = Pools(PICTURES)
    pools.add(run(rasterize_ellipsoids, answer.scene, torch.float32, answer.upstream), answer)
    for name in PICTURES:
        assert pools.pictures[name].share_beyond(PIXEL_TOLERANCE) <= 4 / (19 * 17), name
    for name, pool in pools.gradients.items():
        assert pool.worst <= GRADIENT_TOLERANCE, name


@pytest.mark.parametrize("channels", [1, 3, 4, 6, 32])
def test_gradients_without_depth(isa: str, channels: int):
    """What plain training asks for: the depth's channel is not there."""
    answer = expected(Recipe("crowded", 11, 60, 33, 25, channels))
    bare = EllipsoidOptions()
    leaves = answer.scene.surfels.leaves(torch.float32).all()
    native = rasterize_ellipsoids(*leaves, answer.scene.camera, background=answer.scene.background, options=bare)
    assert native.depth is None
    exact = answer.scene.surfels.leaves(torch.float64).all()
    background = None if answer.scene.background is None else answer.scene.background.double()
    reference = twin(*exact, answer.scene.camera, background=background, options=bare)
    pulled = []
    for buffers, inputs in ((native, leaves), (reference, exact)):
        loss = (buffers.features * answer.upstream["features"].to(buffers.features)).sum()
        loss = loss + (buffers.alpha * answer.upstream["alpha"].to(buffers.alpha)).sum()
        pulled.append(torch.autograd.grad(loss, inputs))
    for a, b in zip(*pulled, strict=True):
        assert relative_error(a, b).max() <= GRADIENT_TOLERANCE


@pytest.mark.parametrize("options", [PLAIN, ANTIALIASED], ids=["plain", "antialiased"])
def test_nothing_is_nan_or_inf_for_any_finite_input(isa: str, options: EllipsoidOptions):
    """Values from 1e-30 to 1e30 anywhere."""

    @settings(max_examples=100, deadline=None, derandomize=True, database=None)
    @given(seed=st.integers(0, 2**31), count=st.integers(1, 30))
    def draw(seed: int, count: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        shapes = dict.fromkeys(PICTURES, ()) | {"features": (4,)}
        upstream = {name: torch.randn(*shapes[name], 19, 24, generator=generator) for name in PICTURES}
        native = run(rasterize_ellipsoids, wild_ellipsoids(seed, count), torch.float32, upstream, options)
        for group in (native.pictures, native.gradients, {"weight_sum": native.weight_sum}):
            for name, values in group.items():
                assert values.isfinite().all(), name

    draw()
