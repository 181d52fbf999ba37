from __future__ import annotations

import csv
import dataclasses
import io

import pytest

from rtgs.evaluate.publish import Measured, TableSpec, build_table
from rtgs.evaluate.records import METRICS, EvaluationTable, RunFacts, ViewScore
from rtgs.evaluate.table_formats import comma_separated, latex, markdown, page, write_table


def run(
    method: str,
    scene: str,
    psnr: float,
    *,
    seed: int = 0,
    lpips: float | None = 0.2,
    masked: float | None = None,
    views: int = 2,
    preset: str = "quick",
) -> Measured:
    values: dict[str, float | None] = dict.fromkeys(METRICS)
    values |= {"psnr": psnr, "ssim": 0.9, "lpips_01": lpips, "psnr_masked": masked}
    rows = tuple(ViewScore(f"{k}.png", 64, 48, None, dict(values)) for k in range(views))
    facts = RunFacts(scene, method, preset, 2000, 1000, 60.0, 500.0)
    return Measured(EvaluationTable(facts, rows), seed, paper_scene={"ball_statue": "ballstatue"}.get(scene, scene))


STAND_IN = TableSpec("table2", "Table 2", "stand_in")


def test_places_go_to_the_best_of_each_scene_and_ties_share_them():
    runs = [run("3dgs", "a", 25.0), run("envgs", "a", 27.0), run("rtgs", "a", 27.004), run("2dgs", "a", 24.0)]
    table = build_table(STAND_IN, [*runs, run("rtgs", "b", 20.0)])
    places = {method: cell.ranks.get("psnr") for (method, scene), cell in table.cells.items() if scene == "a"}
    assert places == {"3dgs": 3, "envgs": 1, "rtgs": 1, "2dgs": None}  # equal to the printed digit
    alone = table.cell("rtgs", "b")
    assert alone is not None
    assert alone.ranks == {}
    assert table.cell("3dgs", "b") is None


def test_lower_is_better_for_lpips():
    table = build_table(STAND_IN, [run("envgs", "a", 25.0, lpips=0.3), run("rtgs", "a", 24.0, lpips=0.2)])
    ranks = {method: cell.ranks for (method, _), cell in table.cells.items()}
    assert ranks["rtgs"]["lpips_01"] == 1
    assert ranks["envgs"]["lpips_01"] == 2


def test_seeds_give_mean_and_sample_deviation():
    table = build_table(STAND_IN, [run("rtgs", "a", psnr, seed=k) for k, psnr in enumerate((24.0, 25.0, 26.0))])
    cell = table.cell("rtgs", "a")
    assert cell is not None
    value = cell.values["psnr"]
    assert value is not None
    assert (value.mean, value.spread, value.seeds) == (25.0, 1.0, 3)
    assert "25.00 ± 1.00" in markdown(table)
    assert r"25.00 $\pm$ 1.00" in latex(table)
    assert "over 3 seeds" in page(table)


@pytest.mark.parametrize("data", ["stand_in", "own"])
def test_differences_to_the_paper_exist_only_on_the_papers_data(tmp_path, data):
    """The scenes are even called like the paper's: what decides is whose data they are."""
    runs = [run("rtgs", "sedan", 30.0), run("envgs", "ball_statue", 29.0)]
    texts = {
        path.suffix: path.read_text() for path in write_table(tmp_path, build_table(TableSpec("t", "T", data), runs))
    }
    for text in texts.values():
        for trace in ("ours - paper", "minus_paper", "paper_psnr", "Against the paper"):
            assert trace not in text
        for trace in ("26.2", "25.5", "0.728", "ublished"):
            assert (trace in text) == (data == "stand_in")
    if data == "stand_in":
        assert "not comparable" in texts[".md"]
    same = {
        path.suffix: path.read_text() for path in write_table(tmp_path, build_table(TableSpec("t", "T", "paper"), runs))
    }
    assert "26.20 / 0.728 / 0.298" in same[".md"]
    assert "| +3.80 / +0.172 / -0.098 |" in same[".md"]
    assert "& +3.80" in same[".tex"]
    assert "<td>+3.80" in same[".html"]
    sedan = next(row for row in csv.DictReader(io.StringIO(same[".csv"])) if row["scene"] == "sedan")
    assert (float(sedan["paper_psnr"]), float(sedan["psnr_minus_paper"])) == (26.203, pytest.approx(3.797))


