from __future__ import annotations

import dataclasses
import shutil
import subprocess
import sys
from collections.abc import Sequence
from itertools import cycle, product
from pathlib import Path

import cloudpickle
import pytest
import yaml
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from recipes import TRAINED, fitting, presets_of, scenes_of

from rtgs.config import RunConfig, compose
from rtgs.config.convert import derive_name, to_run_config
from rtgs.config.explain import explain
from rtgs.config.locate import choices_of, conf_dir
from rtgs.config.opened import VERSION_BASE
from rtgs.config.schema import Choices, open_schema, register_schema
from rtgs.config.sweep import compose_jobs
from rtgs.core.build import build
from rtgs.core.errors import RtgsError
from rtgs.evaluate.tables import PAPER_SCORES
from rtgs.train.settings import ScheduleSettings
from rtgs.workflow.fingerprint import fingerprint

SCENES = [name for name in choices_of("scene") if name != "capture"]


@pytest.fixture
def conf_copy(tmp_path, monkeypatch) -> Path:
    """A copy of conf/ that a test may spoil."""
    shutil.copytree(conf_dir(), tmp_path / "conf")
    monkeypatch.setattr("rtgs.config.opened.conf_dir", lambda: tmp_path / "conf")
    return tmp_path / "conf"


def message(*overrides: str) -> str:
    with pytest.raises((HydraException, RtgsError)) as raised:
        compose(overrides)
    return explain(raised.value) if isinstance(raised.value, HydraException) else str(raised.value)


def test_defaults_are_the_schema_and_the_chosen_files():
    config, choices = compose([])
    assert (choices.method, choices.preset, choices.ablation) == ("rtgs", "quick", "none")
    assert config.name == "ball_statue-rtgs-quick"
    assert config.scene.path == "embedded:ball_statue"
    assert Path(config.paths.root).is_absolute()
    assert isinstance(config.scene.background, tuple)


def test_the_schema_has_the_defaults_of_the_dataclasses():
    plain = OmegaConf.to_container(OmegaConf.structured(open_schema(RunConfig)))
    assert isinstance(plain, dict)
    assert build(RunConfig, plain) == RunConfig()  # pyright: ignore[reportArgumentType]


def test_the_schema_goes_to_other_processes_by_name():
    """Launchers such as joblib's pickle the composed config; a copied class would not know its own defaults."""
    code = (
        "import sys, pickle; from omegaconf import OmegaConf\n"
        "config = pickle.load(sys.stdin.buffer)\n"
        "print(OmegaConf.structured(OmegaConf.get_type(config.scene)).split_every, config.seed)"
    )
    config = OmegaConf.structured(open_schema(RunConfig))
    config.seed = 3
    done = subprocess.run([sys.executable, "-c", code], input=cloudpickle.dumps(config), capture_output=True)
    assert done.stdout.decode().split() == [str(RunConfig().scene.split_every), "3"], done.stderr.decode()
    with pytest.raises(AttributeError, match="no_such"):
        _ = sys.modules[open_schema.__module__].no_such


def test_the_command_line_wins_over_files_and_preset():
    config, choices = compose(["scene=fox", "method=2dgs", "schedule.total=33", "scene.long_side=64", "seed=3"])
    assert (config.schedule.total, config.scene.long_side, config.seed) == (33, 64, 3)
    assert config.name == "fox-2dgs-quick-seed3-scene.long_side_64-schedule.total_33"
    assert choices.overrides == ("schedule.total=33", "scene.long_side=64", "seed=3")


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("method.los.l1=3", ["Key 'los' not in 'MethodSettings'", "method.los", "Did you mean method.loss"]),
        ("metod=2dgs", ["metod", "Did you mean method"]),
        ("schedule.totl=3", ["schedule.totl", "Did you mean schedule.total"]),
        ("method.loss.l1=abc", ["'abc' of type 'str' could not be converted to Float", "method.loss.l1"]),
        ("schedule.total=1.5", ["schedule.total", "Integer"]),
        ("scene=nope", ["scene/nope", "fox", "scene=/path/to/capture"]),
        ("preset=smoek", ["preset/smoek", "Did you mean smoke?"]),
        ("+foo=3", ["no key foo"]),
        ("seed=[1", ["'seed=[1' is not a legal override", "quotes"]),
        ("scene.format=colmp", ["scene.format='colmp'", "did you mean 'colmap'"]),
    ],
)
def test_a_mistake_on_the_command_line_is_named(override, expected):
    text = message(override)
    for part in expected:
        assert part in text


