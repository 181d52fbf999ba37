"""Three training stages through the command line: which scenes get the third, and what the rows of Table 3 share."""

from __future__ import annotations

import csv
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipelines.cli.main import main
from pipelines.planning.graph import RunGraph, build_graph
from pipelines.publishing.results import result_table
from pipelines.steps.evaluate import TRACKED
from rtgs.config import compose
from rtgs.config.locate import conf_dir
from rtgs.evaluate.boundary import BOUNDARY_FILE
from rtgs.evaluate.records import read_json as read_evaluation
from rtgs.mesh.container import read_object_mesh
from rtgs.methods.model import Model
from rtgs.runs.training import OBJECT_FOLDER, load_method, stage_params
from rtgs.scenes.canonical import read_scene
from rtgs.train.method import Mode
from rtgs.workflow.manifest import Manifest
from tests.pipelines.app_cases import QUICK, _in_root, root  # noqa: F401  (fixtures)

WIDTH, HEIGHT, VIEWS = 32, 24, 14
ROWS = ("none", "no_transmittance_gaussians", "no_specular_loss", "no_depth_loss", "no_mesh_guide")
TINY = (
    "method.reflection.cells=3",
    "method.transmittance.cells=3",
    "mesh.object.hull.voxels=32",
    "method.loss.perceptual=0",
    "evaluation.lpips=false",
)
TRACKED_QUICK = ("tracking=jsonl", *(word for word in QUICK if word != "tracking=off"))
RADIUS, DISTANCE, FOCAL = 0.7, 3.0, 30.0


def pose(index: int) -> list[list[float]]:
    """Camera to world (OpenGL axes) around the origin, at three heights."""
    angle, height = 2 * math.pi * index / VIEWS, (-0.5, 0.2, 0.9)[index % 3]
    backward = np.array([math.cos(angle), height, math.sin(angle)])
    backward /= np.linalg.norm(backward)
    right = np.cross([0.0, 1.0, 0.0], backward)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(backward, right), backward], axis=1)
    matrix[:3, 3] = DISTANCE * backward
    return matrix.tolist()


def write_capture(folder: Path, masks: str) -> Path:
    """Pictures of a ball; ``masks``: "ball", "empty", "full" or "none"."""
    (folder / "images").mkdir(parents=True)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    apparent = FOCAL * RADIUS / math.sqrt(DISTANCE**2 - RADIUS**2)
    ball = (x + 0.5 - WIDTH / 2) ** 2 + (y + 0.5 - HEIGHT / 2) ** 2 < apparent**2
    frames = []
    for index in range(VIEWS):
        picture = np.stack([128 + 90 * np.sin(x / 5 + index), 128 + 90 * np.cos(y / 4), 100 + x], axis=-1)
        picture[ball] = 0.5 * picture[ball] + 60
        Image.fromarray(picture.clip(0, 255).astype(np.uint8)).save(folder / "images" / f"{index:03d}.png")
        if masks != "none":
            (folder / "masks").mkdir(exist_ok=True)
            mask = (ball if masks == "ball" else np.full_like(ball, masks == "full")).astype(np.uint8) * 255
            Image.fromarray(mask).save(folder / "masks" / f"{index:03d}.png")
        frames.append({"file_path": f"images/{index:03d}.png", "transform_matrix": pose(index)})
    shared = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": 16.0, "cy": 12.0, "camera_model": "PINHOLE"}
    (folder / "transforms.json").write_text(json.dumps(shared | {"frames": frames}))
    return folder


@pytest.fixture(scope="module")
def glass(tmp_path_factory) -> Path:
    return write_capture(tmp_path_factory.mktemp("captures") / "glass ball", "ball")


def graph_of(capture: Path, *words: str):
    config, choices = compose(["scene=capture", f"scene.path={capture}", "method=rtgs", *QUICK, *TINY, *words])
    return build_graph(config, choices)


