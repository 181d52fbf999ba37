"""No table has LPIPS of other networks than its key names."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtgs.evaluate import networks
from rtgs.evaluate.networks import check_networks
from rtgs.evaluate.settings import EvaluationSettings
from rtgs.pretrained.keys import ABSENT
from rtgs.pretrained.weights import LPIPS_VGG, VGG16, MissingWeights, WrongWeights
from tests.small_networks import look_in, put

ON = EvaluationSettings()
BOTH = (("lpips_vgg", "2" * 64), ("vgg16", "1" * 64))
NONE = (("lpips_vgg", ABSENT), ("vgg16", ABSENT))
HALF = (("lpips_vgg", ABSENT), ("vgg16", "1" * 64))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The one place where weights are looked for."""
    return look_in(tmp_path, networks, monkeypatch)


def test_an_evaluation_has_the_networks_of_its_key(folder: Path):
    for key in (NONE, HALF, ()):
        check_networks(ON, key)
    put(folder, VGG16)
    check_networks(ON, NONE)
    check_networks(ON, HALF)  # half of them measure nothing, on either machine
    put(folder, LPIPS_VGG)
    check_networks(ON, BOTH)
    check_networks(ON, ())  # such a key says nothing of networks


def test_where_lpips_is_off_nothing_is_looked_for(folder: Path):
    off = EvaluationSettings(lpips=False)
    check_networks(off, BOTH)
    put(folder, VGG16, LPIPS_VGG)
    check_networks(off, NONE)


def test_a_missing_file_is_refused_with_its_place_and_the_way_out(folder: Path):
    put(folder, VGG16)
    with pytest.raises(MissingWeights) as refused:
        check_networks(ON, BOTH)
    text = str(refused.value)
    for part in (
        "the key of this step names the network lpips_vgg (SHA-256 2222222222222222...) of LPIPS",
        "cannot measure with it: weights missing: lpips_v0.1/vgg.pth",
        f"searched {folder}",
        "Get it from github.com/richzhang/PerceptualSimilarity",
        "RTGS_WEIGHTS",
        "Or copy it from the machine that made the plan, or set evaluation.lpips=false",
    ):
        assert part in text


def test_another_file_is_refused(folder: Path):
    put(folder, LPIPS_VGG)
    (folder / VGG16.filename).write_bytes(b"cut short")
    with pytest.raises(WrongWeights, match=r"names the network vgg16 .* is not vgg16-397923af\.pth: SHA-256"):
        check_networks(ON, BOTH)


@pytest.mark.parametrize("key", [NONE, HALF])
def test_networks_that_the_key_does_not_name_are_refused_too(folder: Path, key: tuple[tuple[str, str], ...]):
    """There would be figures in a table that is stored as one without."""
    put(folder, VGG16, LPIPS_VGG)
    with pytest.raises(WrongWeights, match=r"names no network of LPIPS.*has vgg16-397923af\.pth.*measures would be"):
        check_networks(ON, key)
