"""``rtgs export RUN``: files for other programs, and what the words may be."""

# ruff: noqa: F811 (fixtures of app_cases)

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import plyfile
import pytest
import torch

from pipelines.cli.export import ExportWords, parse_words
from pipelines.cli.main import main
from pipelines.publishing.exported_page import BLURRED
from pipelines.publishing.exported_run import BakeRecord, export_run
from rtgs.core.errors import RtgsError
from rtgs.export.bake import BAKE_VERSION, BakeSettings
from rtgs.gaussians.ply import read_gaussians
from rtgs.report.files import BEGIN, END
from rtgs.runs.shown import open_run
from tests.pipelines.app_cases import QUICK, _in_root, capture, root  # noqa: F401  (fixtures)


def _trained(root: Path, capture: Path, *words: str) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        patch.setenv("RTGS_ROOT", str(root))
        assert main(["run", f"scene={capture}", *words, *QUICK]) == 0
    return root / "runs" / words[-1].removeprefix("name=")


@pytest.fixture(scope="module")
def layered(root, capture) -> Path:
    return _trained(root, capture, "method=envgs", "method.reflection.start=0.25", "name=mirror")


@pytest.fixture(scope="module")
def plain(root, capture) -> Path:
    return _trained(root, capture, "method=3dgs", "name=plain")


def test_one_ply_of_all_layers_and_what_it_loses(layered, capsys):
    assert main(["export", "mirror", "steps=20", "threads=1"]) == 0
    told = capsys.readouterr().out
    path = layered / "exports" / "mirror.ply"
    record = json.loads(path.with_suffix(".json").read_text())
    assert f"baked: {record['psnr']:.2f} dB against the layered model on held-out cameras" in told
    assert f"{record['layered_photos'] - record['baked_photos']:.2f} dB lost" in told
    assert "16 of 16 pictures" in told  # from the 8 cameras of the training and 8 between them
    header = plyfile.PlyData.read(str(path))
    assert "SplatRenderMode: 2dgs" in header.comments
    baked = read_gaussians(path)
    assert baked.sh_degree == 3
    assert not baked.channels
    row = told.splitlines()[-1].split()
    assert row[:4] == ["ply", f"{path.stat().st_size / 1e6:.2f}", "MB", f"{len(baked):,}"]
    assert row[4:6] == ["the", "same"]


def test_what_mirrors_lose_is_printed_and_the_page_says_that_they_are_blurred(
    layered, plain, capsys, monkeypatch, tmp_path
):
    monkeypatch.setattr("pipelines.publishing.exported_run._MIRRORS", -1.0)  # all pixels are mirrors
    assert main(["export", "mirror", "steps=20", "format=ply,html", f"out={tmp_path}"]) == 0
    record = json.loads((tmp_path / "mirror.json").read_text())
    assert record["mirrors"] == pytest.approx(record["psnr"], abs=1.0)  # of all pixels, not the mean over views
    assert f"{record['mirrors']:.2f} dB where it mirrors" in capsys.readouterr().out
    assert BLURRED in (tmp_path / "mirror.html").read_text()
    monkeypatch.setattr("pipelines.publishing.exported_run._MIRRORS", 1.0)  # none is
    assert main(["export", "mirror", "steps=20", "splats=400", f"out={tmp_path}"]) == 0
    assert "where it mirrors" not in capsys.readouterr().out
    assert main(["export", "plain", "format=html", f"out={tmp_path}"]) == 0
    assert BLURRED not in (tmp_path / "plain.html").read_text()


def test_the_fit_is_kept_until_the_words_or_the_file_change(layered):
    run, out = open_run(layered), layered / "kept"
    settings = BakeSettings(steps=5)
    first = export_run(run, settings, out)
    made = first.ply.stat().st_mtime_ns
    assert export_run(run, settings, out).record == first.record
    assert first.ply.stat().st_mtime_ns == made
    other = export_run(run, BakeSettings(steps=5, most=30), out)
    assert len(other.splats) <= 30
    with other.ply.open("ab") as file:
        file.write(b"more")
    again = export_run(run, BakeSettings(steps=5, most=30), out)
    assert again.record == other.record
    assert torch.equal(again.splats.means, other.splats.means)


