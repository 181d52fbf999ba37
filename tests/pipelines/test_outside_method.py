"""A method from outside the package: one module, one YAML file, trained through ``rtgs run`` (docs/new_method.md)."""

from __future__ import annotations

import re
import sys
from importlib import metadata
from pathlib import Path

import pytest
import torch
from app_cases import QUICK, _in_root, capture, root  # noqa: F401  (fixtures)
from safetensors.torch import load_file
from training_cases import small_scene, small_schedule

from pipelines.cli.main import main
from pipelines.planning.graph import build_graph
from pipelines.steps.training import stage_params
from rtgs.config import compose
from rtgs.core.errors import RtgsError
from rtgs.methods import create_method, find_method, method_names
from rtgs.methods.settings import MethodSettings
from rtgs.train.guard import TrainingDiverged
from rtgs.train.method import Stage
from rtgs.train.parameters import ParameterGroup
from rtgs.train.seeds import generator_for
from rtgs.train.settings import LossSettings
from rtgs.train.trainer import Trainer

EXAMPLE = Path(__file__).parents[2] / "examples" / "new_method"
NAME = "exposure_method:SPEC"


@pytest.fixture
def on_path(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(EXAMPLE))
    yield
    sys.modules.pop("exposure_method", None)


def trainer(folder: Path | None = None) -> Trainer:
    settings = MethodSettings(name=NAME, loss=LossSettings(normal=0.0))
    method = create_method(settings, small_scene(), small_schedule(30), generator_for(3, "initialise"))
    return Trainer(method, small_scene(), seed=3, checkpoint_dir=folder)


def test_it_trains_through_the_command_line(root: Path, capture: Path, on_path, capsys):  # noqa: F811
    words = ["run", "--config-dir", str(EXAMPLE / "conf"), f"scene={capture}", "method=exposure", *QUICK]
    assert main(words) == 0
    assert re.search(r"\bexposure\b.*\d dB", capsys.readouterr().out)
    folders = [path.parent for path in (root / "store" / "train_diffuse").glob("*/*/manifest.json")]
    (made,) = [folder for folder in folders if stage_params(folder).method.name == NAME]
    tensors = load_file(made / "checkpoint" / "state.safetensors")
    gain = tensors["method.exposure.values.gain"]
    assert gain.shape == (3,)
    assert not torch.equal(gain, torch.ones(3))
    assert int(tensors["method.exposure.adam.steps"]) == stage_params(made).until
    assert main(words) == 0
    assert "nothing to do" in capsys.readouterr().err


def test_a_change_of_its_module_trains_again(capture: Path, tmp_path: Path, monkeypatch):  # noqa: F811
    module = tmp_path / "exposure_method.py"
    monkeypatch.syspath_prepend(str(tmp_path))
    words = ["scene=capture", f"scene.path={capture}", "preset=smoke", f"method.name='{NAME}'", "method=2dgs"]
    found = []
    for text in ("", "# another word\n"):
        module.write_text((EXAMPLE / module.name).read_text() + text)
        sys.modules.pop("exposure_method", None)
        found.append(build_graph(*compose(words)).training[0].fingerprint)
    sys.modules.pop("exposure_method", None)
    assert found[0] != found[1]


def test_its_group_resumes_bit_for_bit(on_path, tmp_path: Path):
    whole = trainer()
    whole.run()
    first = trainer(tmp_path)
    first.stage = Stage("diffuse", 0, 15)  # as killed at a checkpoint
    first.run()
    again = trainer(tmp_path)
    assert again.run().resumed_from == 15
    ours, theirs = whole.method.state(), again.method.state()
    assert ours.keys() == theirs.keys()
    assert "exposure.adam.first.gain" in ours
    for name, tensor in ours.items():
        assert torch.equal(tensor, theirs[name]), name


def test_a_bad_gradient_of_its_group_stops_training_and_is_named(on_path):
    broken = trainer()
    (group,) = broken.method.groups
    assert isinstance(group, ParameterGroup)
    group["gain"].register_hook(lambda gradient: torch.full_like(gradient, float("nan")))
    with pytest.raises(TrainingDiverged, match=r"set exposure, gradient of gain: 3 rows not finite"):
        broken.run()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nowhere:SPEC", "names nowhere:SPEC, which does not import"),
        ("exposure_method:build", "is a function, not a rtgs.methods.MethodSpec"),
        ("2dgz", "choose one of 2dgs, 3dgs, envgs, rtgs.*did you mean 2dgs"),
    ],
)
def test_what_is_no_method_is_refused(on_path, name: str, message: str):
    with pytest.raises((ValueError, RtgsError), match=message):
        find_method(name)


def test_an_entry_point_gives_it_a_plain_name(on_path, monkeypatch: pytest.MonkeyPatch):
    declared = metadata.EntryPoint("exposure", NAME, "rtgs.methods")
    monkeypatch.setattr(metadata, "entry_points", lambda group: [declared] if group == "rtgs.methods" else [])
    assert find_method("exposure").name == "exposure"
    assert method_names() == ("2dgs", "3dgs", "envgs", "rtgs", "exposure")
