"""The report page: self-contained, escaped, honest about absent figures, small."""

import base64
import io
import math
import re
import shutil
import warnings
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from rtgs.core.cameras import Camera
from rtgs.core.decisions import Decision
from rtgs.evaluate.records import METRICS, EvaluationTable, RunFacts, ViewScore
from rtgs.mesh.triangles import TriangleMesh
from rtgs.report.figures import Curve, curve_svg, depth_picture, image_bytes, mesh_picture, normal_picture, outlined
from rtgs.report.files import link_files
from rtgs.report.page import (
    PICTURE_STEPS,
    TARGET_BYTES,
    MeshFigure,
    ReportData,
    ReportView,
    StepLine,
    _duration,
    config_lines,
    pick_views,
    render_report,
    write_report,
)
from rtgs.scenes.truth import ViewTruth

NASTY = "<script>alert('x')</script> & \"quoted\""


class Outline(HTMLParser):
    """Addresses a browser would load, and visible text."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.tags: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def score(view: str, psnr: float, width: int = 48, height: int = 32) -> ViewScore:
    values: dict[str, float | None] = dict.fromkeys(METRICS)
    values |= {"psnr": psnr, "ssim": 0.9, "psnr_8bit": psnr - 0.01, "ssim_8bit": 0.899, "render_seconds": 0.02}
    return ViewScore(view, width, height, None, values)


def table(count: int = 3) -> EvaluationTable:
    rows = tuple(score(f"view_{k}.jpg", 20.0 + k) for k in range(count))
    reasons = {name: "weights missing: vgg" for name in METRICS if name.startswith("lpips")}
    return EvaluationTable(RunFacts("desk", "2dgs", "smoke", 300, 4321, 75.0, 512.0), rows, reasons)


def report_view(name: str, width: int = 48, height: int = 32) -> ReportView:
    generator = torch.Generator().manual_seed(len(name))
    camera = Camera(torch.eye(3), torch.zeros(3), 40.0, 40.0, width / 2, height / 2, width, height)
    photo = torch.rand(3, height, width, generator=generator)
    alpha = torch.ones(height, width)
    alpha[: height // 4] = 0
    normal = torch.zeros(3, height, width)
    normal[2] = -1
    return ReportView(
        name,
        camera,
        photo,
        photo + 0.1,
        "best",
        depth=1 + torch.rand(height, width, generator=generator),
        normal=normal,
        alpha=alpha,
    )


def full_data() -> ReportData:
    steps = tuple(range(0, 500, 50))
    return ReportData(
        title="desk, 2dgs",
        evaluation=table(),
        command="rtgs run scene=desk",
        created="2026-01-02",
        views=(report_view("view_0.jpg"), report_view("view_2.jpg")),
        curves=(
            Curve("train/loss", steps, tuple(1 / (step + 10) for step in steps)),
            Curve("train/psnr", steps, tuple(20 + step / 100 for step in steps)),
            Curve("surfels/base", steps, tuple(1000.0 + 40 * step for step in steps)),
        ),
        steps=(
            StepLine("import_scene", "abcdef0123456789", True, 1.5),
            StepLine("train_diffuse", "12345678ff", False, 75),
        ),
        decisions=(Decision("mono-normal loss", "off: the scene has no normals"),),
        config=config_lines({"loss.normal": 0.04, "seed": 0}, {"loss.normal": 0.05, "seed": 0}),
        machine={"threads": "2", "instruction set": "avx2"},
        mesh=MeshFigure(np.full((20, 30, 3), 90, np.uint8), 1234, 2345, "TSDF"),
        environment=np.full((16, 32, 3), 60, np.uint8),
    )


def outline(page: str) -> Outline:
    parser = Outline()
    parser.feed(page)
    parser.close()
    return parser


def test_page_is_self_contained(tmp_path: Path) -> None:
    size = write_report(tmp_path / "out" / "report.html", full_data())
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert size == len(page.encode())
    parsed = outline(page)
    assert parsed.addresses
    assert all(address.startswith("data:image/") for address in parsed.addresses)
    assert "link" not in parsed.tags
    assert "default-src 'none'" in page
    assert not re.search(r"url\((?!#)", page)
    namespaces = {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}  # names, never fetched
    assert set(re.findall(r"https?://[\w./-]+", page)) <= namespaces
    pictures = [address for address in parsed.addresses if address.startswith("data:image/jpeg")]
    assert (
        len(pictures) == 2 * 7 + 2
    )  # photo, render, error, FLIP, depth, normal, alpha of two views; mesh, environment
    with Image.open(io.BytesIO(base64.b64decode(pictures[0].split(",")[1]))) as picture:
        assert picture.size == (48, 32)


def test_page_shows_flip_of_every_view_and_where_it_is() -> None:
    data = full_data()
    rows = tuple(
        replace(row, values=row.values | {"flip": 0.1 + 0.01 * index, "flip_masked": 0.3 + 0.01 * index})
        for index, row in enumerate(data.evaluation.rows)
    )
    parsed = outline(render_report(replace(data, evaluation=replace(data.evaluation, rows=rows))))
    text = " ".join(" ".join(parsed.text).split())
    assert "FLIP in mask" in text
    assert "difference as it is seen when render and photo alternate" in text
    for figure in ("0.1000", "0.1100", "0.1200", "0.3000", "0.3100", "0.3200"):
        assert figure in text


def test_page_shows_the_figures_and_the_reasons() -> None:
    text = " ".join(" ".join(outline(render_report(full_data())).text).split())
    assert "21.00 dB" in text  # mean of 20, 21, 22
    assert "4,321" in text
    assert "1 min" not in text  # 75 s stay seconds
    assert "75.0 s" in text
    assert "n/a" in text
    assert "weights missing: vgg" in text
    assert "off: the scene has no normals" in text
    assert "abcdef01" in text
    assert "1,234 vertices, 2,345 triangles. TSDF" in text
    assert "loss.normal" in text
    assert "avx2" in text
    assert "instruction set" in text


def test_what_training_views_show_and_the_noise_floor_stand_beside_the_mean() -> None:
    known = table(1)
    rows = (replace(known.rows[0], values=known.rows[0].values | {"psnr_framed": 23.456, "framed_share": 0.875}),)
    known = replace(known, facts=replace(known.facts, noise_psnr=40.43), rows=rows)
    framed = torch.full((32, 48), 12)
    framed[:, :6] = 2
    view = replace(report_view("view_0.jpg"), framed=framed)
    page = render_report(ReportData("known", known, views=(view,)))
    text = " ".join(" ".join(outline(page).text).split())
    assert "PSNR where three views look 23.46 dB 87.5 % of the pixels" in text
    assert "Noise floor 40.43 dB of the test photos themselves" in text
    assert "Coverage" in text
    assert "fewer than 3" in text


def test_optional_parts_leave_no_trace() -> None:
    page = render_report(ReportData("bare", table(1)))
    headings = re.findall(r"<h2>(.*?)</h2>", page)
    assert headings == ["Every test view", "What was run"]
    for absent in ("PSNR in mask", "PSNR where three views look", "Noise floor", "Coverage"):
        assert absent not in page


def test_everything_is_escaped() -> None:
    data = full_data()
    evil_table = replace(
        table(1),
        facts=RunFacts(NASTY, NASTY, NASTY),
        rows=(score(NASTY, 20.0),),
        missing={"lpips_01": NASTY},
    )
    data = replace(
        data,
        title=NASTY,
        evaluation=evil_table,
        command=NASTY,
        created=NASTY,
        views=(replace(report_view(NASTY), role=NASTY),),
        curves=(Curve(f"train/{NASTY}", (0, 1), (1.0, 0.5)), Curve("train/other", (0, 1), (1.0, 0.5))),
        steps=(StepLine(NASTY, NASTY, False, None, NASTY),),
        decisions=(Decision(NASTY, NASTY),),
        config=config_lines({NASTY: NASTY}, {}),
        machine={NASTY: NASTY},
        mesh=MeshFigure(np.zeros((4, 4, 3), np.uint8), 1, 1, NASTY),
    )
    page = render_report(data)
    assert page.count("<script>") == 1  # our own
    assert "alert('x')</script>" not in page
    assert NASTY in " ".join(outline(page).text)


def test_big_pictures_shrink_until_they_fit() -> None:
    generator = torch.Generator().manual_seed(0)
    views, rows = [], []
    for k in range(5):
        view = report_view(f"view_{k}.jpg", 900, 700)  # noise does not compress
        views.append(replace(view, photo=torch.rand(3, 700, 900, generator=generator), depth=None, normal=None))
        rows.append(score(view.name, 20.0, 900, 700))
    page = render_report(ReportData("big", replace(table(), rows=tuple(rows)), views=tuple(views)))
    assert len(page) < TARGET_BYTES + 200_000
    assert f"at most {PICTURE_STEPS[0][0]} pixels" not in page


def test_view_that_was_not_evaluated_is_refused() -> None:
    with pytest.raises(ValueError, match=r"report view 'stray\.jpg' is not among"):
        render_report(ReportData("x", table(), views=(report_view("stray.jpg"),)))


def test_pick_views_spans_best_to_worst() -> None:
    picked = pick_views(table(9), 3)
    assert picked == [(8, "best"), (4, "rank 5 of 9"), (0, "worst")]
    assert pick_views(table(1), 4) == [(0, "")]
    assert [row for row, _ in pick_views(table(2), 4)] == [1, 0]


def test_config_lines_mark_what_differs() -> None:
    lines = config_lines({"b": 1, "a": 2.0, "new": "x"}, {"a": 2.0, "b": 3})
    assert [(line.key, line.changed, line.default) for line in lines] == [
        ("a", False, "2.0"),
        ("b", True, "3"),
        ("new", True, None),
    ]


def test_depth_picture_range_and_holes() -> None:
    depth = torch.linspace(1, 5, 100).reshape(10, 10)
    alpha = torch.ones(10, 10)
    alpha[0] = 0.2
    picture = depth_picture(depth, alpha)
    assert picture is not None
    assert 1.3 < picture.near < picture.far < 5
    assert (picture.pixels[0] == 128).all()
    warm, cold = picture.pixels[1, 0].astype(int), picture.pixels[9, 9].astype(int)
    assert warm[0] > warm[2]  # near is red
    assert cold[2] > cold[1]  # far is blue
    assert depth_picture(torch.zeros(4, 4)) is None
    assert depth_picture(torch.full((4, 4), 2.0)) is not None


def test_normals_are_shown_in_the_camera_frame() -> None:
    quarter = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # world -x is camera z
    camera = Camera(quarter, torch.zeros(3), 5.0, 5.0, 1.0, 1.0, 2, 2)
    facing = torch.zeros(3, 2, 2)
    facing[0] = 1  # camera frame (0, 0, -1): towards the viewer
    assert normal_picture(facing, camera)[0, 0].tolist() == [128, 128, 255]
    assert normal_picture(torch.zeros(3, 2, 2), camera)[0, 0].tolist() == [128, 128, 128]


def test_the_mask_is_outlined_in_the_error_map() -> None:
    mask = torch.zeros(12, 16, dtype=torch.bool)
    mask[3:9, 4:12] = True
    pixels = outlined(np.zeros((12, 16, 3), dtype=np.uint8), mask)
    drawn = pixels.any(-1)
    assert drawn[2:4, 4:12].all()  # one pixel outside, one inside
    assert not drawn[5:7, 6:10].any()
    assert not drawn[:2].any()
    view = report_view("view_0.jpg")
    size = view.photo.shape[1:]
    shown = torch.zeros(size, dtype=torch.bool)
    shown[: size[0] // 2] = True
    for marked, expected in ((shown, True), (torch.zeros(size, dtype=torch.bool), False), (None, False)):
        data = replace(full_data(), views=(replace(view, mask=marked),))
        assert ("outlined: the mask" in render_report(data)) is expected


def test_pictures_are_shrunk_never_enlarged() -> None:
    pixels = np.zeros((30, 60, 3), np.uint8)
    for long_side, size in ((20, (20, 10)), (100, (60, 30))):
        with Image.open(io.BytesIO(image_bytes(pixels, long_side, 90))) as picture:
            assert picture.size == size


def test_many_curves_leave_their_panel_room_and_are_told_apart():
    names = ("l1", "dssim", "normal", "mono_normal", "distortion", "specular", "transmission_depth", "interface_normal")
    curves = [Curve(name, (0, 1), (1.0, 0.5 + 0.1 * index)) for index, name in enumerate(names)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of a legend that takes all the room
        svg = curve_svg(curves, label="Loss terms", log=True)
    assert [svg.count(f">{name}<") for name in names] == [1] * len(names)
    drawn = re.findall(r"style=\"fill: none; (stroke[^\"]*stroke-width: 1.5[^\"]*)\"", svg)
    assert len({style for style in drawn}) == len(names)


def test_curves_skip_what_cannot_be_drawn() -> None:
    svg = curve_svg([Curve("a", (0, 1, 2), (1.0, math.nan, 2.0)), Curve("b", (0, 1), (0.0, -1.0))], label="x", log=True)
    assert svg.startswith("<svg")
    assert "var(--ink-soft)" in svg
    assert "#010203" not in svg
    assert curve_svg([Curve("b", (0, 1), (0.0, -1.0))], label="x", log=True) == ""
    assert curve_svg([], label="x") == ""
    assert curve_svg([Curve("a", (0, 1), (1.0, 2.0))], label="x") == curve_svg(
        [Curve("a", (0, 1), (1.0, 2.0))], label="x"
    )
    with pytest.raises(ValueError, match="2 steps and 1 values"):
        Curve("a", (0, 1), (1.0,))


def test_mesh_picture_shows_clay_and_the_wrong_side() -> None:
    wall = np.array([[-9, -9, 2], [9, -9, 2], [0, 9, 2]], np.float32)
    camera = Camera(torch.eye(3), torch.zeros(3), 10.0, 10.0, 5.0, 5.0, 10, 10)
    facing = mesh_picture(TriangleMesh(wall, np.array([[0, 2, 1]])), camera)
    turned = mesh_picture(TriangleMesh(wall, np.array([[0, 1, 2]])), camera)
    assert (facing[5, 5] > 180).all()
    assert turned[5, 5, 0] > turned[5, 5, 2] + 50
    behind = mesh_picture(TriangleMesh(wall - np.float32([0, 0, 9]), np.array([[0, 1, 2]])), camera)
    assert (behind == 255).all()


def test_layers_stand_beside_their_truth() -> None:
    size = (32, 48)
    light, flat = torch.full((3, *size), 0.2), torch.full(size, 0.25)
    specular, objects = torch.ones(size, dtype=torch.bool), torch.zeros(size, dtype=torch.int16)
    truth = ViewTruth(flat, flat, torch.zeros(3, *size), objects, specular, light, light, 0 * light)
    view = replace(report_view("view_0.jpg"), layers={"reflection": light, "roughness": flat})
    assert 'class="layers"' not in render_report(replace(full_data()))
    untrue = render_report(ReportData("x", table(), views=(view,)))
    assert "Enlarge Reflection, rendered" in untrue
    assert "<th>truth</th>" not in untrue
    page = render_report(ReportData("x", table(), views=(replace(view, truth=truth),)))
    assert page.count("Enlarge Reflection, rendered") == page.count("Enlarge Reflection, truth") == 1
    assert "Enlarge Roughness, truth" not in page
    assert "sRGB encoded" in " ".join(outline(page).text)
    told = render_report(ReportData("x", table(), views=(replace(view, symbols={"reflection": "m C_r"}),)))
    assert "m C_r" in " ".join(outline(told).text)
    assert "C_r" not in " ".join(outline(page).text)


def test_links_lead_to_what_lies_beside_the_page_and_are_renewed(tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    write_report(page, full_data())
    whole = page.read_bytes()
    link_files(page)
    assert page.read_bytes() == whole  # alone: no link
    (tmp_path / "point_cloud.ply").write_bytes(bytes(200_000))
    (tmp_path / "shown" / "a & b").mkdir(parents=True)
    (tmp_path / "shown" / "a & b" / "film.mp4").write_bytes(b"film")
    link_files(page)
    found = outline(page.read_text(encoding="utf-8"))
    assert [each for each in found.addresses if not each.startswith("data:")] == [
        "point_cloud.ply",
        "shown/a%20%26%20b/film.mp4",
    ]
    assert "base set, 0.2 MB" in " ".join(found.text)
    (tmp_path / "point_cloud.ply").unlink()
    shutil.rmtree(tmp_path / "shown")
    link_files(page)
    assert page.read_bytes() == whole


def test_charts_say_what_they_are() -> None:
    svgs = re.findall(r"<svg [^>]*>", render_report(full_data()))
    assert len(svgs) == 3
    assert all('role="img"' in svg and 'aria-label="' in svg for svg in svgs)


@pytest.mark.parametrize(
    ("seconds", "words"), [(85.5, "85.5 s"), (244, "4 min 04 s"), (1878.4, "31 min"), (7300, "2 h 01 min")]
)
def test_durations_fit_a_tile(seconds, words):
    assert _duration(seconds) == words
