"""LPIPS: the loading code and the maths, on small random weights; the published heads when they are at hand."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from rtgs.pretrained import weights as pretrained
from rtgs.pretrained.lpips import InputRange, Lpips, lpips
from rtgs.pretrained.vgg import BLOCKS, VGG16_WIDTHS, Vgg16Features
from rtgs.pretrained.weights import MissingWeights, WrongWeights

TINY = (3, 4, 5, 6, 7)


def vgg_tensors(widths: tuple[int, ...], seed: int = 0) -> dict[str, torch.Tensor]:
    """A random state dict of VGG-16's layout, with an ignored classifier entry."""
    generator = torch.Generator().manual_seed(seed)
    tensors = {"classifier.0.weight": torch.zeros(2, 2)}
    channels = 3
    for width, block in zip(widths, BLOCKS):
        for position in block:
            std = (2 / (9 * channels)) ** 0.5
            tensors[f"features.{position}.weight"] = std * torch.randn(width, channels, 3, 3, generator=generator)
            tensors[f"features.{position}.bias"] = 0.1 * torch.randn(width, generator=generator)
            channels = width
    return tensors


def head_tensors(widths: tuple[int, ...], seed: int = 1) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {f"lin{k}.model.1.weight": torch.rand(1, width, 1, 1, generator=generator) for k, width in enumerate(widths)}


@pytest.fixture
def tiny_files(tmp_path: Path) -> tuple[Path, Path]:
    torch.save(vgg_tensors(TINY), tmp_path / "vgg.pth")
    torch.save(head_tensors(TINY), tmp_path / "heads.pth")
    return tmp_path / "vgg.pth", tmp_path / "heads.pth"


def image_pair(size: int = 37) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(9)
    target = torch.rand(3, size, size + 6, generator=generator)
    return (target + 0.2 * torch.randn(target.shape, generator=generator)).clamp(0, 1), target