def test_first_second_and_third_are_marked_in_every_format(tmp_path):
    runs = [
        run(method, "a", psnr) for method, psnr in (("2dgs", 25.0), ("3dgs", 26.0), ("envgs", 27.0), ("rtgs", 28.0))
    ]
    texts = {path.suffix: path.read_text() for path in write_table(tmp_path, build_table(STAND_IN, runs))}
    marks = {
        ".md": ("**28.00**", "<u>27.00</u>", "*26.00*"),
        ".tex": (r"\textbf{28.00}", r"\underline{27.00}", r"\textit{26.00}"),
        ".html": ("<b class=first>28.00</b>", "<b class=second>27.00</b>", "<b class=third>26.00</b>"),
    }
    for suffix, three in marks.items():
        for mark in three:
            assert texts[suffix].count(mark) == 1
        assert texts[suffix].count("25.00") == 1
    ranks = {row["method"]: row["psnr_rank"] for row in csv.DictReader(io.StringIO(texts[".csv"]))}
    assert ranks == {"rtgs": "1", "envgs": "2", "3dgs": "3", "2dgs": ""}


def test_on_the_papers_data_the_difference_has_its_own_column():
    table = build_table(TableSpec("table2", "Table 2", "paper"), [run("rtgs", "ball_statue", 26.153)])
    assert "| +0.10 / +0.015 / +0.026 |" in markdown(table)
    row = next(csv.DictReader(io.StringIO(comma_separated(table))))
    differences = [float(row[f"{name}_minus_paper"]) for name in ("psnr", "ssim", "lpips")]
    assert differences == pytest.approx([0.1, 0.015, 0.026])
    assert "stand-in" not in markdown(table)
    without = build_table(TableSpec("table2", "Table 2", "paper"), [run("rtgs", "ball_statue", 26.153, lpips=None)])
    assert "| +0.10 / +0.015 / n/a |" in markdown(without)


def test_another_schedule_than_the_papers_is_told_beside_its_figures():
    quick, whole = (
        markdown(build_table(TableSpec("t", "T", "paper"), [run("rtgs", "sedan", 26.0, preset=preset)]))
        for preset in ("quick", "paper")
    )
    assert "differences of preset quick to them are no verdict" in quick
    assert "no verdict" not in whole


def test_notes_tell_views_of_each_scene_fewer_seeds_and_empty_cells():
    runs = [run("rtgs", "a", 30.0, views=3, seed=seed) for seed in range(2)] + [run("2dgs", "b", 29.0)]
    text = markdown(build_table(STAND_IN, runs))
    assert "Preset quick; a 64x48, 3 test views; b 64x48, 2 test views." in text
    assert "over 2 seeds (1 where runs are missing)" in text
    assert "Empty cells: the run failed, or was not asked for." in text
    assert "Empty cells" not in markdown(build_table(STAND_IN, runs[:2]))


def test_own_scenes_have_no_paper():
    assert "paper" not in markdown(build_table(TableSpec("t", "My captures"), [run("rtgs", "sedan", 30.0)])).lower()


def test_what_was_not_measured_says_so():
    text = markdown(build_table(STAND_IN, [run("rtgs", "a", 30.0, lpips=None)]))
    assert "n/a" in text
    assert "LPIPS: not measured" in text
    assert "in the mask" not in text.split("## ")[1].splitlines()[2]  # a cost column that nobody has is left out


def test_four_files_that_hold_the_same_figures(tmp_path):
    table = build_table(STAND_IN, [run("rtgs", "a_b", 30.125, masked=22.5), run("2dgs", "a_b", 29.0, masked=21.0)])
    paths = write_table(tmp_path / "table2", table)
    assert [path.name for path in paths] == ["table.md", "table.csv", "table.tex", "table.html"]
    texts = {path.suffix: path.read_text() for path in paths}
    assert "**30.12**" in texts[".md"]
    assert r"\textbf{30.12}" in texts[".tex"]
    assert r"a\_b" in texts[".tex"]
    assert "<b class=first>30.12</b>" in texts[".html"]
    rows = list(csv.DictReader(io.StringIO(texts[".csv"])))
    assert [(row["method"], float(row["psnr"]), float(row["psnr_masked"])) for row in rows] == [
        ("rtgs", 30.125, 22.5),
        ("2dgs", 29.0, 21.0),
    ]
    assert not list(tmp_path.rglob("*.tmp"))


