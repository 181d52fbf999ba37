"""Surfels of Ref-Gaussian shaded one by one, as published for synthetic scenes."""

from __future__ import annotations

from dataclasses import replace

import torch
from ref_gaussian_cases import CUBEMAP, MATERIALS, mirror, settings
from reflective_cases import new_method, schedule, tiny, train_step

from rtgs.gaussians.density import logit
from rtgs.gaussians.surfels import activate
from rtgs.light.cubemap import CubemapLight
from rtgs.methods import Mode, RenderOptions, Stage
from rtgs.methods.parts.part import Frame
from rtgs.methods.parts.split_sum_mirror import (
    ALBEDO,
    METALNESS,
)
from rtgs.optics.split_sum import split_sum_factors


def test_surfels_are_shaded_one_by_one_first():
    """From 15 to 24 under one cubemap, then materials begin anew under another; only then colours get noise."""
    made = tiny()
    method, other = (new_method(settings(forward_until=0.4), made, schedule()) for _ in range(2))
    part, base, events = mirror(method), method["base"], {}
    for stage in method.stages:
        events[stage.from_step] = [each.set_name for each in method.begin(stage)]
    assert events[15] == ["forward_environment"]
    assert [group.name for group in method.groups] == ["forward_environment"]
    for step in range(15, 23):
        train_step(method, made, step)
    assert bool((base.gaussians[ALBEDO] != 0).any()), "initial 0.5"
    other.load({name: tensor.clone() for name, tensor in method.state().items()})
    view = made.scene.train[0]
    assert torch.equal(*(m.render(view.camera, 22, Mode.EVALUATE).image for m in (method, other)))
    kinds = [each.kind for each in train_step(method, made, 23)[1]]
    assert kinds.count("begin") == 1
    assert [group.name for group in method.groups] == ["environment"]
    assert torch.equal(base.gaussians[METALNESS].detach(), torch.full((len(base),), logit(0.2)))
    assert not base.gaussians[ALBEDO].any()
    train_step(other, made, 23)
    for step in range(24, 40):
        train_step(method, made, step)
        train_step(other, made, step)
    expected, found = method.state(), other.state()
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []
    assert method.base.painter is part, "indirect light has begun"
    asked = settings()
    spared = replace(asked.reflection, propagation=replace(asked.reflection.propagation, sabotage=0.0))
    real, calm = (mirror(new_method(found, made, schedule())) for found in (asked, replace(asked, reflection=spared)))
    for each, following, moved in ((part, 48, True), (part, 20, False), (real, 48, True), (calm, 48, False)):
        gaussians = each.base.set.gaussians
        if METALNESS not in gaussians:
            each._adopt((METALNESS,))
            gaussians = each.base.set.gaussians
        with torch.no_grad():
            gaussians[METALNESS].fill_(-9.0)
        before = gaussians.sh_dc.detach().clone()
        event = each._propagated(following)
        assert torch.equal(gaussians.sh_dc.detach(), before) != moved
        assert event.detail.endswith(f"colours of {len(gaussians) if moved else 0} disturbed")


def test_a_shaded_surfel_is_its_equation():
    """In float64, from formulas written out; every gradient too."""
    made = tiny()
    method = new_method(settings(forward_until=0.4), made, schedule())
    method.begin(Stage("reflection", 15, 60))
    part, generator = mirror(method), torch.Generator().manual_seed(5)
    base, camera = method["base"].gaussians, made.scene.train[0].camera
    with torch.no_grad():
        for name in MATERIALS:
            base[name] += torch.randn(base[name].shape, generator=generator)
    exact = base.like({name: tensor.detach().double().requires_grad_() for name, tensor in base.items()})
    texels = method.groups[0]["texels"].detach().double().requires_grad_()
    light = CubemapLight(texels, CUBEMAP)
    rows = activate(exact, camera.center, 0)
    normals = torch.linalg.cross(rows.tangent_u, rows.tangent_v, dim=1)
    to_eye = torch.nn.functional.normalize(camera.center - rows.means, dim=1)
    normals = normals * (normals * to_eye).sum(1, keepdim=True).sign()
    cosine = (normals * to_eye).sum(1, keepdim=True)
    metal, rough, albedo = (exact[name].sigmoid().reshape(len(exact), -1) for name in MATERIALS)
    scale, bias = (each[:, None] for each in split_sum_factors(cosine[:, 0], rough[:, 0] ** 2))
    weight = (0.04 * (1 - metal) + albedo * metal) * scale + bias
    expected = (1 - metal) * albedo * light.irradiance(normals)
    expected = expected + weight * light(2 * cosine * normals - to_eye, rough[:, 0])
    frame = Frame(camera, 20, Mode.TRAIN, RenderOptions())
    found = part.paint(frame, method["base"].activated(camera.center.float(), 0))
    torch.testing.assert_close(found[:, :3].double(), expected, atol=2e-5, rtol=0)
    upstream = torch.randn(expected.shape, generator=generator, dtype=torch.float64)
    (expected * upstream).sum().backward()
    (found[:, :3] * upstream.float()).sum().backward()
    pairs = [(base[name].grad, exact[name].grad, name) for name in ("quaternions", "means", *MATERIALS)]
    for ours, twin, name in (*pairs, (method.groups[0]["texels"].grad, texels.grad, "texels")):
        assert float((ours.double() - twin).norm() / twin.norm()) < 2e-3, name
