"""A judged run through the command line: what is spoilt in the full method shows the plain one, and the run says so."""

# ruff: noqa: F811 (fixtures of app_cases)

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from pipelines.cli.main import main
from pipelines.steps import judge
from rtgs.config.names import overridden
from rtgs.core.cameras import Camera
from rtgs.core.names import plain_stem
from rtgs.evaluate.boundary import BoundaryRecord
from rtgs.evaluate.coverage import FRAMED_BY
from rtgs.evaluate.images import to_bytes
from rtgs.evaluate.judgement import JudgeRecord, Verdict, verdict
from rtgs.evaluate.metrics import psnr
from rtgs.evaluate.regions import NOWHERE, Regions, region_errors
from rtgs.mesh.container import read_object_mesh
from rtgs.mesh.record import MeshRecord
from rtgs.runs import mixture
from rtgs.runs.framing import base_surface, framing_counts
from rtgs.runs.mixture import PLAIN
from rtgs.runs.training import CHECKPOINT_FOLDER, OBJECT_FOLDER, load_method, read_history, stage_params
from rtgs.runs.views import read_render
from rtgs.scenes.canonical import read_scene
from rtgs.scenes.scene import Scene
from rtgs.train.checkpoint import load_checkpoint
from rtgs.train.method import Mode
from rtgs.workflow.manifest import Manifest
from tests.pipelines.app_cases import QUICK, _in_root, capture, folders, root  # noqa: F401  (fixtures)
from tests.pipelines.steps.test_transmittance_stage import TINY, write_capture

JUDGED = ("judge=photos", *QUICK)
SPOILT_GLASS = ("method.transmittance.rate_gain=100000.0", "method.transmittance.wall.index=2.5")


def plain_image(place: Path, scene: Scene, camera: Camera) -> torch.Tensor:
    method, stage = load_method(place, scene)
    with torch.no_grad():
        return method.render(camera, stage.until, Mode.EVALUATE).image


@pytest.fixture(scope="module")
def glass(tmp_path_factory) -> tuple[Path, list[str]]:
    """The folder of a run whose third stage is spoilt by an absurd rate, and its words."""
    place = tmp_path_factory.mktemp("glass")
    scene = write_capture(place / "glass ball", "ball")
    words = ["run", f"scene={scene}", "method=rtgs", *JUDGED, *TINY, *SPOILT_GLASS, "name=glass"]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        patch.setenv("RTGS_ROOT", str(place))
        assert main(words) == 0
    return place / "runs" / "glass", words


def test_a_spoilt_object_shows_the_plain_method_to_the_bit(glass):
    run, _ = glass
    places = folders(run)
    record = JudgeRecord.read(run)
    assert (record.full, record.plain) == ("rtgs", "3dgs")
    assert [each.region for each in record.regions] == ["all else", "the object"]
    assert 1 in record.replaced
    scene = read_scene(places["import_scene"])
    assert record.views == tuple(view.name for view in scene.held)
    assert len(scene.held) == 2
    regions = Regions(read_object_mesh(places["train_transmittance"] / OBJECT_FOLDER))
    for view in scene.test:
        shown = read_render(places["render"], view.name)
        plain, full = plain_image(places["plain_rest"], scene, view.camera), shown["image_full"]
        numbers = regions.numbers(view.camera)
        inside = numbers == 1
        assert 100 < int(inside.sum()) < inside.numel()
        assert torch.equal(shown["image"][:, inside], plain[:, inside])
        assert not torch.equal(full[:, inside], plain[:, inside])
        other = plain if 0 in record.replaced else full
        assert torch.equal(shown["image"][:, ~inside], other[:, ~inside])
        assert psnr(shown["image"], view.image, mask=inside) == psnr(plain, view.image, mask=inside)
        assert psnr(shown["image"], view.image, mask=inside) > psnr(full, view.image, mask=inside)
        picture = np.asarray(Image.open(run / "renders" / f"{plain_stem(view.name)}.png").convert("RGB"))
        assert np.array_equal(picture, to_bytes(shown["image"]))


def test_the_judge_measures_what_neither_method_was_trained_on(glass):
    """Its figures are those of the held-out views, rendered with both, where enough training views show the pixels."""
    places = folders(glass[0])
    record = JudgeRecord.read(glass[0])
    scene = read_scene(places["import_scene"])
    regions = Regions(read_object_mesh(places["train_transmittance"] / OBJECT_FOLDER))
    method, stage = load_method(places["train_transmittance"], scene)
    surfaces = {view.name: base_surface(method, view.camera, stage.until) for view in scene.held}
    framed = framing_counts(method, stage.until, scene.held, surfaces, scene.train)
    gains, pixels = [], 0
    for view in scene.held:
        inside = (regions.numbers(view.camera) == 1) & (framed[view.name] >= FRAMED_BY)
        pixels += int(inside.sum())
        with torch.no_grad():
            full = method.render(view.camera, stage.until, Mode.EVALUATE).image
        plain = plain_image(places[PLAIN], scene, view.camera)
        gains.append(psnr(full, view.image, mask=inside) - psnr(plain, view.image, mask=inside))
    assert record.regions[1].gain == pytest.approx(sum(gains) / len(gains))
    assert sum(gains) < 0
    assert record.regions[1].pixels == pixels


