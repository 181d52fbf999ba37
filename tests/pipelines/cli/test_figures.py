"""Figures and curves from runs of a tiny capture, through the command line."""

# ruff: noqa: F811 (fixtures of app_cases)

from __future__ import annotations

import csv
from pathlib import Path

import pytest
import yaml
from PIL import Image

from pipelines.cli.main import main
from pipelines.publishing.figures import Runs, figure_names, read_figure
from rtgs.config.locate import choices_of, conf_dir
from rtgs.core.errors import RtgsError
from rtgs.methods import find_method
from rtgs.report.panels import LAYERS, Box
from tests.pipelines.app_cases import NAMED, QUICK, _in_root, capture, root  # noqa: F401  (fixtures)

KEYS = [word for word in QUICK if not word.startswith("preset=")]


def describe(folder: Path, capture: Path, **changes) -> Path:
    columns = [{"title": "photo", "layer": "photo"}, {"title": "2DGS", "words": ["method=2dgs"]}]
    columns.append({"title": "reflected", "layer": "reflection", "words": ["method=2dgs"]})
    values = {"title": "A test", "rows": [{"scene": str(capture), "crops": [[0.1, 0.1, 0.5, 0.5]]}], "columns": columns}
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump(values | changes))
    return path


def test_a_figure_names_the_runs_it_lacks_and_is_drawn_from_those_there(capture: Path, root: Path, tmp_path, capsys):
    figure = describe(tmp_path, capture)
    words = ["figures", str(figure), "preset=smoke", *KEYS]
    assert main(words) == 1
    told = capsys.readouterr().err
    assert "figure mine: 1 of its 1 runs are not in the store" in told
    assert "rtgs run" in told
    assert "method=2dgs preset=smoke" in told
    assert main(["run", f"scene={capture}", "method=2dgs", *QUICK]) == 0
    capsys.readouterr()
    assert main(words) == 0
    assert "figure: figures/mine-smoke/mine.pdf" in capsys.readouterr().out
    caption = (root / "figures" / "mine-smoke" / "caption.txt").read_text()
    psnr = next(csv.DictReader((root / "runs" / f"tiny_room-2dgs-smoke{NAMED}" / "metrics.csv").open()))["psnr"]
    assert caption.startswith("A test: preset smoke, seed 0. tiny_room, ")
    assert f"2dgs {float(psnr):.2f} dB" in caption
    assert Image.open(root / "figures" / "mine-smoke" / "mine.png").width > 600


def test_rows_and_columns_that_are_none_are_named(capture: Path, tmp_path: Path, capsys):
    assert main(["run", f"scene={capture}", "method=2dgs", *QUICK]) == 0
    figure = describe(tmp_path, capture, rows=[{"scene": str(capture), "view": "no.png"}])
    assert main(["figures", str(figure), "preset=smoke", *KEYS]) == 1
    assert "has no test view 'no.png': it has " in capsys.readouterr().err
    with pytest.raises(RtgsError, match="has no rows, or no column with the words of a run"):
        read_figure(describe(tmp_path, capture, columns=[{"title": "photo", "layer": "photo"}]))
    with pytest.raises(RtgsError, match=r"mine\.yaml cannot be read as a record .*colums"):
        read_figure(describe(tmp_path, capture, colums=[]))
    assert main(["figures", "tabel1"]) == 1
    told = "no figure 'tabel1': there are ablation, decomposition, environment, split_sum, table1, table2"
    assert told in capsys.readouterr().err


@pytest.mark.parametrize("name", figure_names())
def test_shipped_figures_name_scenes_methods_and_layers_that_are_there(name: str):
    spec = read_figure(conf_dir() / "figure" / f"{name}.yaml")
    for row in spec.rows:
        assert row.scene in choices_of("scene")
        assert (conf_dir().parent / "rtgs" / "scenes" / "data" / row.scene / "images" / row.view).is_file()
        assert all(Box(*crop).width > 0 for crop in row.crops)
    for column in spec.columns:
        assert column.layer in LAYERS
    for words in (each.words for each in (*spec.rows, *spec.columns)):
        for word in words:
            group, _, choice = word.partition("=")
            assert choice in choices_of(group)