def test_names_cannot_break_the_page():
    text = page(build_table(STAND_IN, [run("<script>", "a|b", 30.0)]))
    assert "<script>" not in text
    assert "a\\|b" in markdown(build_table(STAND_IN, [run("m", "a|b", 30.0)]))


def test_the_same_run_twice_and_no_run_are_refused():
    with pytest.raises(ValueError, match="comes twice"):
        build_table(STAND_IN, [run("rtgs", "a", 30.0), run("rtgs", "a", 31.0)])
    with pytest.raises(ValueError, match="has no runs"):
        build_table(STAND_IN, [])
    with pytest.raises(ValueError, match=r"table\.data='mine'"):
        TableSpec("t", "T", "mine")


BLOCKS = TableSpec("table3", "Table 3", "paper", {"rtgs_printed": "As printed", "rtgs": "Ours"})


def test_two_blocks_stand_and_compete_by_themselves(tmp_path):
    rows = [
        ("rtgs_printed", 20.0),
        ("rtgs_printed, no_depth_loss", 19.0),
        ("rtgs", 27.0),
        ("rtgs, no_depth_loss", 26.0),
    ]
    table = build_table(BLOCKS, [run(method, "ball_statue", psnr, masked=psnr - 3) for method, psnr in rows])
    ranks = {method: cell.ranks["psnr"] for (method, _), cell in table.cells.items()}
    assert ranks == {"rtgs_printed": 1, "rtgs_printed, no_depth_loss": 2, "rtgs": 1, "rtgs, no_depth_loss": 2}
    text = markdown(table)
    first, second = text.index("## As printed\n"), text.index("## Ours\n")
    assert first < text.index("| rtgs_printed | **20.00**") < second < text.index("| rtgs | **27.00**")
    assert "## As printed: Inside the mask" in text
    texts = {path.suffix: path.read_text() for path in write_table(tmp_path, table)}
    assert "As printed" in texts[".tex"]
    assert "<h2>As printed</h2>" in texts[".html"]
    printed = table.cell("rtgs_printed, no_depth_loss", "ball_statue")
    assert printed is not None
    assert printed.paper is not None
    assert printed.paper.psnr == 25.941  # the paper's row, for both blocks


def test_every_way_in_which_runs_differ_from_the_paper_stands_under_its_figures():
    short, own = "schedule.total is 2000 instead of 60000", "method.optics.max_gain is 1 instead of 0"
    runs = [
        dataclasses.replace(run("rtgs_printed", "sedan", 20.0), differs=(short,)),
        dataclasses.replace(run("rtgs", "sedan", 21.0), differs=(short, own)),
        dataclasses.replace(run("2dgs", "sedan", 21.0), differs=("the paper has no such row",)),
    ]
    text = markdown(build_table(TableSpec("t", "T", "paper"), runs))
    assert f"- All runs differ from the paper: {short}." in text
    assert f"- rtgs also differs from the paper: {own}." in text
    assert "rtgs_printed also" not in text
    assert "no such row" not in text
    assert short not in markdown(build_table(TableSpec("t", "T", "stand_in"), runs))  # no figures of the paper there


def test_cells_are_escaped_for_latex_and_for_spreadsheets():
    spec = TableSpec("t", "A $10^3 ~ {x}_1 & #2 \\write18{rm} 100 %", "own")
    table = build_table(spec, [run("=cmd|'/c calc'!A1", "@sum{a}", 25.0)])
    text = latex(table)
    assert r"A \$10\textasciicircum{}3 \textasciitilde{} \{x\}\_1 \& \#2 \textbackslash{}write18\{rm\} 100 \%" in text
    assert r"@sum\{a\}" in text
    row = next(csv.DictReader(io.StringIO(comma_separated(table))))
    assert row["method"] == "'=cmd|'/c calc'!A1"
    assert row["scene"] == "'@sum{a}"
    assert float(row["psnr"]) == 25.0