def relu_features(image: np.ndarray, tensors: dict[str, torch.Tensor]) -> list[np.ndarray]:
    """VGG activations by loops over the nine taps, numpy only."""
    hidden, result = image, []
    for index, block in enumerate(BLOCKS):
        if index:
            channels, height, width = hidden.shape
            cut = hidden[:, : height // 2 * 2, : width // 2 * 2]
            hidden = cut.reshape(channels, height // 2, 2, width // 2, 2).max(axis=(2, 4))
        for position in block:
            weight = tensors[f"features.{position}.weight"].double().numpy()
            bias = tensors[f"features.{position}.bias"].double().numpy()
            height, width = hidden.shape[1:]
            padded = np.pad(hidden, ((0, 0), (1, 1), (1, 1)))
            total = np.zeros((weight.shape[0], height, width)) + bias[:, None, None]
            for dy in range(3):
                for dx in range(3):
                    total += np.tensordot(weight[:, :, dy, dx], padded[:, dy : dy + height, dx : dx + width], axes=1)
            hidden = np.maximum(total, 0)
        result.append(hidden)
    return result


def independent_lpips(image: torch.Tensor, target: torch.Tensor, minus_one: bool) -> float:
    """LPIPS by its definition: unit channel vectors, squared difference, head weights, mean over pixels, sum."""
    vgg, heads = vgg_tensors(TINY), head_tensors(TINY)
    features = []
    for picture in (image, target):
        array = picture.double().numpy()
        array = 2 * array - 1 if minus_one else array
        array = (array - np.array([-0.030, -0.088, -0.188])[:, None, None]) / np.array([0.458, 0.448, 0.450])[
            :, None, None
        ]
        features.append(relu_features(array, vgg))
    total = 0.0
    for k, (a, b) in enumerate(zip(*features)):
        a = a / (np.linalg.norm(a, axis=0, keepdims=True) + 1e-10)
        b = b / (np.linalg.norm(b, axis=0, keepdims=True) + 1e-10)
        head = heads[f"lin{k}.model.1.weight"].double().numpy().reshape(-1, 1, 1)
        total += float(((a - b) ** 2 * head).sum(0).mean())
    return total


@pytest.mark.parametrize("input_range", list(InputRange))
def test_agrees_with_an_independent_computation(tiny_files, input_range: InputRange) -> None:
    model = Lpips.load(*tiny_files)
    image, target = image_pair()
    expected = independent_lpips(image, target, input_range is InputRange.MINUS_ONE_ONE)
    assert lpips(model, image, target, input_range) == pytest.approx(expected, rel=1e-4)


def test_conventions_differ_and_identity_is_zero(tiny_files) -> None:
    model = Lpips.load(*tiny_files)
    image, target = image_pair()
    values = [lpips(model, image, target, convention) for convention in InputRange]
    assert values[0] != pytest.approx(values[1], rel=1e-2)
    assert lpips(model, target, target, InputRange.ZERO_ONE) == 0.0


def test_masked_is_the_mean_of_the_spatial_map(tiny_files) -> None:
    model = Lpips.load(*tiny_files)
    image, target = image_pair(48)
    image[:, :, 24:] = target[:, :, 24:]  # only the left half is wrong
    left = torch.zeros(48, 54, dtype=torch.bool)
    left[:, :20] = True
    convention = InputRange.MINUS_ONE_ONE
    inside = lpips(model, image, target, convention, mask=left)
    spatial = model.spatial(image, target, convention)
    assert spatial.shape == (48, 54)
    assert inside == pytest.approx(float(spatial[left].mean()))
    assert inside > lpips(model, image, target, convention) > lpips(model, image, target, convention, mask=~left)


def test_is_differentiable_where_features_vanish(tiny_files) -> None:
    model = Lpips.load(*tiny_files)
    image, target = image_pair()
    image[:, :20] = 0
    image.requires_grad_(True)
    model(image, target).backward()
    assert image.grad is not None
    assert torch.isfinite(image.grad).all()
    assert image.grad.abs().max() > 0


def test_safetensors_give_the_same_features(tmp_path: Path, tiny_files) -> None:
    save_file(vgg_tensors(TINY), tmp_path / "vgg.safetensors")
    image, target = image_pair()
    from_safetensors = Lpips.load(tmp_path / "vgg.safetensors", tiny_files[1])
    assert torch.equal(from_safetensors(image, target), Lpips.load(*tiny_files)(image, target))


def test_wrong_checkpoints_are_named(tmp_path: Path, tiny_files) -> None:
    tensors = vgg_tensors(TINY)
    del tensors["features.12.bias"]
    with pytest.raises(WrongWeights, match=r"features\.12\.bias"):
        Vgg16Features(tensors, "here.pth")
    with pytest.raises(WrongWeights, match=r"features\.5 has weight"):
        Vgg16Features({**vgg_tensors(TINY), "features.5.weight": torch.zeros(4, 9, 3, 3)})
    with pytest.raises(WrongWeights, match=r"lin2\.model\.1\.weight"):
        Lpips(Vgg16Features(vgg_tensors(TINY)), head_tensors((3, 4, 9, 6, 7)))
    (tmp_path / "torn.pth").write_bytes(tiny_files[0].read_bytes()[:1000])
    with pytest.raises(WrongWeights, match=r"torn\.pth is not a readable checkpoint"):
        Lpips.load(tmp_path / "torn.pth", tiny_files[1])


class Surprise:
    """Not a tensor: must not be unpickled."""


def test_only_tensors_are_unpickled(tmp_path: Path, tiny_files) -> None:
    torch.save({"features.0.weight": Surprise()}, tmp_path / "code.pth")
    with pytest.raises(WrongWeights, match="not a readable checkpoint"):
        Lpips.load(tmp_path / "code.pth", tiny_files[1])


def test_small_images_are_refused(tiny_files) -> None:
    image, target = image_pair(12)
    with pytest.raises(ValueError, match="H, W >= 16"):
        lpips(Lpips.load(*tiny_files), image, target, InputRange.ZERO_ONE)


def test_missing_weights_say_where_to_get_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pretrained, "weight_folders", lambda: (tmp_path / "nowhere",))
    with pytest.raises(MissingWeights, match=r"vgg16-397923af\.pth.*RTGS_WEIGHTS"):
        Lpips.load()
    report = pretrained.weights_report()
    assert [status.path for status in report] == [None] * len(pretrained.REGISTRY)
    assert all("weights missing" in status.problem for status in report)


@pytest.mark.parametrize("variable", ["TORCH_HOME", "XDG_CACHE_HOME", None])
def test_torchs_own_cache_is_found_without_asking_torch(
    variable: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("TORCH_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    if variable:
        monkeypatch.setenv(variable, str(tmp_path))
    monkeypatch.setattr(torch.hub, "_hub_dir", None)
    assert pretrained.weight_folders()[-1] == Path(torch.hub.get_dir()) / "checkpoints"


def test_search_order_and_verification(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RTGS_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("RTGS_SHARED", str(tmp_path / "shared"))
    assert pretrained.weight_folders()[0] == tmp_path
    with pytest.raises(MissingWeights, match=r"searched \$RTGS_WEIGHTS, .*\$RTGS_(WEIGHTS/shared|SHARED)/data/weights"):
        pretrained.find_weights(pretrained.VGG16, pretrained.weight_folders())
    (tmp_path / pretrained.VGG16.filename).write_bytes(b"another file")
    assert pretrained.find_weights(pretrained.VGG16) == tmp_path / pretrained.VGG16.filename
    with pytest.raises(WrongWeights, match="SHA-256"):
        pretrained.verify_weights(pretrained.VGG16, tmp_path / pretrained.VGG16.filename)
    status = pretrained.weights_report()[0]
    assert status.path is not None
    assert "is not vgg16-397923af.pth" in status.problem


def shared_heads() -> Path | None:
    shared = Path(os.environ.get("RTGS_SHARED", Path(__file__).resolve().parents[3] / "shared"))
    path = shared / "data" / "weights" / pretrained.LPIPS_VGG.filename
    return path if path.is_file() else None


@pytest.mark.skipif(shared_heads() is None, reason="the published LPIPS heads are not on this machine")
def test_published_heads_fit_the_real_widths() -> None:
    path = shared_heads()
    assert path is not None
    pretrained.verify_weights(pretrained.LPIPS_VGG, path)
    model = Lpips(Vgg16Features(vgg_tensors(VGG16_WIDTHS)), pretrained.read_tensors(path), str(path))
    image, target = image_pair(32)
    near, far = (lpips(model, target + step * (image - target), target, InputRange.ZERO_ONE) for step in (0.1, 1.0))
    assert 0 < near < far