@pytest.mark.parametrize(
    ("group", "content", "expected"),
    [
        ("method", "name: 2dgs\nlos:\n  l1: 1.0\n", ["method/spoilt", "'los'", "Did you mean method.loss"]),
        ("method", "name: 2dgs\nloss:\n  l1: much\n", ["method/spoilt", "'much'", "method.loss.l1"]),
        ("ablation", "# @package _global_\nmethod:\n  lossy: 1\n", ["ablation/spoilt", "'lossy'"]),
        ("experiment", "# @package _global_\nseedd: 3\n", ["experiment/spoilt", "'seedd'", "Did you mean seed"]),
        ("scene", "name: x\npath: y\nlong_side: wide\n", ["scene/spoilt", "'wide'", "scene.long_side"]),
    ],
)
def test_a_mistake_in_a_file_names_file_and_key(conf_copy, group, content, expected):
    (conf_copy / group).mkdir(exist_ok=True)
    (conf_copy / group / "spoilt.yaml").write_text(content)
    text = message(f"{group}=spoilt")
    for part in expected:
        assert part in text


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("mesh.source=hul", "mesh.source='hul' is unknown: choose one of auto, hull, tsdf, given; did you mean 'hull'"),
        ("mesh.of=objct", "mesh.of='objct' is unknown: choose one of object, scene; did you mean 'object'"),
        ("mesh.object.flat=maybe", "mesh.object.flat='maybe' is unknown: choose one of auto, yes, no"),
        ("mesh.object.hull.voxels=0", "mesh.object.hull.voxels=0 must be at least 8"),
        ("mesh.object.hull.min_seen=2.0", "mesh.object.hull.min_seen=2.0 must be between 0 and 1"),
        ("mesh.object.hull.trim_cost=-1", "mesh.object.hull.trim_cost=-1.0 must be a finite number of at least 0"),
        ("mesh.object.pane.agree=2", "mesh.object.pane.agree=2.0 must be between 0 and 1"),
        ("mesh.object.tsdf_accept=5", "mesh.object.tsdf_accept=5.0 must be between 0 and 1"),
        ("mesh.object.tsdf_pieces=0", "mesh.object.tsdf_pieces=0 must be at least 1"),
        ("mesh.tsdf.truncation_voxels=0", "mesh.tsdf.truncation_voxels=0.0 must be above 0"),
        ("mesh.tsdf.max_blocks=0", "mesh.tsdf.max_blocks=0 must be at least 1"),
    ],
)
def test_a_choice_of_the_mesh_is_checked_before_anything_is_trained(word, expected):
    with pytest.raises(ValueError, match=expected):
        compose([word])


@pytest.mark.parametrize("name", ["../elsewhere", "a/b", "..", "/tmp/run"])
def test_a_run_stays_in_its_folder(name):
    with pytest.raises(RtgsError, match="one folder in runs/"):
        compose([f"name={name}"])


def test_a_missing_folder_of_photos_is_asked_for():
    assert "scene.path is empty" in message("scene=capture")


def test_key_order_and_spelling_in_a_file_do_not_matter(conf_copy):
    method = yaml.safe_load((conf_copy / "method" / "2dgs.yaml").read_text())
    method["optimizer"] = {"eps": 1e-15, "sh_dc": 2.5e-3}
    turned = {key: method[key] for key in reversed(method)}
    text = yaml.safe_dump(turned, sort_keys=False).replace("sh_dc: 0.0025", "sh_dc: 25.0e-4")
    assert "25.0e-4" in text
    (conf_copy / "method" / "turned.yaml").write_text(text)
    words = ["scene=fox", "preset=smoke"]  # which has no file of its own for 2dgs
    plain, turned_config = (compose([*words, f"method={name}"])[0] for name in ("2dgs", "turned"))
    assert fingerprint(plain.method) == fingerprint(turned_config.method)


def test_interpolations_are_gone_after_conversion():
    config, _ = compose(["preset=paper", "method=2dgs", "schedule.total=77"])
    assert config.schedule == dataclasses.replace(config.method.paper_schedule, total=77)


def test_the_paper_preset_takes_every_key_of_the_schedule():
    listed = yaml.safe_load((conf_dir() / "preset" / "paper.yaml").read_text())["schedule"]
    keys = [field.name for field in dataclasses.fields(ScheduleSettings)]
    assert listed == {key: f"${{method.paper_schedule.{key}}}" for key in keys}


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("/data/my scene", "my_scene"),
        ("/data/kitchen/images", "kitchen"),
        ("/data/kitchen/sparse/0", "kitchen"),
        ("embedded:room", "room"),
        ("/", "scene"),
    ],
)
def test_a_scene_is_named_after_its_folder(path, name):
    assert derive_name(path) == name


def test_scenes_share_nothing_with_methods_and_ablations():
    """Every scene composes; of the other files only presets touch a scene, and of it only its size.

    Scenes and methods set nothing but their own keys (tests below), so a scene adds to method x preset x ablation
    nothing but its own part with the size of the preset, and what a method has on it (test_published_scenes.py).
    """
    for group in ("preset", "ablation"):
        for name in choices_of(group):
            content = yaml.safe_load((conf_dir() / group / f"{name}.yaml").read_text())
            assert set(content.get("scene", {})) <= ({"long_side", "background"} if group == "preset" else set()), name
    for job in compose_jobs([f"scene={','.join(SCENES)}", "preset=smoke,paper"], multirun=True)[0]:
        assert job.choices is not None, job.problem
        assert job.choices.scene