def test_every_published_row_stands_beside_what_was_run_in_columns_of_its_own(tmp_path):
    runs = [run("rtgs", "ball_statue", 28.0), run("NU-NeRF", "ball_statue", 21.0), run("2dgs", "ball_statue", 27.0)]
    table = build_table(STAND_IN, runs)
    lines = markdown(table).splitlines()
    marked = "ballstatue published, on the papers' data: PSNR / SSIM / LPIPS"
    assert lines[2].split(" | ")[-1] == f"{marked} |"
    rows = {line.split(" | ")[0].strip("| "): line for line in lines[4 : lines.index("", 4)]}
    assert rows["rtgs"].endswith("| 26.05 / 0.885 / 0.174 |")
    assert rows["NU-NeRF"].endswith("| 23.45 / 0.706 / 0.345 |")  # a label of another program finds its row
    assert rows["2dgs"].endswith("|  |")  # the paper has none
    assert rows["ref_gaussian"].count("|  ") == 4  # not run: nothing but what is published
    assert rows["ref_gaussian"].endswith("| 15.14 / 0.660 / 0.479 |")
    assert not {"nu_nerf", "rtgs, no_depth_loss"} & rows.keys()
    assert "Rows that have published figures alone were not run here." in "\n".join(lines)
    assert all(cell.ranks.get("psnr") for cell in table.cells.values())  # published figures take no place
    found = {row["method"]: row for row in csv.DictReader(io.StringIO(comma_separated(table)))}
    assert (found["envgs"]["psnr"], found["envgs"]["published_psnr"]) == ("", "25.508")
    assert (found["2dgs"]["psnr"], found["2dgs"]["published_psnr"]) == ("27.0", "")
    texts = {path.suffix: path.read_text() for path in write_table(tmp_path, table)}
    assert all("15.14 / 0.660 / 0.479" in texts[suffix] for suffix in (".md", ".tex", ".html"))


def test_a_method_that_the_paper_does_not_have_has_a_row_without_published_figures(tmp_path):
    runs = [run("3dgs_dr", "sedan", 25.0), run("envgs", "sedan", 26.0)]
    for data in ("stand_in", "paper"):
        table = build_table(TableSpec("table1", "Table 1", data), runs)
        assert table.methods == ("3dgs_dr", "envgs")
        assert [row for row, _ in table.published].count("3dgs_dr") == 0
        row = next(line for line in markdown(table).splitlines() if line.startswith("| 3dgs_dr |"))
        assert "*25.00*" in row or "<u>25.00</u>" in row
        assert "26.14" not in row
        texts = {path.suffix: path.read_text() for path in write_table(tmp_path / data, table)}
        assert all("25.00" in text for suffix, text in texts.items() if suffix != ".csv")
        cells = next(row for row in csv.DictReader(io.StringIO(texts[".csv"])) if row["method"] == "3dgs_dr")
        published = [cells[key] for key in cells if key.startswith(("published_", "paper_")) and key != "paper_scene"]
        assert published
        assert not any(published)


def test_a_judged_row_is_no_ablation():
    rows = [
        {row for row, _ in build_table(STAND_IN, [run(label, "ball_statue", 28.0)]).published}
        for label in ("rtgs", "rtgs, judged")
    ]
    assert "envgs" in rows[0] & rows[1]
    assert not {"rtgs, no_depth_loss"} & (rows[0] | rows[1])


def test_a_table_of_ablations_has_the_papers_ablations_alone():
    runs = [run("rtgs", "ball_statue", 28.0), run("rtgs, no_depth_loss", "ball_statue", 27.0)]
    table = build_table(STAND_IN, runs)
    assert list(dict.fromkeys(row for row, _ in table.published)) == [
        *("rtgs", "rtgs, no_depth_loss", "rtgs, no_transmittance_gaussians", "rtgs, no_specular_loss"),
        "rtgs, no_mesh_guide",
    ]