def test_only_scenes_with_masks_that_show_something_get_the_third_stage(glass: Path, tmp_path: Path):
    full = graph_of(glass)
    assert [step.name for step in full.training] == ["train_diffuse", "train_reflection", "train_transmittance"]
    assert full.mesh is not None
    assert [step.name for step in full.mesh.upstream] == ["import_scene", "train_diffuse", "train_reflection"]
    assert full.mesh in full.training[-1].upstream
    for masks, why in (
        ("none", "no masks of transparent objects"),
        ("empty", "all 14 masks of the scene are empty"),
        ("full", "14 of 14 masks cover the whole picture"),
    ):
        without_glass = write_capture(tmp_path / masks, masks)
        without = graph_of(without_glass)
        assert [step.name for step in without.training] == ["train_diffuse", "train_reflection"]
        assert without.mesh is None
        assert without.training[-1].params.until == 12
        assert any(step.what == "train_transmittance" and why in step.why for step in without.skipped)
        _same_run(without, graph_of(without_glass, "ablation=two_stages"))
    aside = graph_of(glass, "masks=none")
    assert [step.name for step in aside.training] == ["train_diffuse", "train_reflection"]
    assert aside.scene.fingerprint != full.scene.fingerprint
    assert ("train_transmittance", "the scene has no masks of transparent objects") in {
        (step.what, step.why) for step in aside.skipped
    }
    two = graph_of(glass, "ablation=two_stages")
    assert [step.name for step in two.training] == ["train_diffuse", "train_reflection"]
    assert two.training[-1].params.until == 12
    off = ("train_transmittance", "method.transmittance.enabled switches it off")
    assert off in {(step.what, step.why) for step in two.skipped}
    late = graph_of(glass, "method.transmittance.start=1")
    assert ("train_transmittance", "method.transmittance.start leaves it no step") in {
        (step.what, step.why) for step in late.skipped
    }
    assert not any(step.what == "train_transmittance" for step in graph_of(glass, "method=2dgs").skipped)


def test_mirrors_start_earlier_where_there_is_glass(glass: Path, tmp_path: Path):
    reflection, transmittance = "method.reflection.start=0.3", "method.transmittance.start=0.6"
    words = (reflection, "method.reflection.start_before_glass=0.1", transmittance)

    def starts(graph: RunGraph) -> list[int]:
        return [step.params.from_step for step in graph.training[1:]]

    before = graph_of(glass, *words)
    assert starts(before) == [1, 7]
    assert all(step.params.method.reflection.start == 0.1 for step in before.training[1:])
    said = "reflection from 0.1 of the run on"
    smaller = "base surfels are too large from 0.1 extents on"  # of the preset
    assert [each.what for each in before.moved] == [said, smaller]
    plain = write_capture(tmp_path / "none", "none")
    for other in (graph_of(plain, *words), graph_of(glass, *words, "ablation=two_stages")):
        assert starts(other) == [4]
        assert other.moved == ()
    assert starts(graph_of(glass, *words, "method.reflection.start=0.05")) == [1, 7]  # earlier is not held back
    same = graph_of(glass, "method.reflection.start=0.1", transmittance)
    assert [step.fingerprint for step in before.training] == [step.fingerprint for step in same.training]


def test_smaller_base_surfels_are_too_large_where_there_is_glass(glass: Path, tmp_path: Path):
    words = ("method.density.too_large=0.4", "method.transmittance.base_too_large=0.2", "method.reflection.start=0.1")
    said = "base surfels are too large from 0.2 extents on"

    def borders(graph: RunGraph) -> list[float]:
        return [step.params.method.density.too_large for step in graph.training]

    before = graph_of(glass, *words)
    assert borders(before) == [0.2, 0.2, 0.2]  # from the first stage on, which knows of no mesh yet
    assert [each.what for each in before.moved] == [said]
    plain = write_capture(tmp_path / "none", "none")
    for other in (graph_of(plain, *words), graph_of(glass, *words, "ablation=two_stages")):
        assert set(borders(other)) == {0.4}
        assert other.moved == ()
    same = graph_of(glass, "method.density.too_large=0.2", "method.transmittance.base_too_large=null", words[2])
    assert [step.fingerprint for step in before.training] == [step.fingerprint for step in same.training]
    assert same.moved == ()


