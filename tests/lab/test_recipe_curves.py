"""Two recipes' curves: read from tables, paired, drawn, and when the second has caught up."""

from dataclasses import replace
from pathlib import Path

import pytest

from lab.recipe_curves import Pair, draw, paired, read_curves
from rtgs.evaluate.curves import Look, QualityCurve, comma_separated


def curve(*points: tuple[float, float], scene: str = "room", method: str = "2dgs") -> QualityCurve:
    looks = tuple(Look(10 * place, seconds, psnr) for place, (seconds, psnr) in enumerate(points, 1))
    return QualityCurve(scene, method, "quick", 0, looks)


def test_tables_are_read_as_they_were_written(tmp_path: Path):
    curves = [curve((1.5, 20.25), (3.0, 21.0)), curve((2.0, 19.0), method="3dgs")]
    (tmp_path / "table.csv").write_text(comma_separated(curves))
    assert read_curves(tmp_path / "table.csv") == curves


def test_a_table_without_curves_is_told(tmp_path: Path):
    (tmp_path / "table.csv").write_text(comma_separated([]))
    with pytest.raises(ValueError, match="holds no curve"):
        read_curves(tmp_path / "table.csv")


def test_only_what_both_have_is_paired():
    shared, other = curve((1.0, 20.0)), curve((1.0, 20.0), scene="hall")
    assert paired([shared], [other, curve((2.0, 21.0))]) == [Pair(shared, curve((2.0, 21.0)))]
    with pytest.raises(ValueError, match="no scene, method, preset and seed in common"):
        paired([shared], [other])


@pytest.mark.parametrize(
    ("after", "seconds"),
    [
        (((1.0, 19.0), (2.0, 20.5), (3.0, 21.0)), 2.0),
        (((1.0, 20.5), (2.0, 19.5), (3.0, 21.0)), 3.0),  # it fell back
        (((1.0, 20.0), (2.0, 20.0)), 1.0),
        (((1.0, 19.0), (2.0, 19.9)), None),
    ],
)
def test_when_the_second_has_caught_up(after: tuple[tuple[float, float], ...], seconds: float | None):
    pair = Pair(curve((1.0, 15.0), (4.0, 20.0)), curve(*after))
    assert pair.caught_up == seconds
    assert pair.row().endswith("| never |" if seconds is None else f"| {seconds:.0f} |")


def test_a_row_names_the_seed():
    first = curve((1.0, 15.0))
    second = replace(first, seed=2)
    rows = [pair.row() for pair in paired([first, second], [first, second])]
    assert "2dgs, quick |" in rows[0]
    assert "2dgs, quick, seed 2 |" in rows[1]


def test_the_picture_has_a_plot_for_each_scene(tmp_path: Path):
    from skimage.io import imread

    pairs = [Pair(curve((1.0, 15.0), (4.0, 20.0), scene=s), curve((1.0, 16.0), (4.0, 21.0), scene=s)) for s in "abcde"]
    draw(pairs, ("before", "now"), tmp_path / "five.png")
    draw(pairs[:1], ("before", "now"), tmp_path / "one.png")
    five, one = imread(tmp_path / "five.png"), imread(tmp_path / "one.png")
    assert five.shape[0] > 1.5 * one.shape[0]
    assert five.shape[1] > 3 * one.shape[1]