@pytest.mark.parametrize(("left", "judged"), [(0.5, True), (0.0, False)])
def test_what_too_few_training_views_show_does_not_count(glass, monkeypatch, left: float, judged: bool):
    """Half of each picture is shown by enough of them, or none of it is."""
    places = folders(glass[0])
    scene = read_scene(places["import_scene"])

    def counts(_: object, __: int, views, *___: object) -> dict[str, torch.Tensor]:
        found = {view.name: torch.full(view.image.shape[1:], FRAMED_BY - 1, dtype=torch.int16) for view in views}
        for count in found.values():
            count[:, : round(left * count.shape[1])] = FRAMED_BY
        return found

    monkeypatch.setattr(judge, "framing_counts", counts)
    regions = Regions(read_object_mesh(places["train_transmittance"] / OBJECT_FOLDER))
    for pair, view in zip(judge._pairs(places, scene, regions), scene.held, strict=True):
        half = round(left * view.image.shape[2])
        assert torch.equal(pair.numbers[:, :half], regions.numbers(view.camera)[:, :half])
        assert bool((pair.numbers[:, half:] == NOWHERE).all())
    found = region_errors(regions.names, judge._pairs(places, scene, regions))
    assert [verdict(each).gain is not None for each in found] == [judged, judged]


def test_both_methods_are_judged_with_the_masks_that_pictures_are_rendered_with(glass, monkeypatch):
    places = folders(glass[0])
    scene, masks = read_scene(places["import_scene"]), []
    _, stage = load_method(places["train_transmittance"], scene)

    def rendered(camera: Camera, *_: object, mask: torch.Tensor) -> SimpleNamespace:
        masks.append(mask)
        return SimpleNamespace(image=torch.zeros(3, camera.height, camera.width))

    monkeypatch.setattr(judge, "load_method", lambda *_: (SimpleNamespace(render=rendered), stage))
    monkeypatch.setattr(judge, "base_surface", lambda *_: None)
    framed = {view.name: torch.full(view.image.shape[1:], FRAMED_BY) for view in scene.held}
    monkeypatch.setattr(judge, "framing_counts", lambda *_: framed)
    regions = Regions(read_object_mesh(places["train_transmittance"] / OBJECT_FOLDER))
    assert len(list(judge._pairs(places, scene, regions))) == len(scene.held) > 0
    shown = [view.mask for view in scene.held for _ in range(2)]
    assert all(mask is not None and torch.equal(mask, other) for mask, other in zip(masks, shown, strict=True))


def test_a_judged_run_says_what_it_shows(glass, capsys, monkeypatch):
    run, words = glass
    monkeypatch.chdir(run.parents[1])
    monkeypatch.setenv("RTGS_ROOT", str(run.parents[1]))
    assert main(words) == 0  # all of it cached
    told = capsys.readouterr()
    assert "nothing to do" in told.err
    assert "rtgs, judged" in told.out
    assert "kept the plain 3dgs in the object: error " in told.out
    page = (run / "report.html").read_text()
    assert "kept the plain 3dgs in the object" in page
    assert "files of Gaussians" in page
    table = json.loads((run / "metrics.json").read_text())
    seconds = [
        json.loads((folders(run)[name] / "summary.json").read_text())["seconds"]
        for name in ("train_transmittance_rest", "plain_rest")
    ]
    mesh = Manifest.read(folders(run)["extract_mesh"])
    assert mesh is not None
    assert table["facts"]["train_seconds"] == pytest.approx(sum(seconds) + mesh.duration)