OWN_KEYS = """
from dataclasses import replace
from rtgs.methods import MethodSpec
from rtgs.methods.family import DIFFUSE, TRANSMITTANCE

def at_the_end(settings, schedule):
    return schedule.total

def never(settings):
    return False

def build(setup):
    raise AssertionError("a plan composes no model")

LATE = replace(TRANSMITTANCE, name="haze", start=at_the_end, start_key="method.reflection.cells")
OFF = replace(LATE, on=never, on_key="method.reflection.per_cell")
SPECS = [MethodSpec("hazy", (DIFFUSE, stage), build) for stage in (LATE, OFF, replace(OFF, on_key=""))]
LATE, OFF, KEYLESS = SPECS
"""


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("LATE", "method.reflection.cells leaves it no step"),
        ("OFF", "method.reflection.per_cell switches it off"),
        ("KEYLESS", "the method's settings switch haze off"),
    ],
)
def test_a_stage_of_another_method_is_left_out_with_its_own_key(glass: Path, tmp_path: Path, monkeypatch, name, why):
    (tmp_path / "hazy_method.py").write_text(OWN_KEYS)
    monkeypatch.syspath_prepend(str(tmp_path))
    graph = graph_of(glass, f"method.name='hazy_method:{name}'")
    sys.modules.pop("hazy_method")
    assert [(step.what, step.why) for step in graph.skipped if step.what == "train_haze"] == [("train_haze", why)]


def _same_run(run: RunGraph, two_stages: RunGraph) -> None:
    """Both are the very same steps up to the pictures: the third stage does no harm where there is nothing for it."""
    ours, theirs = ((*graph.training, graph.render) for graph in (run, two_stages))
    assert [step.fingerprint for step in ours] == [step.fingerprint for step in theirs]


@pytest.mark.parametrize("preset", ["quick", "standard"])
@pytest.mark.parametrize("scene", ["matte_room", "spheres", "fox"])
def test_shipped_scenes_without_glass_are_trained_as_if_there_were_no_third_stage(scene: str, preset: str):
    words = [f"scene={scene}", "method=rtgs", f"preset={preset}"]
    if scene == "fox":  # not shipped; where the mask networks are, they might find something
        words.append("masks=none")
        if not (path := Path(compose(words)[0].scene.path)).is_dir():
            pytest.skip(f"{path} is not there: set RTGS_SHARED to the folder that holds data/fox")
    run, two_stages = (build_graph(*compose([*words, *more])) for more in ([], ["ablation=two_stages"]))
    _same_run(run, two_stages)
    assert run.mesh is None


def test_masks_that_a_step_makes_and_that_are_empty_change_nothing(tmp_path: Path, monkeypatch):
    """Known only when it has run: mesh and third stage are planned, and what they leave is the two-stage run."""
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path))  # a store of its own: the others' executions are counted
    capture = write_capture(tmp_path / "plain ball", "empty")
    words = ["run", f"scene={capture}", "method=rtgs", "masks=given", *QUICK, *TINY]
    words += ["method.reflection.matte.probation=0", "method.reflection.start_before_glass=null"]
    words += ["method.transmittance.base_too_large=null"]
    assert main([*words, "name=three"]) == 0
    assert main([*words, "name=two", "ablation=two_stages"]) == 0
    three, two = tmp_path / "runs" / "three", tmp_path / "runs" / "two"
    assert "train_transmittance" in json.loads((three / "run.json").read_text())["steps"]
    for name in ("point_cloud.ply", "reflection.ply", *(f"renders/{path.name}" for path in two.glob("renders/*"))):
        assert (three / name).read_bytes() == (two / name).read_bytes(), name
    found = [json.loads((folder / "metrics.json").read_text()) for folder in (three, two)]
    assert found[0]["mean"]["psnr"] == found[1]["mean"]["psnr"]
    assert found[0]["object"] is None
    page = (three / "report.html").read_text()
    assert "no transmittance stage" in page
    assert "there are no masks" in page


def test_the_mesh_takes_the_planes_that_somebody_drew(tmp_path: Path):
    capture = write_capture(tmp_path / "window", "none")
    corners = [[8, 6], [24, 6], [24, 18], [8, 18]]
    drawn = {"panes": {"window": {"000.png": corners, "002.png": corners}}}
    (capture / "masks.yaml").write_text(json.dumps(drawn))
    mesh = graph_of(capture, "scene.masks_dir=masks").mesh
    assert mesh is not None
    assert [step.name for step in mesh.upstream] == ["masks", "import_scene", "train_diffuse", "train_reflection"]


