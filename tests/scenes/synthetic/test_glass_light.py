"""Light through glass in its parts, against closed forms and by what the path has met."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

pytest.importorskip("mitsuba", reason="path tracing needs the extra 'synthetic'")

from rtgs.scenes.settings import CaptureError
from rtgs.scenes.synthetic.capture import copy_folder, write_capture
from rtgs.scenes.synthetic.complete import complete, layer_means
from rtgs.scenes.synthetic.description import Material, SceneDescription, Shape, Viewpoints
from rtgs.scenes.synthetic.glass import GlassLight
from rtgs.scenes.synthetic.glass_truth import shared_out
from rtgs.scenes.synthetic.lightmap import LightmapSettings
from rtgs.scenes.synthetic.record import CaptureRecord
from rtgs.scenes.synthetic.render import PathTracer
from rtgs.scenes.synthetic.settings import CaptureSettings, FeatureSettings
from rtgs.scenes.synthetic.variants import LLVM_VARIANT, SCALAR_VARIANT
from rtgs.scenes.truth import linear_from_srgb, read_truth
from rtgs.scenes.truth_files import GLASS_MAPS, glass_files
from tests.scenes.synthetic.test_physics import (
    SKY,
    VARIANTS,
    VIEW,
    at_angle,
    eroded,
    eroded_around,
    fresnel,
    furnished,
    pane,
    seen_from,
    tracer,
)

THIN = Material(kind="thin_glass")
LAMP = (2.0, 1.0, 0.5)
BLACK = (0.0, 0.0, 0.0)
DARK = Material(color=BLACK, color2=BLACK)  # a lamp of it sends out nothing but its own light


def thin(degrees: float, ior: float = 1.5) -> float:
    """Reflectance of a thin pane: R + T^2 R + T^2 R^3 + ... = 2 R / (1 + R) of one interface."""
    single = fresnel(np.cos(np.radians(degrees)), ior)
    return 2 * single / (1 + single)


def lamp(*position: float, radius: float = 0.1, name: str = "lamp") -> Shape:
    place = (position[0], position[1], position[2])
    return Shape(name, "sphere", position=place, size=(radius, 0, 0), emission=LAMP, material=DARK)


def parts(light: GlassLight) -> np.ndarray:
    """(3, 3) inner, contents, behind of a camera of one pixel."""
    return np.stack([light.inner[0, 0], light.contents[0, 0], light.behind[0, 0]])


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("degrees", [0.0, 45.0, 80.0])
def test_behind_a_single_pane_there_is_only_what_is_behind(degrees, variant):
    light = tracer(pane(), variant=variant).glass_light(at_angle(degrees), samples=4)
    expected = np.outer((0, 0, 1 - thin(degrees)), np.full(3, SKY))
    np.testing.assert_allclose(parts(light), expected, rtol=1e-4)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("degrees", [0.0, 45.0, 70.0])
def test_two_panes_mirror_a_geometric_series(degrees, variant):
    """Above them the light a, below b: what goes up between them is u = T a + R (T b + R u)."""
    lower = replace(pane(), name="lower", position=(0.0, 0.0, -1.0))
    below = Shape("below", "plane", position=(0, 0, -2.0), size=(90.0, 90.0, 0), emission=LAMP, material=DARK)
    light = tracer(pane(), lower, below, variant=variant).glass_light(at_angle(degrees), samples=400)
    mirrored = thin(degrees)
    passed = 1 - mirrored
    above, under = np.full(3, SKY), np.array(LAMP)
    upward = (passed * above + mirrored * passed * under) / (1 - mirrored**2)
    np.testing.assert_allclose(light.behind[0, 0], passed**2 * under, rtol=1e-4)
    np.testing.assert_allclose(light.inner[0, 0], passed * mirrored * upward, rtol=0.05)
    assert light.contents.max() == 0


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("kind", ["thin_glass", "glass"])
@pytest.mark.parametrize("degrees", [0.0, 40.0])
def test_in_one_and_the_same_light_the_walls_share_it_out(degrees, kind, variant):
    """A block of thin panes, and one of solid glass, under a sky that is the same everywhere: nothing is lost."""
    block = Shape("block", "box", size=(50.0, 50.0, 1.0), position=(0, 0, -1.0), material=Material(kind=kind))
    light = tracer(block, variant=variant).glass_light(at_angle(degrees), samples=64)
    mirrored = thin(degrees) if kind == "thin_glass" else fresnel(np.cos(np.radians(degrees)), 1.5)
    np.testing.assert_allclose(light.behind, SKY * (1 - mirrored) ** 2, rtol=1e-3)
    np.testing.assert_allclose(light.inner, SKY * (1 - mirrored) * mirrored, rtol=0.02)
    assert light.contents.max() == 0


BALL = Shape("ball", "sphere", size=(0.5, 0, 0), material=THIN)
CUP = Shape("cup", "lathe", profile=((0.0, 0.0), (0.4, 0.0), (0.4, 1.0)), material=THIN)  # its mouth is open
FRONT = seen_from((3.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(
    ("shapes", "camera", "part", "walls"),
    [
        ((BALL, lamp(0, 0, 0)), FRONT, "contents", 1),
        ((BALL, lamp(-1, 0, 0)), FRONT, "behind", 2),
        ((BALL, replace(BALL, name="in it", size=(0.3, 0, 0)), lamp(0, 0, 0)), FRONT, "contents", 2),
        ((BALL, replace(BALL, name="in it", size=(0.3, 0, 0)), lamp(-0.4, 0, 0, radius=0.03)), FRONT, "contents", 3),
        ((BALL, replace(BALL, name="beyond", position=(-2, 0, 0)), lamp(-1, 0, 0)), FRONT, "behind", 2),
        ((replace(BALL, copies=((-2, 0, 0),)), lamp(-2, 0, 0)), FRONT, "contents", 3),
        ((replace(BALL, copies=((-2, 0, 0),)), lamp(-1, 0, 0)), FRONT, "behind", 2),
    ],
    ids=[
        "inside",
        "behind",
        "in a ball in it",
        "between the two",
        "before another ball",
        "in a copy",
        "between copies",
    ],
)
def test_where_the_straight_path_ends_tells_contents_from_behind(shapes, camera, part, walls, variant):
    light = tracer(*shapes, light=BLACK, variant=variant).glass_light(camera, samples=4)
    expected = np.array(LAMP) * (1 - thin(0.0)) ** walls
    np.testing.assert_allclose(getattr(light, part)[0, 0], expected, rtol=1e-3)
    assert sum(getattr(light, name).max() > 0 for name in ("contents", "behind")) == 1


@pytest.mark.parametrize("variant", VARIANTS)
def test_beyond_an_open_mouth_is_behind_and_below_it_inside(variant):
    """A path enters through the wall of the cup, and leaves it without meeting another."""
    rising = np.array([-1.0, 0.0, 1.0])
    start = np.array([0.4, 0.0, 0.8]) - rising
    camera = seen_from(start, start + rising)
    out, inside = (np.array([0.4, 0.0, 0.8]) + step * rising for step in (0.8, 0.1))
    for position, part in ((out, "behind"), (inside, "contents")):
        light = tracer(CUP, lamp(*position, radius=0.05), light=BLACK, variant=variant).glass_light(camera, samples=4)
        np.testing.assert_allclose(getattr(light, part)[0, 0], np.array(LAMP) * (1 - thin(45.0)), rtol=1e-2)
        assert light.transmitted.sum() == pytest.approx(getattr(light, part).sum(), rel=1e-3)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_lamp_that_only_the_far_wall_shows_is_inner_light(variant):
    """Through a wall at 45 degrees and mirrored by one upright: inside the box the lamp is off the straight path."""
    box = Shape("box", "box", size=(1.0, 5.0, 1.0), material=THIN)
    camera = seen_from((0.5, 0.0, 1.5), (-1.0, 0.0, 0.0))  # the wall x = -1 sends it on to (0, 0, -1)
    inside = lamp(-0.75, 0.0, -0.25, radius=0.05)
    light = tracer(box, inside, light=BLACK, variant=variant).glass_light(camera, samples=4)
    np.testing.assert_allclose(light.inner[0, 0], np.array(LAMP) * (1 - thin(45.0)) * thin(45.0), rtol=1e-3)
    assert light.contents.max() == light.behind.max() == 0


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_parts_make_up_the_transmitted_light_of_the_layers(variant):
    room = furnished(variant)
    samples, noise = (36, 0.25) if variant == SCALAR_VARIANT else (900, 0.03)
    light, layers = room.glass_light(VIEW, samples), room.layers(VIEW, samples)
    np.testing.assert_array_equal(light.transmitted, light.inner + light.contents + light.behind)
    ball, core = ([shape.name for shape in room.description.shapes].index(name) for name in ("ball", "core"))
    first, behind = (room.geometry(VIEW, without_glass=without).shape for without in (False, True))
    glass = first == ball
    assert light.transmitted.mean() == pytest.approx(layers.transmitted.mean(), rel=noise)
    assert light.transmitted[~eroded_around(glass)].max() == 0
    assert light.contents[~eroded_around(glass & (behind == core))].max() == 0
    middle = np.unravel_index(light.contents.sum(-1).argmax(), glass.shape)
    assert light.behind[middle].max() == 0
    assert light.inner[eroded(glass)].mean() > 0.002


@pytest.mark.skipif(len(VARIANTS) == 1, reason="light maps need LLVM")
def test_previews_tell_the_parts_apart_too():
    room = furnished(LLVM_VARIANT)
    quick = PathTracer(room.description, lightmap=LightmapSettings())
    one, other = room.glass_light(VIEW, 400), quick.glass_light(VIEW, 64)
    for name in GLASS_MAPS:
        assert getattr(one, name).mean() == pytest.approx(getattr(other, name).mean(), rel=0.15), name


def test_the_parts_are_scaled_to_the_transmitted_light():
    rng = np.random.default_rng(0)
    light = GlassLight(*rng.random((3, 4, 5, 3)).astype(np.float32))
    light.contents[1] = 0
    for part in (light.inner, light.contents, light.behind):
        part[2] = 0
    transmitted = rng.random((4, 5, 3)).astype(np.float32)
    shared = shared_out(light, transmitted)
    np.testing.assert_allclose(shared.transmitted, transmitted, rtol=1e-6)
    np.testing.assert_allclose(shared.inner[0] / shared.behind[0], light.inner[0] / light.behind[0], rtol=1e-5)
    assert shared.contents[1].max() == 0
    np.testing.assert_array_equal(shared.behind[2], transmitted[2])  # where there was no light to share it out by


def ball_in_a_room() -> SceneDescription:
    """Under the name of a shipped scene."""
    room = Shape("room", "box", size=(3, 3, 3), inward=True, material=Material(texture="posters"))
    core = Shape("core", "box", size=(0.15, 0.15, 0.15), material=Material(texture="checker"))
    shapes = (room, lamp(0.0, 0.0, 2.5, radius=0.4), BALL, core)
    return SceneDescription("spheres", "Test", shapes, Viewpoints(count=3, radius=(2.0, 2.2), rings=1), (0.2, 0.2, 0.2))


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    features = FeatureSettings(points=100)
    settings = CaptureSettings(width=24, height=18, samples=4, test_samples=16, truth="test", features=features)
    folder = tmp_path_factory.mktemp("glass")
    write_capture(ball_in_a_room(), folder / "spheres", folder / "work", settings, variant=SCALAR_VARIANT)
    return folder / "spheres"


def step_of(truth: Path, name: str, light: torch.Tensor) -> torch.Tensor:
    """Half a step of 8 bits of the file of a layer at its own light."""
    with Image.open(truth / f"{name}.png") as picture:
        levels, scale = np.asarray(picture).astype(float), float(picture.text["scale"])  # type: ignore[attr-defined]
    upper, lower = (scale * linear_from_srgb(np.clip(levels + half, 0, 255) / 255) for half in (0.5, -0.5))
    return torch.from_numpy(np.maximum(upper - lower, 1e-6).transpose(2, 0, 1)).to(light.dtype)


def assert_parts_sum(folder: Path) -> None:
    truth = read_truth(folder)
    assert truth.inner is not None
    assert truth.contents is not None
    assert truth.behind is not None
    gap = (truth.inner + truth.contents + truth.behind - truth.transmitted).abs()
    assert (gap <= 1e-5 + sum(step_of(folder, name, gap) for name in GLASS_MAPS)).all()


def test_a_capture_tells_the_parts_apart_and_they_sum_in_its_files(capture):
    (folder,) = sorted((capture / "truth").iterdir())
    assert_parts_sum(folder)
    truth = read_truth(folder)
    for name in GLASS_MAPS:
        assert truth.tensors()[name].max() > 0.01, name
    assert (truth.tensors()["contents"][:, truth.transmitted.sum(0) == 0] == 0).all()


def test_a_capture_without_the_parts_gets_the_same_ones_and_nothing_else_changes(capture, tmp_path, monkeypatch):
    copy = tmp_path / "spheres"
    copy_folder(capture, copy)
    before = {path: path.read_bytes() for path in sorted(copy.rglob("*")) if path.is_file()}
    for path in glass_files(copy / "truth" / "view_000"):
        path.unlink()
    monkeypatch.setattr("rtgs.scenes.synthetic.complete.named_scene", lambda name: ball_in_a_room())
    lines: list[str] = []
    complete(copy, variant=SCALAR_VARIANT, tell=lines.append)
    assert [line.partition(":")[0] for line in lines] == ["spheres view_000"]
    assert {path: path.read_bytes() for path in sorted(copy.rglob("*")) if path.is_file()} == before
    complete(copy, variant=SCALAR_VARIANT, tell=lines.append)
    assert len(lines) == 1  # nothing was left to do
    means = layer_means(copy)
    assert means["transmitted"] == pytest.approx(sum(means[name] for name in GLASS_MAPS), rel=0.02)


def test_what_cannot_be_completed_is_refused(capture, tmp_path):
    with pytest.raises(CaptureError, match="holds no record of a path-traced capture"):
        complete(tmp_path)
    with pytest.raises(CaptureError, match=r"spheres changed after it was rendered.*rtgs run synthesize scene=spheres"):
        complete(capture)
    record = CaptureRecord.read(capture)
    assert record is not None
    replace(record, name="atlantis").write(tmp_path)
    with pytest.raises(CaptureError, match=r"no synthetic scene 'atlantis'.*make the capture again"):
        complete(tmp_path)