@pytest.mark.slow
def test_the_whole_product_composes():
    """Method x scene x preset x ablation, every combination a config of its own.

    Hydra composes method x preset x ablation and scene x preset; the scene's part is put into each of the former and
    the whole converted again. For some combinations, every file among them, Hydra composes all of it beside.
    """
    methods, presets, ablations = (choices_of(group) for group in ("method", "preset", "ablation"))
    combinations = list(product(methods, presets, ablations))
    of = raw_configs("method preset ablation", combinations)
    scenes = raw_configs("scene preset", list(product(SCENES, presets)))
    beside, names = beside_hydra(), set()
    refused: dict[tuple[str, ...], str] = {}
    for (method, preset, ablation), composed in of.items():
        for scene in SCENES:
            key = (scene, method, preset, ablation)
            composed.scene = scenes[scene, preset].scene
            choices = Choices(scene_file=scene, method=method, preset=preset, ablation=ablation)
            try:
                config, choices = to_run_config(composed, choices)
            except RtgsError as error:
                refused[key] = str(error)
                continue
            names.add((scene, config.name))
            if key in beside:
                whole, chosen = compose(words_of("scene method preset ablation", key))
                assert chosen == choices
                assert whole == config or (preset == "paper" and scene in scenes_of(method))
    assert len(names) + len(refused) == len(combinations) * len(SCENES)
    for (_, method, _, ablation), problem in refused.items():
        told = (f"ablation={ablation} takes nothing away from", "nothing of method")
        assert f"method {method}" in problem
        assert any(each in problem for each in told)
    assert {key[1:] for key in refused} == {key for key in combinations if not fits(*key)}


def fits(method: str, preset: str, ablation: str) -> bool:
    """The preset has something of the method, and the ablation takes something away from it."""
    if preset.startswith("paper_") and (method not in TRAINED or preset not in presets_of(method)):
        return False
    return ablation == "none" or (method in TRAINED and ablation in fitting(method, preset))


def beside_hydra() -> set[tuple[str, ...]]:
    """Combinations among which every file comes up, and every method with every ablation that is for it."""
    scenes, presets = cycle(SCENES), cycle(choices_of("preset"))
    pairs = product(choices_of("method"), choices_of("ablation"))
    found = {(next(scenes), method, next(presets), name) for method, name in pairs}
    return {key for key in found if fits(*key[1:])}


def words_of(groups: str, names: Sequence[str]) -> list[str]:
    """``group=name`` of each."""
    return [f"{group}={name}" for group, name in zip(groups.split(), names, strict=True)]


def raw_configs(groups: str, keys: Sequence[tuple[str, ...]]) -> dict[tuple[str, ...], DictConfig]:
    """What Hydra composes for each choice of files, before it is converted."""
    register_schema()
    with initialize_config_dir(str(conf_dir()), version_base=VERSION_BASE):
        found = {key: hydra_compose("config", overrides=words_of(groups, key)) for key in keys}
    for composed in found.values():
        OmegaConf.set_readonly(composed, False)
    return found


@pytest.mark.parametrize("experiment", choices_of("experiment"))
def test_experiments_compose(experiment):
    _, choices = compose([f"experiment={experiment}"])
    assert choices.experiment == experiment


@pytest.mark.parametrize("method", choices_of("method"))
def test_a_method_sets_no_keys_but_its_own(method):
    assert "@package" not in (conf_dir() / "method" / f"{method}.yaml").read_text()


@pytest.mark.parametrize("scene", SCENES)
def test_a_scene_sets_no_keys_but_its_own(scene):
    text = (conf_dir() / "scene" / f"{scene}.yaml").read_text()
    assert "@package" not in text
    assert {"name", "path"} <= set(yaml.safe_load(text))


EXPERIMENTS = choices_of("experiment")


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_an_experiment_names_only_what_there_is(name):
    values = yaml.safe_load((conf_dir() / "experiment" / f"{name}.yaml").read_text())
    params = values["hydra"]["sweeper"]["params"]
    assert params
    for group, chosen in params.items():
        assert set(str(chosen).split(",")) <= set(choices_of(group)), group


@pytest.mark.parametrize("name", [name for name in EXPERIMENTS if name.startswith(("table", "fig"))])
def test_tables_say_on_whose_data_they_are(name):
    config, choices = compose([f"experiment={name}"])
    assert choices.experiment == name
    assert config.table.name == name
    assert config.table.data == "stand_in"
    assert config.tracking.experiment == f"rtgs/{name}"
    papers = {scene for _, scene in PAPER_SCORES}
    assert set(config.table.paper_scenes.values()) <= papers


def test_the_papers_datasets_have_its_scene_names():
    papers = {scene for _, scene in PAPER_SCORES}
    mine = {compose([f"scene={name}"])[0].scene.name for name in SCENES if "/" in name}
    assert mine == papers
