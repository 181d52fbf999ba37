"""The classical fallback: marks of a person, GrabCut, and flat panes carried by the poses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rtgs.prepare.errors import PrepareError
from rtgs.prepare.masks.drawn import drawn_kinds, read_drawing
from rtgs.prepare.masks.grabcut import Marks, grab_cut
from rtgs.prepare.masks.plane import fit_pane, pixel_rays, seen_from
from rtgs.prepare.masks.settings import DrawnSettings
from rtgs.scenes.capture import CaptureView, PointCloud
from rtgs.scenes.importers.registry import read_capture
from rtgs.scenes.scene import load_view
from rtgs.scenes.settings import SceneSettings
from rtgs.scenes.undistort import Lens, project
from tests.prepare.glass_scene import FOCAL, HEIGHT, WIDTH, overlap, poses, shots

SETTINGS = DrawnSettings()
VIEWS = ("images/IMG_1.jpg", "images/IMG_2.jpg", "b/IMG_2.jpg")


def drawing(tmp_path: Path, text: str, name: str = "masks.yaml"):
    path = tmp_path / name
    path.write_text(text)
    return read_drawing(path, VIEWS)


def test_a_file_of_marks_is_read(tmp_path):
    text = """
panes:
  door:
    IMG_1: [[1, 2], [3, 4], [5, 6.5]]
    b/IMG_2.jpg: [[1, 2], [3, 4], [-5, 6]]
cutouts:
  images/IMG_2.jpg: {box: [10, 20, 30, 40], inside: [[15, 25]], outside: [[12, 22], [13, 23]]}
"""
    read = drawing(tmp_path, text)
    assert read.marked == ("b/IMG_2.jpg", "images/IMG_1.jpg", "images/IMG_2.jpg")
    np.testing.assert_array_equal(read.panes["door"]["b/IMG_2.jpg"], [[1, 2], [3, 4], [-5, 6]])
    cut = read.cutouts["images/IMG_2.jpg"]
    assert cut.box == (10, 20, 30, 40)
    assert (len(cut.inside), len(cut.outside)) == (1, 2)
    np.testing.assert_allclose(read.shares(cut.inside, (30, 50)), [[0.5, 0.5]])
    assert drawn_kinds(tmp_path / "masks.yaml") == ("panes", "cutouts")
    content = {"units": "fraction", "cutouts": {"IMG_1.jpg": {"inside": [[0.5, 0.25]]}}}
    other = drawing(tmp_path, json.dumps(content), "marks.json")
    np.testing.assert_allclose(other.shares(other.cutouts["images/IMG_1.jpg"].inside, (30, 50)), [[0.5, 0.25]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("panes: [", "cannot be read"),
        ("- 1", "holds list, not the keys units, panes, cutouts"),
        ("pane: {}", "unknown key 'pane': .*did you mean panes"),
        ("units: percent", "units='percent' is unknown"),
        ("panes: {}", "marks nothing"),
        ("panes: {door: [1]}", "panes.door is list, not photo names"),
        ("panes: {door: {IMG_9: [[1, 2], [3, 4], [5, 6]]}}", "no photo IMG_9 with a pose"),
        ("panes: {door: {IMG_2: [[1, 2], [3, 4], [5, 6]]}}", "IMG_2 could be any of images/IMG_2.jpg, b/IMG_2.jpg"),
        ("panes: {door: {IMG_1: [[1, 2], [3, 4]]}}", "has 2 corners: give at least 3"),
        ("panes: {door: {IMG_1: [[1, x], [3, 4]]}}", r"is not a list of \[x, y\]|not a list of"),
        (
            "panes: {d: {IMG_1: [[1, 2], [3, 4], [5, 6]], b/IMG_2.jpg: [[1, 2], [3, 4], [5, 6], [7, 8]]}}",
            "different numbers of corners .*same order",
        ),
        ("cutouts: {IMG_1: {boxes: [1, 2, 3, 4]}}", "give outline, box"),
        ("cutouts: {IMG_1: {box: [5, 2, 3, 4]}}", r"the box of IMG_1 is \[5.0, 2.0, 3.0, 4.0\]"),
        ("cutouts: {IMG_1: {outline: [[1, 2]]}}", "the outline of IMG_1 has 1 corners"),
        ("cutouts: {IMG_1: {outside: [[1, 2]]}}", "has no outline, no box and no click inside"),
    ],
)
def test_a_file_of_another_form_is_a_message(tmp_path, text, message):
    with pytest.raises(PrepareError, match=message):
        drawing(tmp_path, text)


def test_a_file_that_is_not_there_is_a_message(tmp_path):
    with pytest.raises(PrepareError, match="does not exist: write the boxes, clicks or corners into it"):
        read_drawing(tmp_path / "masks.yaml", VIEWS)


def test_grabcut_finds_the_ball_from_a_box_from_clicks_and_from_a_guess():
    shot = shots(3, 240, 180)[1]
    photo = shot.pixels.astype(np.float32) / 255
    rows, columns = np.nonzero(shot.mask)
    size = np.array([240, 180, 240, 180])
    box = tuple((np.array([columns.min() - 8, rows.min() - 8, columns.max() + 8, rows.max() + 8]) / size).tolist())
    assert overlap(grab_cut(photo, Marks(box=box), SETTINGS), shot.mask) > 0.95
    middle = np.array([[columns.mean() / 240, rows.mean() / 180]])
    clicks = Marks(inside=middle, outside=np.array([[0.05, 0.05], [0.95, 0.9]]))
    assert overlap(grab_cut(photo, clicks, SETTINGS), shot.mask) > 0.95
    rough = np.roll(shot.mask, (4, -5), axis=(0, 1))
    cut = grab_cut(photo, Marks(rough=rough), SETTINGS)
    assert overlap(cut, shot.mask) > 0.95 > overlap(rough, shot.mask)
    again = grab_cut(photo, Marks(rough=rough), SETTINGS)
    assert (cut == again).all()
    small = DrawnSettings(grabcut_side=80)
    assert overlap(grab_cut(photo, Marks(box=box), small), shot.mask) > 0.9
    away = grab_cut(photo, Marks(box=(1.2, 1.2, 1.4, 1.4)), SETTINGS)
    assert away.shape == shot.mask.shape
    assert not away.any()


PANE = np.array([[0.0, 0.35, 0.3], [0.0, 1.15, 0.3], [0.0, 1.15, 1.1], [0.0, 0.35, 1.1]])  # on the wall x = 0
LENSES = {
    "pinhole": Lens("PINHOLE", WIDTH, HEIGHT, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)),
    "distorted": Lens("OPENCV", WIDTH, HEIGHT, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, -0.1, 0.02, 0.001, 0.0)),
}


def views_of(lens: Lens, count: int = 6) -> dict[str, CaptureView]:
    return {
        f"{index}": CaptureView(f"{index}", Path(f"{index}"), pose.rotation, pose.translation, lens)
        for index, pose in enumerate(poses(count))
    }


def shares(view: CaptureView, corners: np.ndarray) -> np.ndarray:
    assert view.lens is not None
    local = corners @ view.rotation.T + view.translation
    return project(view.lens, local) / (view.lens.width, view.lens.height)


def true_pane(view: CaptureView) -> np.ndarray:
    """(H, W) bool by intersecting every pixel's ray with the wall."""
    assert view.lens is not None
    rays = pixel_rays(view.lens) @ view.rotation
    spot = view.center + (-view.center[0] / rays[:, 0])[:, None] * rays
    inside = (np.abs(spot[:, 1] - 0.75) < 0.4) & (np.abs(spot[:, 2] - 0.7) < 0.4)
    return inside.reshape(view.lens.height, view.lens.width)


