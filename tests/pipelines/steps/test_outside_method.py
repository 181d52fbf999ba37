"""A method from outside the package: one module, one YAML file, trained through ``rtgs run`` (docs/new_method.md)."""

from __future__ import annotations

import re
import sys
from importlib import metadata
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from pipelines.cli.main import main
from pipelines.planning.graph import build_graph
from rtgs.config import compose
from rtgs.core.errors import RtgsError
from rtgs.methods import create_method, find_method, method_names
from rtgs.methods.settings import MethodSettings
from rtgs.runs.training import stage_params
from rtgs.train.guard import TrainingDiverged
from rtgs.train.method import Stage
from rtgs.train.parameters import ParameterGroup
from rtgs.train.seeds import generator_for
from rtgs.train.settings import LossSettings
from rtgs.train.trainer import Trainer
from tests.pipelines.app_cases import QUICK, _in_root, capture, root  # noqa: F401  (fixtures)
from tests.train.training_cases import small_scene, small_schedule

EXAMPLE = Path(__file__).parents[3] / "examples" / "new_method"
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


def own(**values: object) -> MethodSettings:
    return MethodSettings(name=NAME, own=values, loss=LossSettings(normal=0.0))


def test_it_has_settings_of_its_own(on_path):
    method = create_method(own(rate=0.5, near_one=0), small_scene(), small_schedule(30), generator_for(3, "x"))
    (group,) = method.groups
    assert isinstance(group, ParameterGroup)
    assert group.rate.at(0) == 0.5
    assert "exposure" not in [term.name for term in method.loss.terms]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"rte": 0.1}, r"method\.own\.rte is no key: method\.own has rate, near_one; did you mean rate\?"),
        ({"rate": "fast"}, r"method\.own\.rate='fast' must be a number"),
        ({"rate": True}, r"method\.own\.rate=True must be a number"),
    ],
)
def test_settings_it_does_not_have_are_refused(on_path, values: dict[str, object], message: str):
    with pytest.raises(RtgsError, match=message):
        find_method(NAME).own_settings(own(**values))


def test_a_method_without_settings_of_its_own_refuses_any():
    with pytest.raises(RtgsError, match=r"method\.own\.rate: method 2dgs has no settings of its own"):
        create_method(
            MethodSettings(name="2dgs", own={"rate": 1.0}), small_scene(), small_schedule(30), generator_for(3, "x")
        )


def test_its_settings_are_checked_before_anything_runs(capture: Path, on_path):  # noqa: F811
    words = ["scene=capture", f"scene.path={capture}", "preset=smoke", f"method.name='{NAME}'", "method=2dgs"]
    with pytest.raises(RtgsError, match=r"method\.own\.rate='fast' must be a number"):
        compose([*words, "+method.own.rate=fast"])
    slow, fast = (
        build_graph(*compose([*words, f"+method.own.rate={rate}"])).training[0].fingerprint for rate in (0.01, 0.02)
    )
    assert slow != fast
    plain, stated, whole = (
        build_graph(*compose([*words, *more])).training[0].fingerprint
        for more in ((), ("+method.own.near_one=0.1",), ("+method.own.rate=1",))
    )
    assert stated == plain, "a default that is stated"
    assert whole == build_graph(*compose([*words, "+method.own.rate=1.0"])).training[0].fingerprint


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
        ("2dgz", "choose one of 2dgs, 3dgs, 3dgs_dr, gaussian_shader, .*did you mean 2dgs"),
    ],
)
def test_what_is_no_method_is_refused(on_path, name: str, message: str):
    with pytest.raises((ValueError, RtgsError), match=message):
        find_method(name)


def test_an_entry_point_gives_it_a_plain_name(on_path, monkeypatch: pytest.MonkeyPatch):
    declared = metadata.EntryPoint("exposure", NAME, "rtgs.methods")
    monkeypatch.setattr(metadata, "entry_points", lambda group: [declared] if group == "rtgs.methods" else [])
    assert find_method("exposure").name == "exposure"
    assert method_names()[-2:] == ("rtgs_printed", "exposure")
