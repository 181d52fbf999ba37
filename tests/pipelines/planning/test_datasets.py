"""The papers' datasets on small folders of their exact structure, and on folders that lack something."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pipelines.cli.main import main
from pipelines.planning.datasets import TITLES, VIEWS, dataset_states
from pipelines.planning.graph import build_graph
from rtgs.config import compose
from rtgs.config.locate import choices_of, project_root
from rtgs.config.sweep import compose_jobs
from rtgs.core.errors import RtgsError
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import CaptureError
from tests.scenes.captures import ColmapCapture, save_image

VIEW_COUNT = 9
SIZE = (64, 48)
NU_NERF = {"ballstatue": 1080, "popcorncup_all": 1080, "real_bottle": 720, "tall_bottle": 1080}  # method.md 8.2
NU_NERF_SCENES = [f"nu_nerf/{name}" for name in ("ballstatue", "popcorncup", "real_bottle", "tall_bottle")]
REF_REAL = ("sedan", "gardenspheres", "toycar")  # method.md 8.1


@pytest.fixture(scope="module")
def data_root(tmp_path_factory) -> Path:
    """Both datasets as they are downloaded, with tiny photos: shrunk copies beside the full ones, masks."""
    root = tmp_path_factory.mktemp("data")
    for scene in REF_REAL:
        folder = ColmapCapture(root / "ref_real" / scene, VIEW_COUNT).write()
        for size in (4, 8):  # the shrunk copies that come along are not to be read
            for photo in (folder / "images").iterdir():
                save_image(folder / f"images_{size}" / photo.name, np.zeros((SIZE[1] // size, SIZE[0] // size, 3)))
        (folder / "poses_bounds.npy").write_bytes(b"of LLFF, not read")
    for scene, size in NU_NERF.items():
        folder = root / "nu_nerf" / scene
        lens = {"model": "SIMPLE_RADIAL", "params": (60.0, 32.0, 24.0, 0.02)}
        ColmapCapture(folder, VIEW_COUNT, folder="colmap/sparse/0", images_dir=f"images_{size}", **lens).write()
        (folder / "meta_info.txt").write_text("0 0 1\n0 1 0\n")
        (folder / "cache.pkl").write_bytes(b"of NU-NeRF, not read")
        mask = np.zeros((SIZE[1], SIZE[0]), dtype=np.uint8)
        mask[20:30, 20:40] = 255
        for photo in (folder / f"images_{size}").iterdir():
            save_image(folder / "mask_erosion" / f"{photo.stem}.png", mask)
    return root


@pytest.fixture
def root(data_root, tmp_path, monkeypatch) -> Path:
    """A copy that a test may spoil."""
    shutil.copytree(data_root, tmp_path / "data")
    monkeypatch.setenv("DATA_ROOT", str(tmp_path / "data"))
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path))
    return tmp_path / "data"


def test_every_scene_of_the_papers_imports_at_its_size_and_split(root):
    for scene in REF_REAL:
        loaded = load_scene(compose([f"scene=ref_real/{scene}", "preset=paper"])[0].scene)
        sizes = {(view.camera.width, view.camera.height) for view in (*loaded.train, *loaded.test)}
        assert sizes == {(16, 12)}  # a quarter of the full photo, not images_4
        assert max(view.image.max() for view in loaded.train) > 0.5
        assert [view.name for view in loaded.test] == ["photo_00.png", "photo_08.png"]
    for scene in (choice for choice in choices_of("scene") if choice.startswith("nu_nerf/")):
        loaded = load_scene(compose([f"scene={scene}", "preset=paper"])[0].scene)
        view = loaded.train[0]
        assert abs(view.camera.width - SIZE[0]) <= 4  # whole photos, undistorted
        assert view.mask is not None
        assert 0.02 < view.mask.float().mean() < 0.2
        assert len(loaded.test) == 2


@pytest.mark.parametrize(
    ("data", "table", "scenes"),
    [
        ("ref_real", "table1", [f"ref_real/{name}" for name in REF_REAL]),
        (
            "nu_nerf",
            "table2",
            [f"nu_nerf/{name}" for name in ("ballstatue", "popcorncup", "real_bottle", "tall_bottle")],
        ),
        ("nu_nerf", "table3", ["nu_nerf/ballstatue"]),
        ("ref_real", "fig-split-sum", ["ref_real/sedan"]),
    ],
)
def test_the_tables_run_on_the_papers_data(root, data, table, scenes):
    """What `make reproduce-... DATA=...` checks and passes on: it composes and has a graph."""
    shown = subprocess.run(
        ["make", "-n", f"reproduce-{table}", f"DATA={data}", "PRESET=smoke"],
        cwd=project_root(),
        capture_output=True,
        text=True,
        check=True,
    )
    check, run = (line for line in shown.stdout.splitlines() if "/rtgs " in line)
    assert check.endswith(f"rtgs check data={data} scene={','.join(scenes)}")
    assert [state.choice for state in dataset_states(data, scenes)] == scenes
    few = ["method=2dgs"] if table in ("table1", "table2") else []
    jobs, sweep = compose_jobs([*run.split("rtgs run ")[1].split(), *few], multirun=False)
    assert sweep
    assert sorted({job.choices.scene_file for job in jobs if job.choices}) == sorted(scenes)
    for job in jobs:
        assert job.config is not None
        assert job.choices is not None
        assert job.config.table.data == "paper"
        build_graph(job.config, job.choices)


@pytest.mark.parametrize(
    ("table", "data", "fits"),
    [("table1", "nu_nerf", "ref_real"), ("table2", "ref_real", "nu_nerf"), ("table3", "x", "")],
)
def test_a_table_on_the_data_of_another_is_refused(table, data, fits):
    """Also where the scenes are named, and nothing else would look at DATA."""
    words = ["make", "-n", f"reproduce-{table}", f"DATA={data}", "RUN=scene=sedan"]
    done = subprocess.run(words, cwd=project_root(), capture_output=True, text=True)
    assert done.returncode == 2
    assert f"DATA={data}: this table is of stand_in or {fits}" in done.stderr


def test_panels_of_the_papers_data_are_refused_before_any_table_is_made():
    words = ["make", "-n", "reproduce-figures", "DATA=ref_real"]
    done = subprocess.run(words, cwd=project_root(), capture_output=True, text=True)
    assert done.returncode == 2
    assert "rtgs figures FILE" in done.stderr
    assert "rtgs run" not in done.stdout


def test_the_papers_figures_are_not_for_stand_ins():
    with pytest.raises(RtgsError, match=r"scene sedan is a path-traced stand-in.*ref_real"):
        compose(["experiment=table1", "scene=sedan", "table.data=paper"])
    names = [
        compose(["experiment=table1", f"scene={scene}", "method=2dgs"])[0].name for scene in ("sedan", "ref_real/sedan")
    ]
    assert names == ["sedan-2dgs-quick", "ref_real_sedan-2dgs-quick"]


def test_complete_datasets_are_ready(root, monkeypatch, capsys):
    monkeypatch.setattr("pipelines.planning.datasets.VIEWS", dict.fromkeys(VIEWS, VIEW_COUNT))
    for data in TITLES:
        assert main(["check", f"data={data}"]) == 0
        shown = capsys.readouterr().out
        assert shown.count("ready, 9 photos") == len(dataset_states(data))
        assert "remark" not in shown


def test_other_numbers_of_photos_than_the_papers_are_told(root, capsys):
    assert main(["check", "data=ref_real"]) == 0
    assert "9 photos where the papers have 158: figures are not comparable" in capsys.readouterr().out


def test_what_is_missing_is_listed_with_where_it_belongs(root, capsys):
    ref, nu = root / "ref_real", root / "nu_nerf"
    (ref / "sedan" / "sparse" / "0" / "points3D.bin").unlink()
    shutil.rmtree(ref / "toycar" / "images")
    (ref / "gardenspheres" / "images" / "photo_03.png").unlink()
    (nu / "ballstatue" / "colmap" / "sparse").rename(nu / "ballstatue" / "sparse")  # one level too high
    (nu / "real_bottle" / "images_720").rename(nu / "real_bottle" / "images_1080")
    shutil.rmtree(nu / "popcorncup_all")
    shutil.rmtree(nu / "tall_bottle" / "mask_erosion")

    assert main(["check", "data=ref_real"]) == 1
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert str(ref / "sedan/sparse/0/points3D.bin") in lines
    others = "there is images_4, images_8: another size, whose figures are others"
    assert f"{ref / 'toycar/images'}/ with the photos ({others})" in lines
    assert str(ref / "gardenspheres/images/photo_03.png") in lines
    assert lines[-1] == "0 of 3 scenes are ready"

    assert main(["check", "data=nu_nerf"]) == 1
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    model = nu / "ballstatue" / "colmap" / "sparse" / "0"
    for part in ("cameras", "images", "points3D"):
        assert f"{model / part}.bin (there is a model in sparse/0/: move it)" in lines
    assert any(
        line.startswith(f"{nu / 'real_bottle/images_720'}/ with the photos (there is images_1080") for line in lines
    )
    assert f"{nu / 'popcorncup_all/colmap/sparse/0/cameras.bin'}" in lines
    assert f"{nu / 'popcorncup_all/images_1080'}/ with the photos" in lines
    assert f"remark: without {nu / 'tall_bottle/mask_erosion'}/, no figures inside the mask, and methods" in "\n".join(
        lines
    )
    assert lines[-1] == "1 of 4 scenes are ready; with what is there: RUN='scene=nu_nerf/tall_bottle'"


@pytest.mark.parametrize("method", ["rtgs", "rtgs_printed"])
def test_without_its_masks_a_scene_is_refused_by_methods_that_see_through_glass(root, method):
    """Else a row would be called by the method, and compared with the paper's, without its third stage."""
    masks = root / "nu_nerf" / "tall_bottle" / "mask_erosion"
    shutil.rmtree(masks)
    words = ["scene=nu_nerf/tall_bottle", f"method={method}", "preset=smoke"]
    with pytest.raises(CaptureError, match=f"{masks}.*{method} would train without its stage"):
        build_graph(*compose(words))
    for way in ("ablation=two_stages", "masks=none"):
        assert build_graph(*compose([*words, way])).mesh is None
    assert build_graph(*compose(["scene=nu_nerf/tall_bottle", "method=3dgs", "preset=smoke"])).training


def test_only_the_scenes_of_a_table_are_asked_for(root, capsys):
    shutil.rmtree(root / "nu_nerf" / "tall_bottle")
    assert main(["check", "data=nu_nerf", "scene=nu_nerf/ballstatue"]) == 0
    assert "tall_bottle" not in capsys.readouterr().out
    assert main(["check", "data=nu_nerf", "scene=fox"]) == 1
    assert "scene=fox is none of data=nu_nerf" in capsys.readouterr().err
    assert main(["check", "data=nu_nerf", "preset=quick"]) == 1
    assert "'preset=quick' is not understood" in capsys.readouterr().err


def test_an_unknown_dataset_is_refused(capsys):
    assert main(["check", "data=blender"]) == 1
    assert "choose one of ref_real, nu_nerf" in capsys.readouterr().err
