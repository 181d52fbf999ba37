"""Choices of the second stage are judged on views that are neither trained on nor tested on; each is a recipe."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import torch

from lab.specular_choices import CHOICES, MIRROR_BALL, ball_setting, compose_choice, row, score, trained
from rtgs.methods.model import Model


def options(**changes: object) -> Namespace:
    given = {"scene": MIRROR_BALL, "preset": "quick", "steps": None, "long_side": 24, "set": [], "root": Path()}
    return Namespace(**(given | changes))


def test_views_to_judge_are_neither_trained_nor_tested():
    setting = ball_setting(options())
    names = {view.name for view in setting.train.train}, {view.name for view in setting.judged}
    assert not setting.train.test
    assert not names[0] & names[1]
    assert names[0] | names[1] == set(setting.known)
    assert len(setting.judged) == 4
    known = setting.known[setting.judged[0].name]
    inside = known[3] > 0
    assert 0.02 < float(inside.float().mean()) < 0.5
    torch.testing.assert_close(known[:3].norm(dim=0)[inside], torch.ones(int(inside.sum())))


def test_every_choice_is_another_recipe():
    some = ("rtgs", "dielectric start", "all as before")  # composing all would take seconds
    assert len({repr(compose_choice(options(), CHOICES[name]).method) for name in some}) == len(some)


def test_a_choice_is_trained_and_scored(tmp_path):
    words = ["schedule.total=12", "method.reflection.cells=3", "method.reflection.matte.probation=0"]
    setting = ball_setting(options(root=tmp_path))
    config = compose_choice(options(root=tmp_path, set=words), CHOICES["rtgs"])
    method, seconds = trained(config, setting.train, 0, None)
    assert isinstance(method, Model)
    found = score(method, "rtgs", 0, seconds, setting)
    assert found.k_s is not None
    assert 0 < found.k_s < 1
    assert 0 < found.normal_error < 180
    assert found.psnr_rest > 3
    assert row(found).count("|") == 15
    assert (tmp_path / "pictures" / "mirror_ball-rtgs-0.png").is_file()
