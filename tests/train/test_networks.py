"""Which networks the perceptual loss reads, what of them a key names, and that no training has others than its key."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rtgs.pretrained.weights import LPIPS_VGG, VGG16, MissingWeights, WrongWeights
from rtgs.train import networks
from rtgs.train.networks import check_networks, named_in_key, networks_of
from rtgs.train.settings import LossSettings
from tests.small_networks import look_in, put

LPIPS = LossSettings(perceptual=0.01)
L1 = replace(LPIPS, perceptual_form="vgg16_l1")
VGG_NAMED, HEADS_NAMED = (("vgg16", "1" * 64), ("lpips_vgg", "2" * 64))
BOTH = (VGG_NAMED, HEADS_NAMED)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The one place where weights are looked for."""
    return look_in(tmp_path, networks, monkeypatch)


def test_a_form_reads_its_own_files():
    assert networks_of(LPIPS) == (VGG16, LPIPS_VGG)
    assert networks_of(L1) == (VGG16,)
    assert networks_of(LossSettings()) == networks_of(replace(L1, perceptual=0.0)) == ()


def test_a_key_names_what_the_form_reads_and_nothing_where_that_is_not_whole():
    assert named_in_key(LPIPS, BOTH) == BOTH
    assert named_in_key(L1, BOTH) == named_in_key(L1, (VGG_NAMED,)) == (VGG_NAMED,)
    assert named_in_key(LPIPS, (VGG_NAMED,)) == named_in_key(L1, (HEADS_NAMED,)) == ()  # trained without the loss
    assert named_in_key(LPIPS, ()) == named_in_key(LossSettings(), BOTH) == ()


def test_a_training_has_the_networks_of_its_key(folder: Path):
    for loss in (LPIPS, L1, LossSettings()):
        check_networks(loss, (("method exposure", "3" * 64),))  # none named, none here
    put(folder, VGG16)
    check_networks(L1, (VGG_NAMED,))
    check_networks(LPIPS, ())  # half of them: it trains without the loss, as the key says
    put(folder, LPIPS_VGG)
    check_networks(LPIPS, BOTH)
    check_networks(LossSettings(), ())


def test_a_missing_file_is_refused_with_its_place_and_the_way_out(folder: Path):
    put(folder, VGG16)
    with pytest.raises(MissingWeights) as refused:
        check_networks(LPIPS, BOTH)
    text = str(refused.value)
    for part in (
        "the key of this step names the network lpips_vgg (SHA-256 2222222222222222...)",
        "method.loss.perceptual=0.01, perceptual_form=lpips",
        "weights missing: lpips_v0.1/vgg.pth",
        f"searched {folder}",
        "RTGS_WEIGHTS",
        "Or copy it from the machine that made the plan",
    ):
        assert part in text


def test_another_file_is_refused(folder: Path):
    (folder / VGG16.filename).write_bytes(b"cut short")
    with pytest.raises(WrongWeights, match=r"names the network vgg16 .* is not vgg16-397923af\.pth: SHA-256"):
        check_networks(L1, (VGG_NAMED,))


def test_networks_that_the_key_does_not_name_are_refused_too(folder: Path):
    """They would act in what is stored as trained without."""
    put(folder, VGG16, LPIPS_VGG)
    for loss in (LPIPS, L1):
        with pytest.raises(WrongWeights, match=r"names no network of .*has vgg16-397923af\.pth.*perceptual=0"):
            check_networks(loss, ())