def test_a_method_that_loses_everywhere_is_not_shown_at_all(capture, root):
    """A scene without glass: the whole picture is the region. An absurd rate of colours spoils the full method."""
    common = [f"scene={capture}", *QUICK]
    spoilt = "method.optimizer.sh_dc=5.0"
    full = ["method=rtgs", spoilt, "method.loss.perceptual=0", "name=lost"]
    assert main(["run", *common, *full, "judge=photos", "judge.at=1"]) == 0
    assert main(["run", *common, "method=3dgs", "scene.hold_out=12", "name=plain"]) == 0
    lost, plain = root / "runs" / "lost", root / "runs" / "plain"
    record = JudgeRecord.read(lost)
    assert [(each.region, each.kept) for each in record.regions] == [("the picture", "plain")]
    assert record.all_plain
    for name in ("point_cloud.ply", *(f"renders/{path.name}" for path in plain.glob("renders/*"))):
        assert (lost / name).read_bytes() == (plain / name).read_bytes(), name
    assert sorted(path.name for path in lost.glob("*.ply")) == ["point_cloud.ply"]
    found, alone = (json.loads((run / "metrics.json").read_text()) for run in (lost, plain))
    for figure in ("psnr", "ssim"):
        assert [row["values"][figure] for row in found["views"]] == [row["values"][figure] for row in alone["views"]]
    assert found["facts"]["surfels"] == alone["facts"]["surfels"]
    assert main(["run", *common, *full]) == 0
    assert not (lost / "judge.json").exists()  # another run of this name: nothing is left of it
    assert (lost / "reflection.ply").is_file()


def tensors_of(place: Path) -> dict[str, torch.Tensor]:
    return load_checkpoint(place / CHECKPOINT_FOLDER).tensors


def test_what_is_shown_learns_from_the_held_out_views_and_what_is_not_ends(capture, root, capsys):
    words = [f"scene={capture}", *QUICK, "method=2dgs", "judge=photos", "method.optimizer.sh_dc=5.0", "name=ended"]
    words += ["method.density.too_large=0.1"]  # else 2dgs is as good as the plain one in a region
    assert main(["run", *words]) == 0
    places = folders(root / "runs" / "ended")
    record = JudgeRecord.read(root / "runs" / "ended")
    joined = tuple(stage_params(places[name]).joined for name in ("train_diffuse_rest", "plain_rest"))
    assert (record.all_plain, record.at) == (True, joined)
    judged, rest = tensors_of(places["train_diffuse"]), tensors_of(places["train_diffuse_rest"])
    assert judged.keys() == rest.keys()
    assert all(torch.equal(judged[name], rest[name]) for name in judged)
    assert read_history(places["train_diffuse_rest"]) == []
    scene = read_scene(places["import_scene"])
    count = len(scene.train), len(scene.train) + len(scene.held)
    orders = [tensors_of(places[name])["views.permutation"] for name in (PLAIN, "plain_rest")]
    assert tuple(map(len, orders)) == count
    assert count[0] < count[1]
    for view in scene.test:
        shown = read_render(places["render"], view.name)["image"]
        assert torch.equal(shown, plain_image(places["plain_rest"], scene, view.camera))
        assert not torch.equal(shown, plain_image(places[PLAIN], scene, view.camera))
    shown = root / "runs" / "ended" / "point_cloud.ply"
    assert shown.read_bytes() == (places["plain_rest"] / "base.ply").read_bytes()
    told = capsys.readouterr().out
    on = f"held-out views are trained on: the plain 3dgs from step {joined[1]} on: there both were judged"
    assert f"{len(record.views)} {on}" in told
    assert f"training stopped: 2dgs from step {joined[0]} on: no region shows it" in told
    facts = json.loads((root / "runs" / "ended" / "metrics.json").read_text())["facts"]
    assert facts["steps"] == stage_params(places["plain_rest"]).until


def test_a_plain_method_that_is_not_shown_ends_too(capture, root, monkeypatch):
    """The judge is told that the full method is better."""
    monkeypatch.setattr(judge, "verdict", lambda errors: Verdict(errors.region, "full"))
    assert main(["run", f"scene={capture}", *QUICK, "method=2dgs", "judge=photos", "name=kept", "seed=5"]) == 0
    places = folders(root / "runs" / "kept")
    judged, rest = tensors_of(places[PLAIN]), tensors_of(places["plain_rest"])
    assert all(torch.equal(judged[name], rest[name]) for name in judged)
    trained, gone_on = (
        tensors_of(places[name])["method.generator"] for name in ("train_diffuse", "train_diffuse_rest")
    )
    assert not torch.equal(trained, gone_on)  # density control has drawn from it
    scene = read_scene(places["import_scene"])
    view = scene.test[0]
    assert torch.equal(
        read_render(places["render"], view.name)["image"],
        plain_image(places["train_diffuse_rest"], scene, view.camera),
    )


