"""Checkpoints: exact, atomic, verified, and clear about what is wrong with them."""

from __future__ import annotations

import contextlib
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rtgs.methods.settings import MethodSettings, TransmittanceSettings, VertexSettings
from rtgs.optics.settings import WallSettings
from rtgs.train import checkpoint as module
from rtgs.train.checkpoint import (
    Checkpoint,
    CheckpointError,
    CheckpointRecord,
    RunSettings,
    adopt_checkpoint,
    canonical_json,
    check_resumable,
    checkpoint_path,
    digest,
    load_checkpoint,
    load_newest,
    save_checkpoint,
)
from rtgs.train.settings import LossSettings, ScheduleSettings

PLAIN = RunSettings(MethodSettings(), ScheduleSettings(), 0)


def make(step: int = 10, settings: RunSettings | None = None) -> Checkpoint:
    text = canonical_json(settings or RunSettings(MethodSettings(), ScheduleSettings(), 0))
    record = CheckpointRecord(
        step,
        digest(text),
        "scene",
        2,
        "avx2",
        (("torch", "2"),),
        1 / 3,
        2 / 3,
        0.1 + 0.2,
        None,
        order_position=4,
        settings=text,
    )
    generator = torch.Generator().manual_seed(step)
    tensors = {
        "method.base.surfels.means": torch.randn(5, 3, generator=generator),
        "method.base.adam.steps": torch.tensor(step),
        "views.generator": generator.get_state(),
        "empty": torch.zeros(0, 2),
        "strided": torch.arange(12.0).reshape(3, 4).T,
    }
    return Checkpoint(record, tensors)


def test_a_checkpoint_is_adopted_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    source = save_checkpoint(tmp_path / "before", make(40))
    folder = tmp_path / "after"

    class Killed(BaseException):
        pass

    def dying(*_arguments):
        raise Killed

    monkeypatch.setattr(module, "_flush", dying)
    with pytest.raises(Killed):
        adopt_checkpoint(source, folder)
    monkeypatch.undo()
    assert load_newest(folder, warn=pytest.fail) is None
    adopted = adopt_checkpoint(source, folder)
    assert adopted == checkpoint_path(folder, 40)
    assert load_checkpoint(adopted).record == load_checkpoint(source).record
    (source / "state.safetensors").write_bytes(b"cut")
    with pytest.raises(CheckpointError, match=r"state\.safetensors is damaged"):
        adopt_checkpoint(source, tmp_path / "third")


def test_round_trip_is_exact(tmp_path: Path):
    written = make()
    read = load_checkpoint(save_checkpoint(tmp_path, written))
    assert read.record == written.record
    assert read.tensors.keys() == written.tensors.keys()
    for name, tensor in written.tensors.items():
        assert read.tensors[name].dtype == tensor.dtype
        assert torch.equal(read.tensors[name], tensor), name


def test_nothing_is_pickled(tmp_path: Path):
    path = save_checkpoint(tmp_path, make())
    assert sorted(part.name for part in path.iterdir()) == ["record.json", "state.safetensors"]
    json.loads((path / "record.json").read_text())


def test_the_newest_two_are_kept_and_no_leftovers(tmp_path: Path):
    (tmp_path / ".writing_killed").mkdir()
    for step in (10, 20, 30, 30):
        save_checkpoint(tmp_path, make(step))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["step_00000020", "step_00000030"]


def test_a_writer_that_dies_at_any_system_call_leaves_a_usable_checkpoint(tmp_path: Path, monkeypatch):
    """Fail at the n-th flush, rename or removal, for every n: what is on disk afterwards always loads."""

    class Killed(BaseException):
        pass

    for countdown in range(1, 9):
        folder = tmp_path / str(countdown)
        save_checkpoint(folder, make(10))
        save_checkpoint(folder, make(20))
        left = countdown

        def dying(function):
            def call(*arguments, **options):
                nonlocal left
                left -= 1
                if left == 0:
                    raise Killed
                return function(*arguments, **options)

            return call

        with monkeypatch.context() as patch:
            patch.setattr(module, "_flush", dying(module._flush))
            patch.setattr(module.os, "rename", dying(module.os.rename))
            patch.setattr(module.shutil, "rmtree", dying(module.shutil.rmtree))
            with contextlib.suppress(Killed):
                save_checkpoint(folder, make(30))
        newest = load_newest(folder, warn=pytest.fail)
        assert newest is not None
        assert newest.record.step in (20, 30)
        save_checkpoint(folder, make(40))
        assert not list(folder.glob(".writing_*"))


