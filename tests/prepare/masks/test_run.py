"""From photos to masks in the scene that the trainers read: every way, the cache, the plan, the command line."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
pytest.importorskip("tokenizers")

from pipelines.cli.main import main
from rtgs.prepare.errors import PrepareError
from rtgs.prepare.masks.make import MaskRequest, make_masks
from rtgs.prepare.masks.networks import file_digest, find_networks
from rtgs.prepare.masks.report import MaskReport
from rtgs.prepare.masks.settings import (
    CleanSettings,
    DetectorSettings,
    DrawnSettings,
    GivenSettings,
    MaskSettings,
    SegmenterSettings,
)
from rtgs.prepare.pretrained import REGISTRY, MissingWeights
from rtgs.scenes.images import read_mask
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings
from tests.prepare import glass_scene
from tests.prepare.glass_scene import HEIGHT, WIDTH, overlap, shots, write_capture, write_masks

SHOTS = shots(8)
CLEAN = CleanSettings(voxels=32, mask_size=100)
DETECTOR = DetectorSettings(prompt="glass . wooden chair", short_side=160, long_side=240)
SETTINGS = MaskSettings(clean=CLEAN, detector=DETECTOR)


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    return write_capture(tmp_path_factory.mktemp("glass") / "ball", SHOTS)


@pytest.fixture
def weights(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("RTGS_WEIGHTS", str(tmp_path / "weights"))
    return tmp_path / "weights"


def make(method: str, capture: Path, tmp_path: Path, settings: MaskSettings = SETTINGS, **scene):
    said: list[str] = []
    out = tmp_path / "out"
    out.mkdir(exist_ok=True)
    request = MaskRequest(
        method, SceneSettings(path=str(capture), masks_dir="", **scene), settings, capture, tmp_path / "cache", 1
    )
    return make_masks(request, out, said.append), out, said


def table(out: Path) -> dict[str, dict[str, str]]:
    with (out / "masks.csv").open(encoding="utf-8") as stream:
        return {row["photo"]: row for row in csv.DictReader(stream)}


@pytest.mark.parametrize("layout", ["transformers", "samexporter"])
def test_words_become_masks_once_for_each_photo(capture, tmp_path, weights, layout):
    glass_scene.write_networks(weights, layout)
    first, _, _ = make("grounded_sam2", capture, tmp_path, max_views=3)
    assert (first.masks, first.from_cache) == (3, 0)
    assert "3 photos show something, 5 are needed" in first.checked
    report, out, said = make("grounded_sam2", capture, tmp_path)
    assert (report.masks, report.from_cache) == (8, 3), "the photos of before are not done again"
    assert not report.flagged
    for shot in SHOTS:
        assert overlap(read_mask(out / f"masks/{shot.name}.png"), shot.mask) > 0.9
    assert "by GroundingDINO and SAM 2, 3 from the cache; compared with the hull of 8 masks" in said[-1]
    assert all(row["boxes"].startswith("glass 0.8") for row in table(out).values())
    assert float(table(out)[SHOTS[0].name]["agreement"]) > 0.9
    assert MaskReport.read(out) == report
    with Image.open(out / "masks.png") as picture:
        assert picture.width == 8 * 240
    settings = replace(SETTINGS, segmenter=SegmenterSettings(mask_threshold=1.0))
    other, _, _ = make("grounded_sam2", capture, tmp_path, settings)
    assert other.from_cache == 0


def test_a_scene_in_which_nothing_is_found_goes_on_without_masks(capture, tmp_path, weights):
    glass_scene.write_networks(weights)
    settings = replace(SETTINGS, detector=replace(DETECTOR, prompt="bottle"))
    report, out, said = make("grounded_sam2", capture, tmp_path, settings)
    assert report.masks == 0
    assert "nothing found in any photo" in said[-1]
    assert not list((out / "masks").iterdir())
    settings = SceneSettings(path=str(capture), masks_dir=str((out / "masks").absolute()), long_side=40)
    assert not load_scene(settings).has_masks


@pytest.mark.parametrize("action", ["auto", "drop", "flag"])
def test_a_mask_that_disagrees_is_repaired_dropped_or_flagged(capture, tmp_path, weights, action):
    """Two photos in which the detector fails: painted over, so that it sees nothing, and with something blue beside."""
    glass_scene.write_networks(weights)
    changed = write_capture(tmp_path / "changed", SHOTS)
    blind, fooled = SHOTS[2], SHOTS[5]
    Image.fromarray(np.full((HEIGHT, WIDTH, 3), 90, dtype=np.uint8)).save(changed / "images" / blind.name)
    pixels = fooled.pixels.copy()
    pixels[90:119, 2:60] = (10, 30, 250)
    Image.fromarray(pixels).save(changed / "images" / fooled.name)
    settings = replace(SETTINGS, clean=replace(CLEAN, action=action))
    report, out, said = make("grounded_sam2", changed, tmp_path, settings)
    assert {row.name for row in report.flagged} == {blind.name, fooled.name}
    assert "2 disagree with the others" in said[-1]
    found = {shot.name: out / f"masks/{shot.name}.png" for shot in (blind, fooled)}
    rows = table(out)
    if action == "drop":
        assert not any(path.exists() for path in found.values())
        assert report.masks == 6
        assert rows[blind.name]["action"] == "dropped"
        return
    agreement = {shot.name: overlap(read_mask(found[shot.name]), shot.mask) for shot in (blind, fooled)}
    if action == "flag":
        assert max(agreement.values()) < 0.75
        assert rows[blind.name]["action"] == ""
    else:
        assert min(agreement.values()) > 0.8
        assert rows[blind.name]["action"] == "from the hull"
        assert rows[fooled.name]["action"] == "repaired"


def test_given_masks_are_compared_and_left_alone(capture, tmp_path):
    truth = {f"{shot.name}.png": ~shot.mask for shot in SHOTS[:-1]}
    truth[f"{SHOTS[3].name}.png"] = np.roll(~SHOTS[3].mask, 40, axis=1)
    root = write_capture(tmp_path / "given", SHOTS)
    write_masks(root / "colmap_masks", truth)
    given = GivenSettings(folder="colmap_masks", inverted=True)
    report, out, _ = make("given", root, tmp_path, replace(SETTINGS, given=given))
    assert report.masks == 7
    assert [row.name for row in report.flagged] == [SHOTS[3].name]
    assert report.notes == (f"1 photos have no mask: {SHOTS[-1].name}",)
    assert (read_mask(out / f"masks/{SHOTS[0].name}.png") == SHOTS[0].mask).all()
    assert overlap(read_mask(out / f"masks/{SHOTS[3].name}.png"), SHOTS[3].mask) < 0.3
    wrong = root / "colmap_masks" / f"{SHOTS[1].name}.png"
    Image.fromarray(np.zeros((50, 50), dtype=np.uint8)).save(wrong)
    with pytest.raises(PrepareError, match=r"is 50x50, its photo photo_01.png 160x120"):
        make("given", root, tmp_path, replace(SETTINGS, given=given))


def marks(root: Path, **content) -> None:
    (root / "masks.yaml").write_text(yaml.safe_dump(content))


def box_around(mask: np.ndarray, margin: int = 6) -> list[int]:
    rows, columns = np.nonzero(mask)
    return [int(v) for v in (columns.min() - margin, rows.min() - margin, columns.max() + margin, rows.max() + margin)]


def test_three_boxes_are_enough_for_grabcut_on_all_photos(tmp_path):
    root = write_capture(tmp_path / "drawn", SHOTS)
    marks(root, cutouts={SHOTS[index].name: {"box": box_around(SHOTS[index].mask)} for index in (0, 4, 7)})
    report, out, said = make("grabcut", root, tmp_path)
    assert report.masks == 8
    assert "GrabCut from marks (classical fallback)" in said[-1]
    assert min(overlap(read_mask(out / f"masks/{shot.name}.png"), shot.mask) for shot in SHOTS) > 0.9
    origins = {row["origin"] for row in table(out).values()}
    assert origins == {"GrabCut from marks", "GrabCut from the hull of the marked photos"}
    alone = replace(SETTINGS, drawn=DrawnSettings(carry=False))
    report, _, _ = make("grabcut", root, tmp_path, alone)
    assert report.masks == 3
    with pytest.raises(PrepareError, match="has no panes, which masks=polygon needs: set masks=grabcut"):
        make("polygon", root, tmp_path)


def test_outlines_in_a_few_photos_give_the_others_their_hull(tmp_path):
    """What GrabCut cannot see, a person can: colours play no part."""
    import cv2

    taken = [replace(shot, pixels=np.full_like(shot.pixels, 90)) for shot in SHOTS]
    root = write_capture(tmp_path / "outlined", taken)
    outlines = {}
    for index in (0, 2, 4, 5, 7):
        (found,), _ = cv2.findContours(SHOTS[index].mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        corners = (found[:, 0] + 0.5) / (WIDTH, HEIGHT)
        outlines[SHOTS[index].name] = {"outline": corners.round(4).tolist()}
    marks(root, units="fraction", cutouts=outlines)
    report, out, said = make("grabcut", root, tmp_path)
    assert report.masks == 8
    assert "outlines of a person" in said[-1]
    values = {shot.name: overlap(read_mask(out / f"masks/{shot.name}.png"), shot.mask) for shot in SHOTS}
    assert min(values.values()) > 0.85
    origins = {row["origin"] for row in table(out).values()}
    assert origins == {"outlined by a person", "hull of the outlines"}


def test_a_pane_is_carried_into_the_scene(tmp_path):
    from tests.prepare.masks.test_drawn import PANE, shares, true_pane, views_of

    root = write_capture(tmp_path / "pane", SHOTS)
    views = views_of(glass_scene_lens(), len(SHOTS))
    drawn = {SHOTS[i].name: (shares(views[str(i)], PANE) * (WIDTH, HEIGHT)).round(2).tolist() for i in (0, 6)}
    marks(root, panes={"window": drawn})
    report, out, said = make("polygon", root, tmp_path)
    assert report.masks == 8
    assert "flat panes have none" in report.checked
    assert "classical fallback" in said[-1]
    assert report.notes[0].startswith("pane window: corners drawn in 2 photos, 75 degrees apart")
    (pane,) = MaskReport.read(out).panes
    assert pane.name == "window"
    np.testing.assert_allclose(pane.corners, PANE, atol=0.02)
    settings = SceneSettings(path=str(root), masks_dir=str((out / "masks").absolute()))
    scene = load_scene(settings)
    for view in (*scene.train, *scene.test):
        index = [shot.name for shot in SHOTS].index(view.name)
        assert view.mask is not None
        assert overlap(view.mask.numpy(), true_pane(views[str(index)])) > 0.9


def glass_scene_lens():
    from tests.prepare.masks.test_drawn import LENSES

    return LENSES["pinhole"]


def plan(capsys, *words: str) -> dict[str, str]:
    assert main(["plan", *words, "tracking=off"]) == 0
    rows = [line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()]
    return {row[0]: row[1] for row in rows if len(row) == 2}


@pytest.fixture
def root(tmp_path, monkeypatch, weights) -> Path:
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path / "root"))
    return tmp_path / "root"


def test_the_plan_says_why_there_are_no_masks(capture, tmp_path, root, weights, capsys):
    scene = f"scene.path={capture}"
    reads = "method.loss.specular=0.2"
    assert "nothing reads them (method.loss.specular is 0" in plan(capsys, scene, "method=2dgs")["masks"]
    missing = plan(capsys, scene, reads)["masks"]
    assert "weights missing: grounding_dino/model.onnx" in missing
    assert "without: masks.yaml beside the photos (`rtgs outline`)" in missing
    assert "masks=none" in plan(capsys, scene, reads, "masks=none")["masks"]
    assert "masks are given (48 of 48 photos)" in plan(capsys, "scene=demo", reads)["masks"]
    assert "the scene has no glass" in plan(capsys, "scene=matte_room", reads)["masks"]
    assert main(["plan", scene, "masks=grounded_sam2", "tracking=off"]) == 1
    assert "weights missing: grounding_dino/model.onnx" in capsys.readouterr().err
    assert main(["plan", scene, "masks=grabcut", "tracking=off"]) == 1
    assert "masks.yaml does not exist: write the boxes, clicks or corners into it" in capsys.readouterr().err
    glass_scene.write_networks(weights)
    assert "to run" in plan(capsys, scene, reads)["masks"]
    drawn = write_capture(tmp_path / "drawn", SHOTS[:4])
    marks(drawn, cutouts={SHOTS[0].name: {"box": [1, 2, 30, 40]}})
    rows = plan(capsys, f"scene.path={drawn}", "method=2dgs")
    assert "to run" in rows["masks"], "whoever marked something wants it"
    assert "given: true" not in rows["masks"]


def test_masks_reach_the_training_through_the_command_line(capture, root, weights, capsys):
    glass_scene.write_networks(weights)
    words = ["run", f"scene.path={capture}", "masks=grounded_sam2", "preset=smoke", "scene.long_side=48"]
    words += ["masks.clean.voxels=24", "masks.detector.short_side=160", "masks.detector.prompt='glass . bottle'"]
    words += ["method=2dgs", "schedule.total=4", "schedule.checkpoint_every=2", "threads=1", "tracking=off"]
    assert main(words) == 0
    (run,) = (path for path in (root / "runs").iterdir() if path.is_dir())
    page = (run / "report.html").read_text()
    assert "8 of 8 photos have a mask, by GroundingDINO and SAM 2" in page
    assert {"masks.json", "masks.csv", "masks.png"} <= {path.name for path in run.iterdir()}
    rows = json.loads((run / "metrics.json").read_text())
    assert "psnr_masked" in json.dumps(rows)
    assert len(list((root / "store/single_masks").glob("*.png"))) == 8
    capsys.readouterr()
    assert "cached" in plan(capsys, *words[1:-1])["masks"]


def test_photos_without_poses_become_a_table_with_masked_figures(root, weights, tmp_path, capsys):
    """Photos -> poses -> masks from words -> training -> table; then a pane marked on the photos as they were taken."""
    from tests.prepare.masks.test_drawn import PANE

    taken = shots(8, 320, 240)
    photos = tmp_path / "my photos"
    photos.mkdir()
    for shot in taken:
        Image.fromarray(shot.pixels).save(photos / shot.name)
    glass_scene.write_networks(weights)
    words = [f"scene={photos}", "preset=smoke", "scene.long_side=64", "method=2dgs", "threads=1", "tracking=off"]
    words += ["schedule.total=4", "schedule.checkpoint_every=2", "sfm.features.max_features=800"]
    words += ["masks.clean.voxels=32", "masks.detector.short_side=240"]
    rows = plan(capsys, *words, "masks=grounded_sam2")
    assert list(rows)[1:5] == ["normals", "sfm", "masks", "import_scene"]
    assert main(["run", *words, "masks=grounded_sam2"]) == 0
    (run,) = (path for path in (root / "runs").iterdir() if path.is_dir())
    report = MaskReport.read(run)
    assert (report.masks, len(report.rows)) == (8, 8)
    assert not report.flagged
    assert "psnr_masked" in (run / "metrics.json").read_text()
    (made,) = (root / "store/masks").glob("*/*/masks")
    for shot in taken:
        found = Image.fromarray(read_mask(made / f"{shot.name}.png")).resize((320, 240))
        assert overlap(np.asarray(found), shot.mask) > 0.88, "undistorted with the photo"
    focal = 2 * glass_scene.FOCAL
    drawn = {}
    for shot in (taken[1], taken[6]):
        local = PANE @ shot.pose.rotation.T + shot.pose.translation
        drawn[shot.name] = (local[:, :2] / local[:, 2:] * focal + (160, 120)).round(2).tolist()
    marks(photos, panes={"window": drawn})
    capsys.readouterr()
    again = plan(capsys, *words)
    assert "cached" in again["sfm"], "marks do not concern the poses"
    assert "to run" in again["masks"]
    assert main(["run", *words]) == 0
    (other,) = (path for path in (root / "runs").iterdir() if path.is_dir() and path != run)
    carried = MaskReport.read(other)
    assert carried.method == "polygon"
    error = float(carried.notes[0].split("carried corners ")[1].split(" %")[0])
    assert error < 0.6, "per cent of the photo: poses and lens are estimated"


def test_the_networks_are_registered(capsys, weights, tmp_path):
    glass_scene.write_networks(weights)
    assert main(["weights", "status"]) == 0
    shown = capsys.readouterr().out
    for name in ("grounding_dino", "grounding_dino_tokenizer", "sam2_encoder", "sam2_decoder"):
        assert f"\n{name}: " in f"\n{shown}"
        assert REGISTRY[name].filename in shown
    files = find_networks(SETTINGS)
    before = dict(files.digests)
    (weights / "sam2/vision_encoder.onnx_data").write_bytes(b"weights")
    assert dict(files.digests)["encoder"] != before["encoder"], "weights beside the graph count"
    assert dict(files.digests)["tokenizer"] == before["tokenizer"] == file_digest(files.tokenizer)
    named = replace(SETTINGS, detector=replace(DETECTOR, file=str(weights / "grounding_dino/model.onnx")))
    assert find_networks(named).tokenizer == files.tokenizer
    with pytest.raises(PrepareError, match=r"masks.segmenter.encoder=/nowhere.onnx does not exist"):
        find_networks(replace(SETTINGS, segmenter=SegmenterSettings(encoder="/nowhere.onnx")))
    files.decoder.unlink()
    with pytest.raises(MissingWeights, match=r"weights missing: sam2/decoder.onnx .*onnx-community/sam2.1"):
        find_networks(SETTINGS)