def test_a_fit_of_another_version_is_made_again():
    wanted = BakeRecord({"train_diffuse": "a"}, 5, 0, version=BAKE_VERSION)
    assert replace(wanted, sha256="b", psnr=20.0).fits(wanted)
    for other in ({"version": 0}, {"steps": 6}, {"most": 9}, {"clear": True}, {"trained": {}}):
        assert not replace(wanted, **other).fits(wanted)


def test_a_plain_model_is_written_as_it_is(plain, capsys):
    assert main(["export", str(plain), "format=ply", "threads=1"]) == 0
    told = capsys.readouterr().out
    assert "the model is one set of Gaussians: nothing is lost" in told
    written = read_gaussians(plain / "exports" / "plain.ply")
    model = open_run(plain).method["base"].gaussians
    assert torch.equal(written.means, model.means)
    assert "SplatRenderMode: default" in plyfile.PlyData.read(str(plain / "exports" / "plain.ply")).comments


def test_the_page_of_a_run_links_its_exports(plain):
    (plain / "report.html").write_text(f"<p>before</p>{BEGIN}{END}<p>after</p>", encoding="utf-8")
    assert main(["export", str(plain), "threads=1"]) == 0
    assert 'href="exports/plain.ply"' in (plain / "report.html").read_text(encoding="utf-8")


def test_a_fit_of_a_plain_model_is_refused_and_a_bound_that_it_keeps_is_not(plain, capsys, tmp_path):
    has = len(open_run(plain).method["base"].gaussians)
    for word in ("steps=20", f"splats={has - 1}"):
        assert main(["export", str(plain), word, f"out={tmp_path}"]) == 1
        told = capsys.readouterr().err
        assert f"{word}: the model of plain is one set of {has:,} Gaussians and is written as it is" in told
    assert not any(tmp_path.iterdir())
    assert main(["export", str(plain), f"splats={has}", f"out={tmp_path}"]) == 0
    assert len(read_gaussians(tmp_path / "plain.ply")) == has


def test_every_format_is_read_back_and_measured(layered, capsys, monkeypatch, tmp_path):
    formats = ("ply", "compressed_ply", "spz", "glb", "html")
    assert main(["export", "mirror", "steps=20", f"format={','.join(formats)}"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[-len(formats) :]]
    assert [row[0] for row in rows] == list(formats)
    for row in rows:
        assert Path(row[-1]).is_file()
    for row in rows[1:3]:
        assert float(row[4]) > 30  # dB of the set itself
    assert rows[3][4:6] == ["the", "same"]
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main(["export", "mirror", "format=sog"]) == 1
    assert "npm install -g @playcanvas/splat-transform" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a", "b"], "a and b: one run at a time"),
        (["steps=0"], "steps=0 must be a whole number from 1 to 1000000"),
        (["splats=many"], "splats=many must be a whole number"),
        (["format=gif"], "format=gif holds 'gif': choose some of ply"),
        (["format="], "format= holds ''"),
        (["formats=ply"], "did you mean format="),
        (["out="], "out= needs a place"),
        (["steps=2", "steps=3"], "steps= is given twice"),
        (["--format"], "--format is no word of it"),
    ],
)
def test_words_of_export_that_are_refused(words, message):
    with pytest.raises(RtgsError, match=message):
        parse_words(words)


def test_all_words_of_export_are_optional(capsys):
    assert parse_words([]) == ExportWords()
    assert parse_words(["a", "format=ply,ply", "splats=9"]) == ExportWords("a", splats=9)
    assert main(["export", "--help"]) == 0
    assert "format=NAME" in capsys.readouterr().out
    assert main(["export", "nothing"]) == 1
    assert "no finished run 'nothing'" in capsys.readouterr().err