@pytest.mark.parametrize("damage", ["truncated", "flipped", "record", "missing", "format"])
def test_a_damaged_newest_checkpoint_is_named_and_the_one_before_is_taken(tmp_path: Path, damage: str):
    save_checkpoint(tmp_path, make(10))
    path = save_checkpoint(tmp_path, make(20))
    tensors, record = path / "state.safetensors", path / "record.json"
    content = tensors.read_bytes()
    expected = {
        "truncated": "state.safetensors is damaged",
        "flipped": "state.safetensors is damaged",
        "record": "record.json is damaged",
        "missing": "state.safetensors is missing",
        "format": "format 99, this version reads 1",
    }[damage]
    if damage == "truncated":
        tensors.write_bytes(content[: len(content) // 2])
    elif damage == "flipped":
        tensors.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    elif damage == "record":
        record.write_text(record.read_text()[:40])
    elif damage == "missing":
        tensors.unlink()
    else:
        record.write_text(record.read_text().replace('"format": 1', '"format": 99'))
    with pytest.raises(CheckpointError, match=expected):
        load_checkpoint(path)
    warnings: list[str] = []
    newest = load_newest(tmp_path, warn=warnings.append)
    assert newest is not None
    assert newest.record.step == 10
    assert len(warnings) == 1
    assert expected in warnings[0]
    (checkpoint_path(tmp_path, 10) / "record.json").unlink()
    with pytest.raises(CheckpointError, match="no usable checkpoint among 2"):
        load_newest(tmp_path, warn=lambda _: None)


def test_no_checkpoint_is_no_error(tmp_path: Path):
    assert load_newest(tmp_path / "absent", warn=pytest.fail) is None


def test_a_list_among_the_settings_that_are_new_counts_as_its_default():
    record = make(settings=PLAIN).record
    old = json.loads(record.settings)
    assert old["method"]["transmittance"]["wall"].pop("tint") == [1.0, 1.0, 1.0]
    before = replace(record, settings=json.dumps(old, sort_keys=True), settings_digest="another")
    check_resumable(before, record, PLAIN, warn=pytest.fail)
    wall = WallSettings(tint=(0.5, 1.0, 1.0))
    tinted = replace(PLAIN, method=replace(PLAIN.method, transmittance=TransmittanceSettings(wall=wall)))
    with pytest.raises(CheckpointError, match=r"wall\.tint\.0: 1\.0 then, 0\.5 now"):
        check_resumable(before, make(settings=tinted).record, tinted, warn=pytest.fail)


def test_other_settings_are_refused_by_key():
    base = RunSettings(MethodSettings(), ScheduleSettings(), 0)
    other = replace(base, method=replace(base.method, loss=LossSettings(l1=0.5)), seed=1)
    with pytest.raises(CheckpointError, match=r"method\.loss\.l1: 0\.8 then, 0\.5 now; seed: 0 then, 1 now"):
        check_resumable(make(settings=base).record, make(settings=other).record, base, warn=pytest.fail)


def test_a_setting_that_is_new_since_the_checkpoint_counts_as_its_default():
    record = make(settings=RunSettings(MethodSettings(), ScheduleSettings(), 0)).record
    old = json.loads(record.settings)
    assert old["method"]["optics"].pop("blend") == "srgb"
    before = replace(record, settings=json.dumps(old, sort_keys=True), settings_digest="another")
    check_resumable(before, record, PLAIN, warn=pytest.fail)
    check_resumable(record, before, PLAIN, warn=pytest.fail)
    other = replace(record, settings=record.settings.replace('"srgb"', '"linear"'), settings_digest="a third")
    with pytest.raises(CheckpointError, match=r"method\.optics\.blend: srgb then, linear now"):
        check_resumable(before, other, PLAIN, warn=pytest.fail)
    del old["method"]["optics"]["weight"]
    with pytest.raises(CheckpointError, match=r"method\.optics\.weight: None then"):  # not marked as a later one
        check_resumable(replace(before, settings=json.dumps(old)), record, PLAIN, warn=pytest.fail)


def test_a_group_of_settings_that_is_new_counts_as_its_default_too():
    record = make(settings=RunSettings(MethodSettings(), ScheduleSettings(), 0)).record
    values = json.loads(record.settings)
    assert "vertices" not in values["method"]["transmittance"] or values["method"]["transmittance"].pop("vertices")
    before = replace(record, settings=json.dumps(values, sort_keys=True), settings_digest="another")
    check_resumable(before, record, PLAIN, warn=pytest.fail)
    moving = replace(MethodSettings().transmittance, normal="mesh", vertices=VertexSettings(rate=0.03))
    other = RunSettings(MethodSettings(transmittance=moving), PLAIN.schedule, PLAIN.seed)
    with pytest.raises(CheckpointError, match=r"transmittance\.vertices\.rate: 0\.0 then, 0\.03 now"):
        check_resumable(before, make(settings=other).record, other, warn=pytest.fail)


def test_another_scene_is_refused():
    record = make().record
    with pytest.raises(CheckpointError, match="another scene or resolution"):
        check_resumable(record, replace(record, scene_digest="else"), PLAIN, warn=pytest.fail)


def test_another_machine_is_a_warning():
    record = make().record
    warnings: list[str] = []
    check_resumable(record, record, PLAIN, warn=warnings.append)
    assert warnings == []
    check_resumable(
        record, replace(record, threads=1, isa="avx512", versions=(("torch", "3"),)), PLAIN, warn=warnings.append
    )
    assert len(warnings) == 1
    for part in ("threads: 2 then, 1 now", "instruction set: avx2 then, avx512 now", "torch: 2 then, 3 now"):
        assert part in warnings[0]