def test_the_rows_of_table_3_share_everything_before_the_third_stage(glass: Path):
    swept = (conf_dir() / "experiment" / "table3.yaml").read_text()
    assert ",".join(ROWS) in swept
    prints: dict[str, set[str]] = {}
    for row in ROWS:
        graph = graph_of(glass, f"ablation={row}")
        assert graph.mesh is not None
        for step in (*graph.training, graph.mesh):
            prints.setdefault(step.name, set()).add(step.fingerprint)
    assert {name: len(found) for name, found in prints.items()} == {
        "train_diffuse": 1,
        "train_reflection": 1,
        "extract_mesh": 1,
        "train_transmittance": len(ROWS),
    }
    for learned in (graph_of(glass, f"ablation={name}") for name in ("learned_glass", "paper_glass")):
        for step in learned.training:  # from the first stage on: how colours are mixed and compared is another
            assert step.fingerprint not in prints[step.name]
    other = graph_of(glass, "ablation=mesh_tsdf")
    assert other.mesh is not None
    assert other.mesh.fingerprint not in prints["extract_mesh"]
    assert other.training[1].fingerprint in prints["train_reflection"]


def test_table_3_runs_each_shared_step_once_and_nothing_twice(root: Path, glass: Path, capsys):  # noqa: F811
    """Each of the two methods: one first, one second, one mesh, a third stage for each of the paper's five rows."""
    words = ["run", "experiment=table3", "hydra/launcher=basic", f"scene={glass}", *TRACKED_QUICK, *TINY]
    assert main(words) == 0
    store = root / "store"

    def made(step: str) -> list[Path]:
        return [path.parent for path in (store / step).glob("*/*/manifest.json")]

    counts = {name: len(made(name)) for name in ("import_scene", "train_diffuse", "train_reflection", "extract_mesh")}
    assert counts == {"import_scene": 1, "train_diffuse": 2, "train_reflection": 2, "extract_mesh": 2}
    third = made("train_transmittance")
    assert len(third) == 2 * len(ROWS)
    capsys.readouterr()
    before = {path: (path / "manifest.json").stat().st_mtime_ns for path in made("*")}
    assert main(words) == 0
    assert capsys.readouterr().err.count("nothing to do") == 2 * len(ROWS)
    assert before == {path: (path / "manifest.json").stat().st_mtime_ns for path in made("*")}
    with (root / "tables" / "table3-smoke" / "table.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    names = [(method, *(f"{method}, {name}" for name in ROWS[1:])) for method in ("rtgs_printed", "rtgs")]
    assert [row["method"] for row in rows] == [*names[0], *names[1]]
    assert all(row["flip"] and row["flip_masked"] for row in rows)
    text = (root / "tables" / "table3-smoke" / "table.md").read_text()
    assert text.index("## RT-GS as printed\n") < text.index("| rtgs_printed |") < text.index("## rtgs\n")
    assert all(row[name] for row in rows for name in ("psnr_masked", "ssim_masked", "object_silhouette_iou"))
    _the_transparent_part_is_tracked(root)
    _artifacts_are_complete(store, third)
    _seconds_have_the_mesh(root, rows)
    (run,) = (root / "runs").glob("glass_ball-rtgs-smoke-lpips*")  # the others have an ablation in their name
    page = (run / "report.html").read_text()
    assert "Transmission" in page
    assert "surface before the third stage" in page
    table = json.loads((run / "metrics.json").read_text())
    assert table["mean"]["psnr_masked"] is not None
    with (run / "metrics.csv").open(encoding="utf-8") as stream:
        listed = {row["view"]: row for row in csv.DictReader(stream)}
    for name in ("flip", "flip_masked"):
        assert 0 < table["mean"][name] < 1
        assert f"{table['mean'][name]:.4f}" in page
        assert {view: float(row[name]) for view, row in listed.items() if view not in ("mean", "std")} == {
            row["view"]: row["values"][name] for row in table["views"]
        }
        assert float(listed["mean"][name]) == table["mean"][name]
        assert table["mean"][name] in [run.get(f"eval/{name}") for run in events(root)]
    assert table["mean"]["psnr_masked_given_masks"] is not None
    assert table["object"]["silhouette_iou"] > 0.5
    assert 0 <= table["object"]["no_hit"] < 0.5, "the guide's fallbacks are counted"
    assert "rays without two surfaces" in page
    assert "meet one surface only" in page


def events(folder: Path) -> list[dict[str, float]]:
    """The figures of every event that was tracked."""
    lines = (line for file in folder.rglob("events.jsonl") for line in file.read_text().splitlines())
    return [json.loads(line).get("values", {}) for line in lines]


def _the_transparent_part_is_tracked(folder: Path) -> None:
    """What the tables hold of it, and what is measured at the stage's boundaries."""
    found = {name for values in events(folder) for name in values}
    wanted = {f"eval/{name}" for name in ("psnr_masked", "ssim_masked", "psnr_masked_given_masks")}
    wanted |= {"eval/flip", "eval/flip_masked"}
    wanted |= {"object/silhouette_iou", "object/one_hit", "object/no_hit", "mesh/silhouette_iou"}
    wanted |= {f"boundary/{when}/silhouette_iou" for when in ("before", "after")}
    assert wanted <= found
    of_truth = {f"psnr_{layer}{scaled}" for layer in ("reflection", "transmission") for scaled in ("", "_scaled")}
    assert {*of_truth, "depth_share_masked", "normal_degrees_masked"} <= {*TRACKED}


def _seconds_have_the_mesh(folder: Path, rows: list[dict[str, str]]) -> None:
    """Wherever a training time is shown: of training and of the mesh that its third stage waited for."""
    told = [value for run in events(folder) for name, value in run.items() if name == "cost/train_seconds"]
    shown = {}
    for run in sorted(path.parent for path in (folder / "runs").glob("*/run.json")):
        steps = json.loads((run / "run.json").read_text())["steps"]
        mesh, third = (
            folder / "store" / name / (key := steps[name])[:2] / key for name in ("extract_mesh", "train_transmittance")
        )
        manifest, summary = Manifest.read(mesh), json.loads((third / "summary.json").read_text())
        assert manifest is not None
        assert manifest.cpu_seconds is not None
        facts = json.loads((run / "metrics.json").read_text())["facts"]
        assert facts["train_seconds"] == pytest.approx(summary["seconds"] + manifest.duration)
        assert facts["train_cpu_seconds"] == pytest.approx(summary["cpu_seconds"] + manifest.cpu_seconds)
        with (run / "metrics.csv").open(encoding="utf-8") as stream:
            assert {float(row["train_seconds"]) for row in csv.DictReader(stream)} == {facts["train_seconds"]}
        assert facts["train_seconds"] in told
        assert "steps, mesh included" in (run / "report.html").read_text()
        assert f"{facts['train_seconds']:.1f} s" in result_table([read_evaluation(run / "metrics.json")])
        shown[facts["method"]] = facts["train_seconds"]
    assert {row["method"]: float(row["train_seconds"]) for row in rows} == pytest.approx(shown)


def _artifacts_are_complete(store: Path, third: list[Path]) -> None:
    """Each carries the mesh, the scores at the boundary, and everything a renderer needs."""
    (scene_folder,) = [path.parent for path in (store / "import_scene").glob("*/*/manifest.json")]
    scene = read_scene(scene_folder)
    for folder in third:
        assert Manifest.read(folder) is not None
        assert len(read_object_mesh(folder / OBJECT_FOLDER).mesh.faces) > 0
        assert set(json.loads((folder / BOUNDARY_FILE).read_text())) == {"before", "after"}
        method, params = load_method(folder, scene)
        assert isinstance(method, Model)
        assert stage_params(folder).stage == "transmittance"
        assert (method.find("transmittance") is None) == (params.method.transmittance.first_bounce == "base")
        with torch.no_grad():
            view = scene.test[0]
            rendered = method.render(view.camera, params.until, Mode.TRAIN, mask=view.mask)
        assert rendered.maps.get("transparent") is not None
        assert bool(torch.isfinite(rendered.image).all())