@pytest.mark.parametrize("kind", sorted(LENSES))
def test_a_pane_drawn_in_two_photos_is_carried_to_all(kind):
    views = views_of(LENSES[kind])
    rng = np.random.default_rng(0)
    drawn = {name: shares(views[name], PANE) + rng.normal(0, 0.5 / WIDTH, (4, 2)) for name in ("0", "3")}
    pane = fit_pane("door", drawn, views, None, SETTINGS)
    assert abs(pane.normal[0]) > 0.998, "within 3.6 degrees of the wall"
    np.testing.assert_allclose(pane.corners, PANE, atol=0.04)
    assert pane.angle > 30
    assert max(pane.error.values()) < 0.005
    seen = np.array([seen_from(pane, view, lens) for view in views.values() if (lens := view.lens)])
    truth = np.array([true_pane(view) for view in views.values()])
    assert overlap(seen, truth) > 0.94


def test_exact_corners_give_the_exact_pane():
    views = views_of(LENSES["distorted"], 8)
    drawn = {name: shares(views[name], PANE) for name in ("0", "2", "7")}
    pane = fit_pane("door", drawn, views, None, SETTINGS)
    np.testing.assert_allclose(pane.corners, PANE, atol=1e-5)
    behind = CaptureView("b", Path("b"), np.diag([-1.0, 1.0, -1.0]) @ views["0"].rotation, np.array([0, 0, 5.0]), None)
    turned = CaptureView("b", Path("b"), behind.rotation, -behind.rotation @ views["0"].center, LENSES["pinhole"])
    assert not seen_from(pane, turned, LENSES["pinhole"]).any(), "it lies behind this camera"
    half = LENSES["pinhole"].resized(WIDTH // 2, HEIGHT // 2)
    assert seen_from(pane, views["0"], half).shape == (HEIGHT // 2, WIDTH // 2)


def test_a_pane_on_an_embedded_scene_lies_on_the_plane_its_truth_says():
    """The table of ``matte_room``, drawn in two photos; the depths of the test views say where it truly is."""
    capture = read_capture(SceneSettings(path="embedded:matte_room"))
    views = {view.name: view for view in capture.views}
    table = np.array([[0.25, -0.4, 0.0], [0.6, -0.4, 0.0], [0.6, 0.2, 0.0], [0.25, 0.2, 0.0]])  # a free part of its top
    drawn = {name: shares(views[name], table) for name in (capture.views[3].name, capture.views[20].name)}
    pane = fit_pane("table", drawn, views, None, SETTINGS)
    assert abs(pane.normal[2]) > 0.9999
    seen = 0
    for view in [view for view in capture.views if view.truth is not None][:4]:
        truth = load_view(view, SceneSettings(), with_truth=True).truth
        assert truth is not None
        assert view.lens is not None
        inside = seen_from(pane, view, view.lens)
        rays = pixel_rays(view.lens) @ view.rotation  # z is 1 in the camera: reach is z-depth
        reach = (((pane.corners[0] - view.center) @ pane.normal) / (rays @ pane.normal)).reshape(inside.shape)
        error = (truth.depth.numpy() - reach)[inside]
        shown = error > -0.01  # else something stands before it
        seen += int(shown.sum())
        assert (np.abs(error[shown]) < 0.003).mean() > 0.98
    assert seen > 2000


def test_one_photo_and_points_on_the_frame_are_enough():
    views = views_of(LENSES["pinhole"])
    rng = np.random.default_rng(1)
    wall = np.column_stack([rng.normal(0, 0.003, 90), rng.uniform(0.2, 1.3, 90), rng.uniform(0.2, 1.2, 90)])
    wall = wall[(np.abs(wall[:, 1:] - (0.75, 0.7)) > 0.4).any(axis=1)]  # the frame; glass itself has no points
    behind = np.column_stack([np.full(80, -0.5), rng.uniform(0.2, 1.3, 80), rng.uniform(0.2, 1.2, 80)])  # a back plate
    inside = behind[seen_in(views["1"], PANE, behind)]
    points = PointCloud(np.concatenate([wall, inside]), np.zeros((len(wall) + len(inside), 3)))
    assert len(inside) > len(wall)
    drawn = {"1": shares(views["1"], PANE)}
    pane = fit_pane("door", drawn, views, points, SETTINGS)
    np.testing.assert_allclose(pane.corners, PANE, atol=0.04)
    assert "plane through the points around it" in pane.origin
    assert overlap(seen_from(pane, views["4"], LENSES["pinhole"]), true_pane(views["4"])) > 0.93
    advice = "draw it in a second photo"
    with pytest.raises(PrepareError, match=f"the capture has no points: {advice}"):
        fit_pane("door", drawn, views, None, SETTINGS)
    with pytest.raises(PrepareError, match=f"points are seen around it: {advice}"):
        fit_pane("door", drawn, views, points.select(np.arange(5)), SETTINGS)
    scattered = PointCloud(rng.uniform((-1, 0.1, 0.1), (0.2, 1.4, 1.3), (200, 3)), np.zeros((200, 3)))
    with pytest.raises(PrepareError, match=f"lie on one plane: {advice}"):
        fit_pane("door", drawn, views, scattered, SETTINGS)


def seen_in(view: CaptureView, pane: np.ndarray, points: np.ndarray) -> np.ndarray:
    from matplotlib.path import Path as Outline

    return Outline(shares(view, pane)).contains_points(shares(view, points))


def test_panes_that_cannot_be_are_messages():
    views = views_of(LENSES["pinhole"], 6)
    near = {"0": views["0"], "n": CaptureView("n", Path("n"), *moved(views["0"], 0.02), LENSES["pinhole"])}
    with pytest.raises(PrepareError, match=r"under 0.* degrees only, its depth would be a guess"):
        fit_pane("door", {name: shares(view, PANE) for name, view in near.items()}, near, None, SETTINGS)
    mixed = {"0": shares(views["0"], PANE), "3": shares(views["3"], PANE[[2, 3, 0, 1]])}
    with pytest.raises(PrepareError, match=r"same order in every photo|same corners in the same order"):
        fit_pane("door", mixed, views, None, SETTINGS)


def moved(view: CaptureView, shift: float) -> tuple[np.ndarray, np.ndarray]:
    return view.rotation, -view.rotation @ (view.center + np.array([0.0, shift, 0.0]))
