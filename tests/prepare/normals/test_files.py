"""Which network's file is in force, its digest, and settings out of range."""

from __future__ import annotations

import pytest

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from pipelines.cli.main import main
from rtgs.core.errors import RtgsError
from rtgs.prepare.errors import PrepareError
from rtgs.prepare.masks.networks import file_digest
from rtgs.prepare.normals.adapters import ADAPTERS, NormalAdapter
from rtgs.prepare.normals.make import find_network
from rtgs.prepare.pretrained import REGISTRY, MissingWeights, WrongWeights
from rtgs.prepare.settings import NormalSettings
from tests.prepare import tiny_networks


@pytest.mark.parametrize(
    ("make_settings", "message"),
    [
        (lambda: NormalAdapter(axes=("+x", "+y", "+y")), "must be three of"),
        (lambda: NormalAdapter(fit="crop"), "normals.adapter.fit='crop'"),
        (lambda: NormalSettings(model="dsin"), "did you mean 'dsine'"),
        (lambda: NormalSettings(model="custom"), "needs normals.file"),
        (lambda: NormalSettings(tile=20), "normals.tile=20 must be 0"),
        (lambda: NormalSettings(tile_overlap=0.7), "normals.tile_overlap=0.7"),
        (lambda: find_network(NormalSettings(file="/nowhere/net.onnx")), "does not exist"),
    ],
)
def test_settings_out_of_range_are_refused(make_settings, message):
    with pytest.raises(RtgsError, match=message):
        make_settings()


def test_the_digest_of_the_file_is_checked(tmp_path):
    path = tiny_networks.color_reader(tmp_path / "net.onnx", NormalAdapter())
    _, digest = find_network(NormalSettings(file=str(path)))
    assert find_network(NormalSettings(file=str(path), sha256=digest.upper()))[0] == path
    with pytest.raises(PrepareError, match="it is another file"):
        find_network(NormalSettings(file=str(path), sha256="0" * 64))


def test_noted_digests_are_checked(tmp_path, monkeypatch, capsys):
    """``sha256sum */*.onnx > SHA256SUMS`` in the folder of weights pins what is in it."""
    monkeypatch.setenv("RTGS_WEIGHTS", str(tmp_path))
    path = tiny_networks.color_reader(tmp_path / "normals/dsine.onnx", ADAPTERS["dsine"])
    _, digest = find_network(NormalSettings(model="dsine"))
    sums = tmp_path / "SHA256SUMS"
    sums.write_text(f"{'0' * 64}  sam2/encoder.onnx\n{digest}  normals/dsine.onnx\n")
    assert find_network(NormalSettings(model="dsine"))[1] == file_digest(path) == digest
    sums.write_text(f"{'0' * 64} *./normals/dsine.onnx\n")
    for find in (lambda: find_network(NormalSettings(model="dsine")), lambda: file_digest(path)):
        with pytest.raises(WrongWeights, match=r"dsine.onnx has SHA-256 .*SHA256SUMS beside it says 0000"):
            find()
    assert main(["weights", "status"]) == 0
    assert "SHA256SUMS beside it says 0000000000000000" in capsys.readouterr().out
    sums.write_text("normals/dsine.onnx\n")
    with pytest.raises(WrongWeights, match="is no line of sha256sum"):
        find_network(NormalSettings(model="dsine"))


def test_the_registry_is_one(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("RTGS_WEIGHTS", str(tmp_path))
    tiny_networks.color_reader(tmp_path / "normals/dsine.onnx", ADAPTERS["dsine"])
    assert main(["weights", "status"]) == 0
    shown = capsys.readouterr().out
    for name in ("vgg16", "lpips_vgg", "grounding_dino", "sam2_encoder", "sam2_decoder", *ADAPTERS):
        assert f"\n{name}: " in f"\n{shown}"
        assert REGISTRY[name].filename in shown
    _, digest = find_network(NormalSettings(model="dsine"))
    assert f"not registered, yours is {digest}" in shown
    with pytest.raises(MissingWeights, match=r"weights missing: normals/metric3d.onnx .*Made by"):
        find_network(NormalSettings(model="metric3d"))
