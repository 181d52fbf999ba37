"""L_perc with a tiny random VGG: both forms, the crop, and what happens without the weights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from reflective_cases import new_method, recipe, schedule, tiny
from test_lpips import TINY, head_tensors, vgg_tensors

from rtgs.methods import Mode, Stage, losses
from rtgs.pretrained import vgg, weights
from rtgs.pretrained.lpips import InputRange, Lpips
from rtgs.pretrained.vgg import Vgg16Features
from rtgs.pretrained.weights import MissingWeights
from rtgs.train import perceptual
from rtgs.train.perceptual import PerceptualLoss
from rtgs.train.settings import LossSettings


@pytest.fixture(scope="module")
def network() -> Lpips:
    return Lpips(Vgg16Features(vgg_tensors(TINY)), head_tensors(TINY))


def pair(height: int = 40, width: int = 52) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(3, height, width, generator=generator), torch.rand(3, height, width, generator=generator)


def test_an_image_no_larger_than_the_crop_is_compared_whole(network: Lpips):
    image, target = pair()
    found = PerceptualLoss(LossSettings(perceptual_crop=64), network)(image, target, torch.Generator())
    torch.testing.assert_close(found, network(image, target, InputRange.ZERO_ONE))


@pytest.mark.parametrize("form", ["lpips", "vgg16_l1"])
def test_a_crop_gets_the_gradient_and_the_rest_of_the_image_none(network: Lpips, form: str):
    image, target = pair()
    image.requires_grad_()
    loss = PerceptualLoss(LossSettings(perceptual_crop=32, perceptual_form=form), network)
    value = loss(image, target, torch.Generator().manual_seed(4))
    value.backward()
    assert image.grad is not None
    touched = (image.grad.abs().sum(0) > 0).nonzero()
    assert float(value.detach()) > 0
    assert (touched.max(0).values - touched.min(0).values + 1).tolist() == [32, 32]
    assert float(loss(target, target, torch.Generator())) == pytest.approx(0, abs=1e-9)


def test_the_gradient_is_that_of_the_network(network: Lpips):
    (image, target), own = pair(), pair()[0].requires_grad_()
    image.requires_grad_()
    (2 * PerceptualLoss(LossSettings(perceptual_crop=64), network)(image, target, torch.Generator())).backward()
    (2 * network(own, target, InputRange.ZERO_ONE)).backward()
    torch.testing.assert_close(image.grad, own.grad)


def test_raw_features_need_no_heads_of_lpips(network: Lpips, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(weights, "weight_folders", lambda: (tmp_path,))
    monkeypatch.setattr(vgg, "verify_weights", lambda file, path: None)  # a tiny one in the place of the published
    form = LossSettings(perceptual=0.01, perceptual_form="vgg16_l1", perceptual_crop=32)
    with pytest.raises(MissingWeights, match="vgg16"):
        PerceptualLoss(form)
    torch.save(vgg_tensors(TINY), tmp_path / weights.VGG16.filename)
    found, given = (PerceptualLoss(form, each)(*pair(), torch.Generator().manual_seed(2)) for each in (None, network))
    assert torch.equal(found, given)
    with pytest.raises(MissingWeights, match=r"lpips_v0\.1/vgg\.pth"):
        PerceptualLoss(replace(form, perceptual_form="lpips"))


def test_raw_features_are_those_of_the_colours_that_the_network_was_trained_on(network: Lpips):
    """torchvision's mean and deviation of colours in [0, 1] are those of lpips in [-1, 1], to its three digits."""
    image, target = pair()
    mean, deviation = (
        torch.tensor(values).view(1, 3, 1, 1) for values in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
    )
    features = network.features((torch.stack((image, target)) - mean) / deviation)
    expected = torch.stack([(block[0] - block[1]).abs().mean() for block in features]).mean()
    found = PerceptualLoss(LossSettings(perceptual_form="vgg16_l1"), network)(image, target, torch.Generator())
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=0)


def test_every_place_of_the_image_is_drawn(network: Lpips):
    image, target = pair(34, 33)
    generator = torch.Generator().manual_seed(1)
    seen = torch.zeros(34, 33, dtype=torch.bool)
    loss = PerceptualLoss(LossSettings(perceptual_crop=32, perceptual_form="vgg16_l1"), network)
    for _ in range(12):
        leaf = image.clone().requires_grad_()
        loss(leaf, target, generator).backward()
        assert leaf.grad is not None
        seen |= leaf.grad.abs().sum(0) > 0
    assert bool(seen.all())


def test_the_second_stage_uses_it_from_its_share_of_the_run(network: Lpips, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(losses, "PerceptualLoss", lambda settings: PerceptualLoss(settings, network))
    settings = recipe()
    loss = replace(settings.loss, perceptual=0.5, perceptual_start=0.5, perceptual_crop=32)
    made = tiny()
    method = new_method(replace(settings, loss=loss), made, schedule())
    method.begin(Stage("reflection", 15, 60))
    view = made.scene.train[0]
    names = [
        [t.name for t in method.losses(method.render(view.camera, s, Mode.TRAIN), view, s).terms] for s in (29, 30)
    ]
    assert "perceptual" not in names[0]
    assert "perceptual" in names[1]


def test_without_the_weights_it_is_left_out_and_the_report_says_why(monkeypatch: pytest.MonkeyPatch):
    def absent(file):
        raise MissingWeights("vgg16 is not on this machine\nget it there")

    monkeypatch.setattr(perceptual, "find_weights", absent)
    settings = recipe()
    made = tiny()
    method = new_method(replace(settings, loss=replace(settings.loss, perceptual=0.01)), made, schedule())
    assert "perceptual" not in {term.name for term in method.loss.terms}
    told = {decision.what: decision.why for decision in method.decisions}
    assert told["no perceptual loss"] == "vgg16 is not on this machine"
    silent = new_method(settings, made, schedule())
    assert "no perceptual loss" not in {decision.what for decision in silent.decisions}


def test_the_loss_on_masks_pulls_the_specular_weight_up_to_its_target():
    settings = recipe()
    loss = replace(settings.loss, specular=1.0, specular_start=0.0)
    made = tiny()
    method = new_method(replace(settings, loss=loss), made, schedule())
    method.begin(Stage("reflection", 15, 60))
    view = replace(made.scene.train[0], mask=made.masks[made.scene.train[0].name])
    rendered = method.render(view.camera, 20, Mode.TRAIN)
    terms = {term.name: term.value for term in method.losses(rendered, view, 20).terms}
    assert view.mask is not None
    assert rendered.maps.get("specular") is not None
    expected = float(((0.9 - rendered.maps["specular"].detach()).clamp_min(0) * view.mask).mean())
    assert terms["specular"] == pytest.approx(expected)
    bare = {term.name for term in method.losses(rendered, made.scene.train[0], 20).terms}
    assert "specular" not in bare
