"""``rtgs explain``, and what is said of words that are not understood."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.cli.explain import keys_of, one_key
from pipelines.cli.main import main
from rtgs.config import compose
from rtgs.config.explain import close_keys
from rtgs.config.keys import config_keys, sentence_of
from rtgs.config.locate import project_root
from rtgs.config.provenance import Setting, settings_of
from rtgs.core.errors import RtgsError

UNDESCRIBED = {
    "AppearanceSettings": "enabled",
    "DensitySettings": "max_surfels min_opacity reset_opacity split_count too_large_shrink too_large_split_count",
    "DetectorSettings": "short_side",
    "EvaluationSettings": "refine_steps",
    "FeatureSettings": "max_features",
    "InitSettings": "neighbors opacity sh_degree",
    "MappingSettings": "init_min_inliers refine_principal_point",
    "MaterialSettings": "f0",
    "MatteSettings": "share",
    "McmcSettings": "init_scale min_opacity noise_border noise_sharpness scale_loss",
    "MethodSettings": "name",
    "NormalAdapter": "box mean multiple size",
    "OptimizerSettings": "beta1 beta2 decay_to eps f0_logits log_scales opacity_logits quaternions roughness_logits "
    "sh_dc sh_rest",
    "PaneSettings": "min_views",
    "PoseSettings": "enabled",
    "ReflectionSettings": "alpha_cutoff background densify_every per_cell transmittance_cutoff",
    "RenderSettings": "background",
    "SegmenterSettings": "encoder",
    "SfmSettings": "min_photos seed",
    "TableConfig": "title",
    "TrackingConfig": "kind",
    "TransmittanceSettings": "alpha_cutoff densify_every densify_from per_cell rim transmittance_cutoff",
}
"""Fields whose own name says it, by dataclass: of these alone `rtgs explain` tells what the dataclass is about."""


def explained(key: str, *words: str) -> dict[str, str]:
    config, _ = compose(words)
    text = one_key(keys_of(config)[key], config, words)
    rows: dict[str, str] = {}
    for line in text.splitlines()[1:]:
        title, said = line[:11].strip(), line[11:]
        name = title or list(rows)[-1]
        rows[name] = f"{rows.get(name, '')} {said}".strip()
    return rows


def test_a_key_is_told_with_value_default_place_and_sentence():
    rows = explained("schedule.total")
    assert rows["value"] == "2000"
    assert rows["set in"] == "conf/preset/quick.yaml"
    assert rows["default"] == "30000  (ScheduleSettings, rtgs/train/settings.py)"
    assert rows["means"] == "steps of all stages together"
    assert explained("schedule.total", "preset=smoke")["set in"].startswith("conf/preset/smoke.yaml")
    over = explained("schedule.total", "schedule.total=77")
    assert (over["value"], over["set in"]) == ("77", "command line (before it conf/preset/quick.yaml: 2000)")
    assert explained("seed")["set in"] == "nowhere: the default"
    assert explained("mesh.source")["choices"] == "auto, hull, tsdf, given"


def test_a_number_of_steps_is_told_as_it_is_scaled():
    rows = explained("schedule.total", "preset=quick", "steps_scaler=0.5")
    assert (rows["value"], rows["set in"], rows["times"]) == ("1000", "conf/preset/quick.yaml", "steps_scaler=0.5")
    assert explained("method.reflection.sh_every", "steps_scaler=2")["times"] == "steps_scaler=2"
    assert "times" not in explained("schedule.checkpoint_every", "steps_scaler=0.5")
    assert "times" not in explained("schedule.total", "preset=quick")
    assert explained("steps_scaler", "steps_scaler=0.5")["value"] == "0.5"


def test_where_a_value_is_that_of_another_key_the_places_of_that_key_are_told():
    words = ("scene=ref_real/sedan", "method=envgs", "preset=paper")
    rows = explained("schedule.total", *words)
    place = "conf/preset/paper.yaml, which takes method.paper_schedule.total, set in "
    file = "conf/method_on_scene/paper/envgs/sedan.yaml"
    assert (rows["value"], rows["set in"]) == ("60000", f"{place}{file} (before it conf/method/envgs.yaml: 40000)")
    over = explained("schedule.total", *words, "method.paper_schedule.total=7")
    assert over["value"] == "7"
    assert over["set in"].startswith(f"{place}command line (before it {file}: 60000")
    rows = explained("schedule.evaluate_every", *words)
    assert rows["set in"].endswith("takes method.paper_schedule.evaluate_every, set nowhere: the default")
    rows = explained("method.own.scope_radius", "scene=ref_real/toycar", "method=ref_gs", "preset=paper")
    assert rows["value"] == "2.507"
    assert rows["set in"].startswith("conf/method_on_scene/paper/ref_gs/ref_real/toycar.yaml (before it ")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (
            ["schedule.total=${schedule.coarse}", "schedule.coarse=${schedule.total}"],
            "rtgs explain: schedule.coarse is ${schedule.total} (command line), which leads back to itself: "
            "schedule.total -> schedule.coarse -> schedule.total; give one of them a value",
        ),
        (["schedule.total=${schedule.total}"], "leads back to itself: schedule.total -> schedule.total;"),
        (
            ["schedule.total=${schedule.coarse}", "schedule.coarse=${schedule.totl}"],
            "rtgs explain: schedule.coarse is ${schedule.totl} (command line), but there is no key 'schedule.totl'; "
            "did you mean schedule.total",
        ),
    ],
)
def test_keys_that_take_each_others_values_or_those_of_no_key_are_named(words: list[str], expected: str):
    """Where the run has a value all the same: a word for a whole group may go over those of its keys."""
    config, _ = compose(["schedule={total: 5, coarse: 1}"])
    with pytest.raises(RtgsError) as raised:
        one_key(keys_of(config)["schedule.total"], config, words)
    assert expected in str(raised.value)


@pytest.mark.parametrize(
    ("word", "why"),
    [
        ("schedule.total=${schedule.total}", "Recursive interpolation detected"),
        ("schedule.total=${schedule.nothing}", "Interpolation key 'schedule.nothing' not found"),
    ],
)
def test_a_word_that_takes_a_value_that_is_not_there_is_named(word: str, why: str, capsys):
    assert main(["explain", "schedule.total", word]) == 1
    key, _, value = word.partition("=")
    told = f"rtgs: config: {key} on the command line takes {value}: {why}; give a value, or ${{KEY}} of a key that has"
    assert told in capsys.readouterr().err
    assert main(["plan", word]) == 1
    assert told in capsys.readouterr().err


def test_a_variable_that_is_not_set_is_named_with_the_key_that_takes_it(monkeypatch, capsys):
    monkeypatch.delenv("RTGS_NOT_SET", raising=False)
    told = "config: schedule.total is taken from the environment variable RTGS_NOT_SET, which is not set"
    for command in (["plan"], ["explain", "schedule.total"]):
        assert main([*command, "schedule.total=${oc.env:RTGS_NOT_SET}"]) == 1
        assert told in capsys.readouterr().err


def test_passwords_are_not_told(monkeypatch, capsys):
    uri = "http://me:hunter2's secret@127.0.0.1:9/" + 200 * "long"
    monkeypatch.setenv("RTGS_TRACKING_URI", "")
    monkeypatch.setenv("RTGS_REMOTE", uri)
    assert main(["explain", "paths.remote", "tracking.uri", "tracking", f"tracking.uri={uri}"]) == 0
    said = capsys.readouterr().out
    assert said.count("http://***@127.0.0.1:9/long") == 3
    assert "secret" not in said


def test_a_word_for_a_group_counts_as_a_place_of_the_keys_in_it():
    words = ["schedule={total: 5}", "schedule.total=6", "schedule={coarse: 2}"]
    assert [each.text for each in settings_of("schedule.total", words) if each.place == "command line"] == ["5", "6"]


def test_places_come_in_the_order_in_which_they_count():
    found = settings_of("scene.path", ["scene=fox", "scene.path=/my/photos"])
    assert [each.place for each in found] == ["conf/scene/fox.yaml", "command line"]
    assert found[-1] == Setting("command line", "/my/photos")


def test_what_is_told_last_is_the_value_of_the_run():
    words = ["preset=standard", "method=rtgs", "scene=toycar", "method.loss.normal=0.01"]
    config, _ = compose(words)
    for key in ("schedule.total", "scene.long_side", "method.density.max_surfels", "method.loss.normal"):
        value: object = config
        for part in key.split("."):
            value = getattr(value, part)
        assert settings_of(key, words)[-1].text == str(value), key


def test_every_key_has_a_sentence():
    for name, key in config_keys().items():
        told = sentence_of(key)
        assert told.strip(), name
        if told.startswith(f"{key.field}, one of:"):
            assert key.field in UNDESCRIBED.get(key.owner.__name__, "").split(), f"{name} has no comment"
            assert len(told) > len(f"{key.field}, one of: "), f"{key.owner.__name__} has no docstring"


def test_a_field_of_a_base_class_is_told_by_its_own_comment():
    assert explained("method.environment.side")["means"].startswith("texels along an edge")


def test_settings_that_one_method_has_are_keys_of_its_runs(capsys):
    words = ("scene=demo", "method=3dgs_dr", "method.own.weight_floor=0.01")
    rows = explained("method.own.weight_floor", *words)
    assert (rows["value"], rows["set in"]) == ("0.01", "command line (before it conf/method/3dgs_dr.yaml: 0.001)")
    assert rows["default"] == "0.001  (DeferredSettings, rtgs/methods/gs3d_dr.py)"
    assert rows["means"] == "m is raised to it at resets of opacities"
    assert explained("method.own.primitive", *words)["choices"] == "ellipsoids, surfels"
    assert main(["explain", "method.own", *words]) == 0
    lines = [line.split()[:2] for line in capsys.readouterr().out.splitlines()]
    assert ["method.own.weight_floor", "0.01"] in lines
    assert ["method.own.outside", "0.4"] in lines
    assert all(line[0].startswith("method.own.") for line in lines[1:])
    assert main(["explain", "method.own.weight_floor", "method=2dgs"]) == 1
    assert "there is no key 'method.own.weight_floor'" in capsys.readouterr().err


def test_settings_of_a_method_from_outside_are_keys_too(monkeypatch):
    monkeypatch.syspath_prepend(str(project_root() / "examples" / "new_method"))
    words = ("scene=demo", "method=2dgs", "method.name='exposure_method:SPEC'", "+method.own.rate=0.5")
    rows = explained("method.own.rate", *words)
    assert (rows["value"], rows["means"]) == ("0.5", "of Adam")


def test_groups_of_keys_and_all_are_listed(capsys):
    assert main(["explain", "method.loss", "method.loss.dssim=0.5"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.split() == ["method.loss.dssim", "0.5"] for line in lines)
    assert all(line.startswith(("key", "method.loss.")) for line in lines)
    assert main(["explain"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(config_keys()) + 1
    assert main(["explain", "schedule.totl"]) == 1
    assert "there is no key 'schedule.totl'; did you mean schedule.total" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("word", "key"),
    [
        ("iterations", "schedule.total"),
        ("long_side", "scene.long_side"),
        ("resolution", "scene.long_side"),
        ("lambda_dssim", "method.loss.dssim"),
        ("totl", "schedule.total"),
        ("los", "method.loss"),
        ("seedd", "seed"),
    ],
)
def test_words_of_other_programs_and_slips_lead_to_the_key(word, key):
    assert close_keys(word)[0] == key


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("threads=1", "`rtgs run synthesize --help` lists its keys"),
        ("samplez=1", "Did you mean samples or test_samples?"),
        ("points=1", "Did you mean features.points?"),
        ("features.pointz=1", "Did you mean features.points?"),
        ("paths.rot=1", "Did you mean paths.root or paths.remote?"),
        ("output_dir=x", "Did you mean paths.root?"),
        ("iterations=1", "`rtgs run synthesize --help` lists its keys"),
    ],
)
def test_synthesize_advises_its_own_keys_alone(word, expected, capsys):
    assert main(["run", "synthesize", "scene=ball_statue", word]) == 1
    assert expected in capsys.readouterr().err


def test_every_key_that_is_advised_exists():
    from rtgs.config.explain import _ELSEWHERE

    launcher = {"hydra.launcher.workers"}
    assert set(_ELSEWHERE.values()) - launcher <= set(config_keys())


@pytest.mark.parametrize(
    ("words", "code", "expected"),
    [
        (["rnu"], 2, "unknown command 'rnu': did you mean `rtgs run`?"),
        (["run", "iterations=100"], 1, "Did you mean schedule.total?"),
        (["run", "/no/such/folder", "method=2dgs"], 1, "capture folder /no/such/folder does not exist"),
        (["show", "--frames", "3"], 2, "the following arguments are required: file\n"),
        (["cache"], 2, "the following arguments are required: action\n"),
    ],
)
def test_mistakes_are_told_with_what_to_write(words, code, expected, capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path))  # where Hydra puts its records
    try:
        found = main(words)
    except SystemExit as stopped:
        found = stopped.code
    assert found == code
    assert expected in capsys.readouterr().err


def test_help_of_run_is_a_screen(capsys):
    assert main(["run", "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 40
    for text in ("method: 2dgs", "rtgs run /my/capture", "preset: ", "rtgs explain"):
        assert any(text in line for line in lines)


@pytest.fixture
def own_configs(tmp_path: Path) -> Path:
    """A folder of YAML files as a user has one."""
    folder = tmp_path / "mine"
    (folder / "ablation").mkdir(parents=True)
    text = "# @package _global_\nablation:\n  why: half of it\nmethod:\n  loss:\n    dssim: 0.125\n"
    (folder / "ablation" / "half.yaml").write_text(text, encoding="utf-8")
    return folder


@pytest.mark.parametrize("option", ["--config-dir {}", "--config-dir={}", "-cd {}"])
def test_explain_and_plan_know_the_files_of_a_folder_of_ones_own(own_configs: Path, option: str, capsys):
    words = [*option.format(own_configs).split(" "), "ablation=half", "scene=demo"]
    assert main(["explain", "method.loss.dssim", *words]) == 0
    said = capsys.readouterr().out
    assert "0.125" in said
    assert f"{own_configs}/ablation/half.yaml" in said.replace("\n", "").replace(" " * 11, "")
    assert main(["plan", *words[-2:], *words[:-2]]) == 0
    assert "8 steps" in capsys.readouterr().out
    assert main(["plan", "ablation=half", "scene=demo"]) == 1
    assert "half" in capsys.readouterr().err


def test_a_preset_of_ones_own_may_be_named_like_the_published_ones(own_configs: Path, capsys):
    (own_configs / "preset").mkdir()
    text = "# @package _global_\ndefaults:\n  - paper\n  - _self_\nmethod:\n  loss:\n    dssim: 0.125\n"
    (own_configs / "preset" / "paper_mine.yaml").write_text(text, encoding="utf-8")
    words = ["--config-dir", str(own_configs), "scene=demo", "method=2dgs", "preset=paper_mine"]
    assert main(["explain", "method.loss.dssim", *words]) == 0
    assert "0.125" in capsys.readouterr().out
    assert main(["plan", *words]) == 0


def test_a_method_of_ones_own_has_the_published_presets_that_it_has_a_file_for(own_configs: Path, capsys):
    (own_configs / "method").mkdir()
    (own_configs / "method" / "mine.yaml").write_text("defaults:\n  - ref_gaussian\n", encoding="utf-8")
    words = ["--config-dir", str(own_configs), "scene=demo", "method=mine", "preset=paper_synthetic"]
    assert main(["plan", *words]) == 1
    assert "preset=paper_synthetic has nothing of method mine" in capsys.readouterr().err
    (own_configs / "method_in_preset").mkdir()
    text = "# @package _global_\ndefaults:\n  - paper_synthetic_ref_gaussian\n"
    (own_configs / "method_in_preset" / "paper_synthetic_mine.yaml").write_text(text, encoding="utf-8")
    assert main(["plan", *words]) == 0
    capsys.readouterr()
    assert main(["explain", "method.own.forward_until", *words]) == 0
    assert "0.36" in capsys.readouterr().out


def test_a_folder_that_is_none_is_refused(capsys):
    for words in (["plan", "--config-dir", "/no/such"], ["explain", "--config-dir=/no/such"]):
        assert main(words) == 1
        assert "--config-dir /no/such is no folder" in capsys.readouterr().err
    assert main(["plan", "scene=demo", "--config-dir"]) == 1
    assert "--config-dir needs a folder of YAML files" in capsys.readouterr().err


def test_a_variable_that_is_not_set_is_named(monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    assert main(["plan", "scene=demo", "tracking=server"]) == 1
    assert (
        "tracking.uri is taken from the environment variable MLFLOW_TRACKING_URI, which is not set: set it, or give "
        in (capsys.readouterr().err)
    )


def test_help_lists_groups_that_can_be_chosen(capsys):
    assert main(["run", "--help"]) == 0
    said = capsys.readouterr().out
    assert "\nablation: " in said
    assert "\npreset: " in said
    assert "after_preset" not in said
    assert "method_in_preset" not in said
    assert "method_on_scene" not in said
    assert "figure: " not in said
