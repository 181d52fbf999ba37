"""Ref-Gaussian's keys, what its stages read, and its properties in files."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from ref_gaussian_cases import settings, trained
from reflective_cases import schedule
from training_cases import small_scene

from rtgs.core.errors import RtgsError
from rtgs.gaussians.ply import read_gaussians, write_ply
from rtgs.light.cubemap import CubemapLight
from rtgs.light.settings import EnvironmentSettings
from rtgs.methods import create_method, find_method
from rtgs.train.seeds import generator_for
from rtgs.train.settings import ScheduleSettings


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"normal": "median"}, "method.own.normal"),
        ({"albedo": 1.0}, "method.own.albedo"),
        ({"indirect_start": "warm"}, "method.own.indirect_start"),
        ({"indirect_from": 1.5}, "method.own.indirect_from"),
        ({"mesh_every": 0.0}, "method.own.mesh_every"),
        ({"mesh_cells": 1}, "method.own.mesh_cells"),
        ({"reach": -1.0}, "method.own.reach"),
        ({"mesh": 1.0}, "method.own.mesh is no key"),
    ],
)
def test_keys_that_make_no_sense_are_refused(own: dict, message: str):
    with pytest.raises((RtgsError, ValueError), match=message):
        create_method(settings(**own), small_scene(), ScheduleSettings(total=10), generator_for(0, "initialise"))


@pytest.mark.parametrize("share", [0.1, 0.25])
def test_a_first_part_that_ends_before_the_stage_begins_is_refused(share: float):
    spec, asked = find_method("ref_gaussian"), settings(forward_until=share)
    message = rf"forward_until={share} is step \d+ of 60, but .* from step 15 on \(method.reflection.start=0.25\)"
    with pytest.raises(RtgsError, match=message):
        spec.timeline(asked, schedule())
    with pytest.raises(RtgsError, match=message):
        create_method(asked, small_scene(), schedule(), generator_for(0, "initialise"))
    assert len(spec.timeline(spec.stage("diffuse").reads(asked), schedule())) == 2
    assert len(spec.timeline(settings(forward_until=0.3), schedule())) == 2


def test_the_first_stage_reads_nothing_of_the_second():
    spec = find_method("ref_gaussian")
    one, other = settings(reach=4.0), replace(settings(), environment=EnvironmentSettings(side=64))
    assert spec.stage("diffuse").reads(one) == spec.stage("diffuse").reads(other)
    assert spec.stage("reflection").reads(one) != spec.stage("reflection").reads(settings())


def test_named_properties_and_back(tmp_path):
    method, made = trained()
    gaussians = method["base"].gaussians
    path = tmp_path / "base.ply"
    write_ply(path, gaussians)
    head = path.read_bytes()[:6000]
    for name in (b"metalness", b"roughness", b"albedo_2", b"indirect_dc_0", b"indirect_rest_44"):
        assert b"property float " + name + b"\n" in head
    found = read_gaussians(path, channels=gaussians.channels)
    for name, tensor in gaussians.items():
        assert torch.equal(found[name], tensor.detach()), name
    assert isinstance(method.light, CubemapLight)
    assert method.light.settings.mips == "ggx"
    assert made.scene.name