def test_a_picture_of_both_methods_is_of_both_as_they_ended(tmp_path, monkeypatch):
    """The judge is told to show the plain method in the object: both are trained to their ends."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path))
    monkeypatch.setattr(
        judge, "verdict", lambda errors: Verdict(errors.region, "plain" if errors.region == "the object" else "full")
    )
    scene = write_capture(tmp_path / "ball", "ball")
    assert main(["run", f"scene={scene}", "method=rtgs", *JUDGED, *TINY, "name=both"]) == 0
    places = folders(tmp_path / "runs" / "both")
    first, rest = (places[f"train_transmittance{end}"] for end in ("", "_rest"))
    judged, ended = tensors_of(first), tensors_of(rest)
    assert len(judged["views.permutation"]) < len(ended["views.permutation"])
    assert not torch.equal(judged["method.generator"], ended["method.generator"])
    scores = [BoundaryRecord.read(folder) for folder in (first, rest)]
    assert scores[0] is not None
    assert scores[1] is not None
    assert str(scores[0].before) == str(scores[1].before)  # where the stage began
    assert str(scores[0].after) != str(scores[1].after)
    views = read_scene(places["import_scene"])
    method, stage = load_method(rest, views)
    regions = Regions(read_object_mesh(rest / OBJECT_FOLDER))
    for view in views.test:
        inside = regions.numbers(view.camera) == 1
        shown = read_render(places["render"], view.name)["image"]
        with torch.no_grad():
            full = method.render(view.camera, stage.until, Mode.EVALUATE, mask=view.mask).image
        plain = plain_image(places["plain_rest"], views, view.camera)
        assert torch.equal(shown[:, inside], plain[:, inside])
        assert torch.equal(shown[:, ~inside], full[:, ~inside])


def test_the_rest_of_a_stage_that_has_no_object_is_of_the_stage_before(tmp_path, monkeypatch):
    """Masks that turn out to be empty: mirrors are trained to the end, on the held-out views as well."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path))
    monkeypatch.setattr(judge, "verdict", lambda errors: Verdict(errors.region, "full"))
    scene = write_capture(tmp_path / "empty", "empty")
    words = [f"scene={scene}", "method=rtgs", "masks=given", *JUDGED, *TINY, "method.reflection.matte.probation=0"]
    assert main(["run", *words, "name=no-object"]) == 0
    places = folders(tmp_path / "runs" / "no-object")
    assert MeshRecord.read(places["extract_mesh"]).absent
    record = JudgeRecord.read(tmp_path / "runs" / "no-object")
    assert record.at is not None
    steps = [row["step"] for row in read_history(places["train_transmittance_rest"])]
    assert not (places["train_transmittance_rest"] / OBJECT_FOLDER).exists()
    assert min(steps) > record.at[0]
    assert max(steps) == stage_params(places["train_transmittance_rest"]).until
    views = read_scene(places["import_scene"])
    order = tensors_of(places["train_transmittance_rest"])["views.permutation"]
    assert len(order) == len(views.train) + len(views.held)


def test_a_scene_too_small_to_spare_views_keeps_the_full_method(capture, root, capsys):
    words = ["run", f"scene={capture}", *JUDGED, "method=2dgs", "scene.max_views=7", "name=few"]
    assert main(words) == 0
    record = JudgeRecord.read(root / "runs" / "few")
    assert (record.views, record.replaced) == ((), ())
    told = capsys.readouterr()
    for text in (told.err, told.out):  # the log of the step, and the end of the run
        assert "kept 2dgs in the picture: 0 held-out views show enough of it, 2 are needed: nobody can judge" in text


def test_a_sweep_merges_judged_jobs_and_the_plain_method_is_not_judged(capture, root, capsys):
    """The plain method's numbers are composed within the sweep, by whoever needs them: the launcher and each job."""
    words = [f"scene={capture}", *QUICK, "method=2dgs,3dgs", "judge=photos", "schedule.total=8"]
    launcher = ["hydra/launcher=rtgs_dask", "hydra.launcher.workers=1", "hydra.launcher.threads=1"]
    assert main(["run", "--multirun", *words, *launcher]) == 0
    told = capsys.readouterr()
    assert "2 jobs, 14 steps, " in told.err
    assert "no judge step: 3dgs is the plain method itself" in told.err
    named = overridden([*QUICK, "schedule.total=8"])
    assert JudgeRecord.read(root / "runs" / f"tiny_room-2dgs-smoke-judged-{named}").full == "2dgs"
    assert (root / "runs" / f"tiny_room-3dgs-smoke-{named}").is_dir()
    assert not (root / "runs" / f"tiny_room-3dgs-smoke-{named}" / "judge.json").exists()
    assert main(["plan", "--multirun", *words]) == 0
    assert "14 steps, 14 from the cache, nothing to do" in capsys.readouterr().out


def test_runs_without_a_judge_render_as_ever(tmp_path):
    scene = Scene("none", (), (), torch.zeros(4, 3), torch.zeros(4, 3), 1.0, "test")
    assert mixture.read_mixture({"train_diffuse": tmp_path}, scene) is None