@pytest.mark.parametrize("name", ["table1", "table2"])
def test_the_figures_of_the_tables_show_all_that_their_tables_run(name: str):
    experiment = yaml.safe_load((conf_dir() / "experiment" / f"{name}.yaml").read_text())
    run = experiment["hydra"]["sweeper"]["params"]
    spec = read_figure(conf_dir() / "figure" / f"{name}.yaml")
    shown = [word.removeprefix("method=") for column in spec.columns for word in column.words]
    assert shown == run["method"].split(",")
    assert {row.scene for row in spec.rows} == set(run["scene"].split(","))


def test_the_figure_of_the_far_light_is_of_the_methods_that_have_one_and_of_runs_of_a_table():
    spec = read_figure(conf_dir() / "figure" / "environment.yaml")
    shown = [word.removeprefix("method=") for row in spec.rows for word in row.words]
    assert shown == [name for name in choices_of("method") if "far_light" in find_method(name).has]
    assert "environment" in {column.layer for column in spec.columns}
    experiment = yaml.safe_load((conf_dir() / "experiment" / "table1.yaml").read_text())
    run = experiment["hydra"]["sweeper"]["params"]
    assert {row.scene for row in spec.rows} <= set(run["scene"].split(","))
    assert set(shown) <= set(run["method"].split(","))


def test_rows_may_be_of_several_methods_on_one_scene(capture: Path, root: Path, tmp_path: Path, capsys):
    rows = [{"scene": str(capture), "words": [f"method={method}"]} for method in ("2dgs", "3dgs_dr")]
    columns = [{"title": "photo", "layer": "photo"}, {"title": "image"}]
    columns.append({"title": "far light", "layer": "environment"})
    figure = describe(tmp_path, capture, rows=rows, columns=columns)
    for method in ("2dgs", "3dgs_dr"):
        assert main(["run", f"scene={capture}", f"method={method}", *QUICK]) == 0
    capsys.readouterr()
    assert main(["figures", str(figure), "preset=smoke", *KEYS]) == 0
    caption = (root / "figures" / "mine-smoke" / "caption.txt").read_text()
    assert "2dgs " in caption
    assert "3dgs_dr " in caption
    runs = Runs([f"paths.root={root}", "preset=smoke", *KEYS])
    spec = read_figure(figure)
    plain, lit = (runs.of(row, spec.columns[2]) for row in spec.rows)
    (view, *_) = lit.scene.test
    assert plain.pixels(view, "environment") is None
    panorama = lit.pixels(view, "environment")
    assert panorama is not None
    assert panorama.shape == (256, 512, 3)
    named = describe(tmp_path, capture, rows=[*rows, {"scene": str(capture)}], columns=columns)
    with pytest.raises(RtgsError, match="has no rows, or no column with the words of a run"):
        read_figure(named)


def test_a_training_that_looks_has_a_curve_and_others_keep_their_keys(capture: Path, root: Path, capsys):
    words = ["run", f"scene={capture}", "method=2dgs", *QUICK]
    assert main(words) == 0
    trainings = len(list(root.glob("store/train_diffuse/*/*/manifest.json")))
    watched = [*words, "watch.steps=[4,8]", "table.kind=time_quality", "table.name=tq", "name=watched"]
    assert main(watched) == 0
    assert len(list(root.glob("store/train_diffuse/*/*/manifest.json"))) == trainings + 1
    told = capsys.readouterr().out
    assert "table: tables/tq/table.md" in told
    assert "table: tables/tq/tiny_room.png" in told
    rows = list(csv.DictReader((root / "tables" / "tq" / "table.csv").open()))
    assert [int(row["steps"]) for row in rows] == [4, 8, 12]
    ends = [next(csv.DictReader((root / "runs" / run / "metrics.csv").open())) for run in ("watched",)]
    assert float(rows[-1]["psnr"]) == pytest.approx(float(ends[0]["psnr"]), abs=0.5)
    assert main([*words, "table.kind=time_quality", "table.name=tq"]) == 1
    assert "was trained without looks along the way: set watch.cpu_seconds or watch.steps" in capsys.readouterr().err
