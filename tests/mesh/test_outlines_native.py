"""The kernels that ask the outlines of masks about points, against the same in torch."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from rtgs.core.cameras import Camera
from rtgs.mesh.hull import _free_views
from rtgs.mesh.outlines import MaskField, Outline, signed_distance, votes
from rtgs.mesh.silhouettes import MaskView
from rtgs.native import core
from tests.mesh import outline_twins
from tests.mesh.shapes import camera_at

COUNTS = (0, 1, 4)
LENS = (1.0, 1.0, 0.0, 0.0)  # of a camera that is asked nothing


def outlines(views: int = 12) -> list[Outline]:
    """Smooth distances in pictures of 37x29; in every second view something opaque hides a part of the object."""
    draw = torch.Generator().manual_seed(3)
    return [outline(camera(k), k % 2 == 0, draw) for k in range(views)]


def camera(k: int) -> Camera:
    away = 2.5 * np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0.3 * (k % 3)])
    return replace(camera_at(away, (0.1, 0.0, 0.2), 37, 29, 30.0), fy=33.0, name=f"{k}")


def outline(camera: Camera, behind: bool, draw: torch.Generator) -> Outline:
    shape = (camera.height, camera.width)

    def smooth() -> torch.Tensor:
        few = torch.randn(1, 1, 5, 6, generator=draw)
        return 4 * torch.nn.functional.interpolate(few, shape, mode="bicubic")[0, 0].contiguous()

    hidden = (smooth() > 1) & behind
    surface = 2.5 + 0.1 * smooth()
    view = MaskView(camera, torch.ones(shape, dtype=torch.bool), surface)
    return Outline(view, hidden, surface if behind else None, smooth(), smooth() if behind else None)


def places(count: int) -> np.ndarray:
    """(count, 3): in the pictures, beside them and behind the cameras."""
    return np.random.default_rng(5).uniform(-3, 3, (count, 3)) * np.geomspace(0.1, 1, count)[:, None]


@pytest.mark.usefixtures("isa")
def test_distances_are_torchs() -> None:
    every, points = outlines(), places(3001)
    found = np.empty((len(every), len(points)), np.float32)
    core.outline_distances([each.native for each in every], points, found, 1)
    expected = np.stack([outline_twins.distance(each, torch.from_numpy(points)).numpy() for each in every])
    silent = np.float32(outline_twins.HIDDEN)
    for kind in (np.isinf, lambda values: values == silent, lambda values: values < silent):
        assert np.array_equal(kind(found), kind(expected))
        assert kind(found).sum() > 100
    finite = np.isfinite(expected)
    np.testing.assert_allclose(found[finite], expected[finite], rtol=1e-4, atol=1e-6)


@pytest.mark.usefixtures("isa")
def test_what_all_but_k_views_allow_is_torchs() -> None:
    field, points = MaskField(outlines(), 0.4), places(3001)
    found = field.outvoting(points, COUNTS)
    expected = outline_twins.outvoting(field, torch.from_numpy(points), COUNTS)
    assert np.array_equal(np.isinf(found), np.isinf(expected))
    outside = np.isinf(expected)
    assert 100 < outside.sum() < outside.size - 100
    np.testing.assert_allclose(found[~outside], expected[~outside], rtol=1e-4, atol=1e-6)


@pytest.mark.usefixtures("isa")
def test_votes_are_torchs() -> None:
    every, points = outlines(), places(3001)
    inside, seen = votes(every, points)
    share, known = outline_twins.votes(every, torch.from_numpy(points))
    assert torch.equal(seen, known)
    assert torch.allclose(inside, share, atol=1e-5)
    assert 0 < float(inside[seen > 0].mean()) < 1


@pytest.mark.usefixtures("isa")
def test_points_in_front_of_what_is_opaque_are_torchs() -> None:
    draw, points = torch.Generator().manual_seed(7), places(3001)
    views = []
    for each in outlines():
        assert each.view.depth is not None
        some = torch.rand(each.view.mask.shape, generator=draw) > 0.3
        views.append(replace(each.view, mask=some, depth=torch.where(each.hidden, 0.0, each.view.depth)))
    found = _free_views(views, points, 0.05)
    assert np.array_equal(found, outline_twins.free_views(views, torch.from_numpy(points), 0.05))
    assert len(np.unique(found)) > 5


def test_threads_places_and_instruction_sets_change_no_bit(isa: str) -> None:
    every, points = [each.native for each in outlines()], places(3001)

    def found(some: np.ndarray, threads: int) -> np.ndarray:
        voted, shares = np.empty((len(COUNTS), len(some)), np.float32), np.empty((2, len(some)), np.float32)
        core.outvoting(every, some, list(COUNTS), 4, 3, voted, threads)
        core.outline_votes(every, some, shares[0], shares[1], threads)
        return np.concatenate([voted, shares])

    whole = found(points, 1)
    assert np.array_equal(whole, found(points, 3))
    assert np.array_equal(whole[:, 700:1409], found(points[700:1409].copy(), 1))
    core.select_isa("portable")
    assert np.array_equal(whole, found(points, 1)), isa


def test_bad_calls_are_refused() -> None:
    every, points, numbers = [each.native for each in outlines(3)], places(5), np.empty(5, np.float32)
    with pytest.raises(ValueError, match="k is 3 of 3"):
        core.outvoting(every, points, [3], 1, 1, np.empty((1, 5), np.float32), 1)
    with pytest.raises(ValueError, match="there are no views"):
        core.outline_votes([], points, numbers, numbers, 1)
    with pytest.raises(ValueError, match="outlines holds None"):
        core.outline_votes([every[0], None], points, numbers, numbers, 1)
    with pytest.raises(ValueError, match="depths holds None"):
        core.views_in_front([None], points, 0.1, np.empty(5, np.int64), 1)
    with pytest.raises(ValueError, match="translation holds 2 numbers"):
        core.Outline(np.eye(3), np.zeros(2), LENS, np.zeros((2, 2), np.float32), None)
    assert MaskField(outlines(3), 0.4).outvoting(np.empty((0, 3)), [0]).shape == (1, 0)


def test_shapes_that_hold_as_many_numbers_are_refused() -> None:
    every, votes, free = [each.native for each in outlines(3)], np.empty((2, 5), np.float32), np.empty(5, np.int64)
    depth = core.DepthView(np.eye(3), np.zeros(3), LENS, np.ones((2, 2), bool), np.ones((2, 2), np.float32))
    for shape, found in (((3, 5), r"\(3, 5\)"), ((15,), r"\(15\)"), ((5, 3, 1), r"\(5, 3, 1\)")):
        points, refused = places(5).reshape(shape), rf"points is {found}, expected \(N, 3\)"
        with pytest.raises(ValueError, match=refused):
            core.outline_votes(every, points, *votes, 1)
        with pytest.raises(ValueError, match=refused):
            core.views_in_front([depth], points, 0.1, free, 1)
    with pytest.raises(ValueError, match=r"distance is \(5, 3\), expected \(3, 5\)"):
        core.outline_distances(every, places(5), np.empty((5, 3), np.float32), 1)
    with pytest.raises(ValueError, match=r"distance is \(4\), expected \(1, 5\)"):
        core.outvoting(every, places(5), [0], 1, 1, np.empty(4, np.float32), 1)
    with pytest.raises(ValueError, match=r"distance is \(3, 2\), expected \(2, 3\)"):
        core.outline_distance(np.eye(2, 3, dtype=bool), np.empty((3, 2), np.float32))


@pytest.mark.parametrize("name", ["bare", "surface", "hidden"])
def test_pictures_of_an_outline_have_the_same_sides(name: str) -> None:
    kinds = {"bare": np.float32, "surface": np.float32, "hidden": np.bool_}
    behind = [np.zeros((3, 2) if each == name else (2, 3), kind) for each, kind in kinds.items()]
    with pytest.raises(ValueError, match=rf"{name} is \(3, 2\), expected \(2, 3\)"):
        core.Outline(np.eye(3), np.zeros(3), LENS, np.zeros((2, 3), np.float32), behind)


def test_a_mask_has_the_sides_of_its_depth() -> None:
    with pytest.raises(ValueError, match=r"mask is \(3, 2\), expected \(2, 3\)"):
        core.DepthView(np.eye(3), np.zeros(3), LENS, np.zeros((3, 2), bool), np.zeros((2, 3), np.float32))


@pytest.mark.parametrize("shape", [(1, 2**24 + 1), (2**24 + 1, 1), (0, 4), (4, 0)])
def test_sides_that_kernels_cannot_count_are_refused(shape: tuple[int, int]) -> None:
    """Zeros that nothing reads take no memory."""
    picture, mask, pose = np.zeros(shape, np.float32), np.zeros(shape, bool), (np.eye(3), np.zeros(3), LENS)
    refused = rf"a picture of \({shape[0]}, {shape[1]}\); sides of 1 to 2\^24 pixels"
    with pytest.raises(ValueError, match=refused):
        core.Outline(*pose, picture, None)
    with pytest.raises(ValueError, match=refused):
        core.DepthView(*pose, mask, picture)
    with pytest.raises(ValueError, match=refused):
        core.outline_distance(mask, picture)


def test_the_widest_picture_is_read_to_its_last_pixel() -> None:
    """Beside the last pixel of a picture of 2^24 in a row lies nothing that is read."""
    width = 2**24
    picture = np.zeros((1, width), np.float32)
    picture[0, -1] = 3
    widest = core.Outline(np.eye(3), np.zeros(3), (1.0, 1.0, 0.0, 0.0), picture, None)
    found = np.empty((1, 2), np.float32)
    core.outline_distances([widest], np.array([[width, 0.5, 1.0], [0.0, 0.5, 1.0]]), found, 1)
    assert found.tolist() == [[3.0, 0.0]]


def test_distances_to_an_outline_are_exact() -> None:
    draw = np.random.default_rng(11)
    for height, width, share in (
        (1, 9, 0.5),
        (9, 1, 0.5),
        (40, 23, 0.02),
        (23, 40, 0.98),
        (37, 31, 0.5),
        (64, 64, 1e-3),
    ):
        inside = draw.random((height, width)) < share
        inside[0, 0], inside[-1, -1] = True, False
        assert np.array_equal(signed_distance(inside).numpy(), outline_twins.signed_distance(inside))
    inside[:] = True
    assert (signed_distance(inside) == 64).all()
    assert (signed_distance(~inside) == -64).all()
    with pytest.raises(ValueError, match="no outline"):
        core.outline_distance(inside, np.empty((64, 64), np.float32))
