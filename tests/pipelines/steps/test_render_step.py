"""The render step: what it stores, and that it renders each view once for each choice of masks."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from pipelines.steps import render, report
from rtgs.core.cameras import Camera
from rtgs.light.cubemap import CubemapLight
from rtgs.light.pictures import CUBE, FACES, PANORAMA, RADIANCE
from rtgs.light.settings import CubemapSettings
from rtgs.methods import Mode, RenderedView, RenderOptions
from rtgs.methods.parts.part import Frame, Raster
from rtgs.render.buffers import RasterBuffers
from rtgs.runs.mixture import Ensemble
from rtgs.runs.views import read_coverage, read_render
from rtgs.scenes.canonical import save_scene
from rtgs.scenes.scene import Scene, View
from rtgs.track.null import NullTracker
from rtgs.workflow import StepContext

HEIGHT, WIDTH = 6, 8


@dataclass
class CountingMethod:
    """Shows one colour per choice of masks, and remembers what it was asked for."""

    glass: bool
    maps: tuple[str, ...] = ("depth", "normal")
    asked: list[tuple[str, RenderOptions]] = field(default_factory=list)
    base_depth: float = 2.0  # of the base set; what is shown lies at 2
    base_alpha: float = 1.0
    light: CubemapLight | None = None
    parts: dict[str, object] = field(default_factory=dict)

    @property
    def base(self) -> CountingMethod:
        return self

    def rasterize(self, frame: Frame, wanted: RenderOptions) -> Raster:
        assert frame.camera.name in ("2.png", "3.png")  # no test view
        assert (frame.step, frame.mode) == (100, Mode.EVALUATE)
        assert wanted == RenderOptions(depth=True)
        alpha = torch.full((HEIGHT, WIDTH), self.base_alpha)
        return Raster(RasterBuffers(torch.zeros(3, HEIGHT, WIDTH), alpha, self.base_depth * alpha))

    def render(
        self, camera: Camera, step: int, mode: Mode, options: RenderOptions, mask: torch.Tensor | None
    ) -> RenderedView:
        assert step == 100
        if camera.name == render.WARM_UP:
            assert max(camera.width, camera.height) <= 16
        else:
            self.asked.append((camera.name, options))
        assert mask is None or mask.shape == (camera.height, camera.width)
        image = torch.full((3, camera.height, camera.width), 0.75 if options.masks else 0.25)
        image[:, ::2] += 0.1 if camera.height > HEIGHT else 0.0  # what a finer picture shows besides
        empty = torch.zeros(camera.height, camera.width)
        buffers = RasterBuffers(image, empty + 1, empty + 2 if options.depth else None, None)
        transparent = mask if self.glass else None
        maps = {} if transparent is None else {"transparent": transparent}
        return RenderedView(camera, image, buffers, maps=maps)


def view(index: int, *, masked: bool, name: str = "") -> View:
    name = name or f"{index}.png"
    eye = torch.eye(3, dtype=torch.float64)
    camera = Camera(eye, torch.zeros(3, dtype=torch.float64), 8.0, 8.0, 4.0, 3.0, WIDTH, HEIGHT, name=name)
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool) if masked else None
    return View(camera, torch.full((3, HEIGHT, WIDTH), 0.5), mask, None, name)


@pytest.fixture
def context(tmp_path: Path) -> StepContext:
    for name in ("scene", "out", "partial"):
        (tmp_path / name).mkdir()
    views = (view(0, masked=True), view(1, masked=False))
    train, held = (view(2, masked=True),), (view(3, masked=True),)
    scene = Scene("two", train, views, torch.zeros(4, 3), torch.zeros(4, 3), 1.0, "test", held=held)
    save_scene(scene, tmp_path / "scene")
    inputs = {"import_scene": tmp_path / "scene", "train_diffuse": tmp_path}
    return StepContext(inputs, tmp_path / "out", tmp_path / "partial", logging.getLogger("test"), NullTracker())


def run(
    context: StepContext,
    method: CountingMethod,
    monkeypatch: pytest.MonkeyPatch,
    *,
    maps: bool,
    params: render.RenderParams | None = None,
    joined: int = 0,
) -> None:
    monkeypatch.setattr(render, "last_training", lambda inputs: inputs["train_diffuse"])
    stage = SimpleNamespace(until=100, joined=joined)
    monkeypatch.setattr(render, "load_method", lambda folder, scene: (method, stage))
    render.render(params or render.RenderParams(maps=maps), context)


@pytest.mark.parametrize(
    ("changes", "shown"), [({}, 1), ({"base_depth": 1.0}, 0), ({"base_depth": 1.0, "base_alpha": 0.4}, 1)]
)
def test_training_views_that_show_a_pixel_are_counted(context, monkeypatch, changes: dict, shown: int) -> None:
    """The one training view stands where the test views stand; what covers less than half of a pixel hides nothing."""
    run(context, CountingMethod(glass=False, **changes), monkeypatch, maps=True)
    for name in ("0.png", "1.png"):
        count = read_coverage(context.out, name)
        assert count is not None
        assert count.dtype == torch.int16
        assert torch.equal(count, torch.full((HEIGHT, WIDTH), shown, dtype=torch.int16))
        times = render.RenderTimes.read(context.out)
        assert torch.equal(render.read_timed(context.out, times, name).framed, count)


def test_held_out_views_count_once_they_were_trained_on(context, monkeypatch) -> None:
    run(context, CountingMethod(glass=False), monkeypatch, maps=True, joined=70)
    count = read_coverage(context.out, "0.png")
    assert count is not None
    assert bool((count == 2).all())


def test_without_maps_nothing_is_counted(context, monkeypatch) -> None:
    run(context, CountingMethod(glass=False), monkeypatch, maps=False)
    assert read_coverage(context.out, "0.png") is None


def test_the_image_from_the_refined_pose_is_kept_beside_that_of_the_test(context, monkeypatch) -> None:
    found = []

    def refined(method: object, view: View, step: int, *, steps: int) -> Camera:
        found.append((view.name, step, steps))
        return replace(view.camera, name=f"refined {view.name}")

    monkeypatch.setattr("rtgs.methods.refine_pose.refine_pose", refined)
    method = CountingMethod(glass=False)
    monkeypatch.setattr(render, "last_training", lambda inputs: inputs["train_diffuse"])
    monkeypatch.setattr(render, "load_method", lambda folder, scene: (method, SimpleNamespace(until=100)))
    render.render(render.RenderParams(maps=False, refine_steps=7, refine_all=True), context)
    assert found == [("0.png", 100, 7), ("1.png", 100, 7)]
    assert [name for name, _ in method.asked] == ["0.png", "refined 0.png", "1.png", "refined 1.png"]
    timed = render.read_timed(context.out, render.RenderTimes.read(context.out), "1.png")
    assert timed.refined is not None
    assert torch.equal(timed.refined, timed.image)  # of this method, which shows every camera the same


@pytest.mark.parametrize("learned", [True, False])
def test_poses_are_refined_where_the_training_learned_them(context, monkeypatch, learned) -> None:
    monkeypatch.setattr("rtgs.methods.refine_pose.refine_pose", lambda method, view, step, *, steps: view.camera)
    monkeypatch.setattr(render, "last_training", lambda inputs: inputs["train_diffuse"])
    method = CountingMethod(glass=False, parts={"poses": object()} if learned else {})
    monkeypatch.setattr(render, "load_method", lambda folder, scene: (method, SimpleNamespace(until=100)))
    render.render(render.RenderParams(maps=False, refine_steps=7, preview=0), context)
    timed = render.read_timed(context.out, render.RenderTimes.read(context.out), "1.png")
    assert (timed.refined is not None) is learned


@pytest.mark.parametrize("judged", [True, False])
@pytest.mark.parametrize("times", [1, 2])
def test_the_image_from_the_refined_pose_is_made_as_the_other_is(context, monkeypatch, judged, times) -> None:
    """As fine, and with what the judge replaced: only their poses tell the two apart."""

    class Judge:
        def of(
            self, camera: Camera, image: torch.Tensor, mask: object = None, options: RenderOptions | None = None
        ) -> torch.Tensor:
            assert options == RenderOptions() or camera.name == render.WARM_UP
            return (image - (0.25 if camera.name.startswith("refined") else 0.125)).clamp_min(0)

    def refined(method: object, view: View, step: int, *, steps: int) -> Camera:
        return replace(view.camera, name=f"refined {view.name}")

    monkeypatch.setattr("rtgs.methods.refine_pose.refine_pose", refined)
    monkeypatch.setattr(render, "read_mixture", lambda inputs, scene: Judge() if judged else None)
    params = render.RenderParams(maps=False, supersample=times, refine_steps=7, refine_all=True, preview=0)
    run(context, CountingMethod(glass=False), monkeypatch, maps=False, params=params)
    timed = render.read_timed(context.out, render.RenderTimes.read(context.out), "1.png")
    assert timed.refined is not None
    base = 0.25 if times == 1 else 0.3
    shown = (base - 0.125, 0.0 if times == 1 else 0.05) if judged else (base, base)
    for image, value in zip((timed.image, timed.refined), shown):
        torch.testing.assert_close(image.mean(), torch.tensor(value))


@dataclass
class Brighter(CountingMethod):
    """Another model: brighter than white where masks are given, and it remembers the masks."""

    masks: list[torch.Tensor | None] = field(default_factory=list)

    def render(
        self, camera: Camera, step: int, mode: Mode, options: RenderOptions, mask: torch.Tensor | None
    ) -> RenderedView:
        self.masks.append(mask)
        found = super().render(camera, step, mode, options, mask)
        return replace(found, image=found.image + 0.5)


@pytest.mark.parametrize("times", [1, 2])
def test_an_ensemble_shows_the_mean_seen_through_the_same_masks(context, monkeypatch, times: int) -> None:
    method, other = CountingMethod(glass=True), Brighter(glass=True)
    monkeypatch.setattr(render, "read_mixture", lambda inputs, scene: Ensemble(((other, 100),)))
    params = render.RenderParams(supersample=times, preview=0)
    run(context, method, monkeypatch, maps=True, params=params)
    plain, given = RenderOptions(), RenderOptions(masks="given")
    assert other.asked == [("0.png", plain), ("0.png", given), ("1.png", plain)]
    assert [mask is not None for mask in other.masks] == [False, True, True, False]  # the first is the warm-up
    tensors = read_render(context.out, "0.png")
    finer = 0.0 if times == 1 else 0.05
    for name, value in (("image", 0.5), (render.FULL, 0.25)):
        torch.testing.assert_close(tensors[name].mean(), torch.tensor(value + finer))
    of_given = ((0.75 + 1) / 2,) if times == 1 else (0.85 / 2 + 0.5, 0.75 / 2 + 0.5)  # within 0 and 1 before the mean
    torch.testing.assert_close(tensors[render.GIVEN].mean(), torch.tensor(sum(of_given) / len(of_given)))
    assert set(tensors) == {"image", render.FULL, render.GIVEN, "depth", "alpha"}


@pytest.mark.parametrize("maps", [True, False])
def test_a_view_is_rendered_once_for_each_choice_of_masks(context, monkeypatch, maps: bool) -> None:
    method = CountingMethod(glass=True)
    run(context, method, monkeypatch, maps=maps)
    options = RenderOptions(depth=maps, normal=maps, layers=maps)
    given = RenderOptions(masks="given")
    assert method.asked == [("0.png", options), ("0.png", given), ("1.png", options)]
    tensors = read_render(context.out, "0.png")
    assert set(tensors) == {"image", render.GIVEN, *(("depth", "alpha") if maps else ())}
    assert tensors["image"].unique().tolist() == [0.25]
    assert tensors[render.GIVEN].unique().tolist() == [0.75]
    times = render.RenderTimes.read(context.out)
    assert set(times.seconds) == {"0.png", "1.png"}
    assert times.with_maps == maps  # the seconds say what they are of
    assert min(times.seconds.values()) > 0


def test_without_transparent_objects_given_masks_are_not_rendered(context, monkeypatch) -> None:
    method = CountingMethod(glass=False)
    run(context, method, monkeypatch, maps=True)
    assert [name for name, _ in method.asked] == ["0.png", "1.png"]
    timed = render.read_timed(context.out, replace(render.RenderTimes.read(context.out)), "1.png")
    assert torch.equal(timed.image, read_render(context.out, "1.png")["image"])


def test_a_far_light_is_written_the_right_way_up_and_other_methods_write_none(context, monkeypatch) -> None:
    """The training camera looks along z with y down: a light from -y is at the top of the panorama."""
    run(context, CountingMethod(glass=False), monkeypatch, maps=False)
    assert not (context.out / render.ENVIRONMENT).exists()
    assert report._environment(context.out / render.ENVIRONMENT) is None
    texels = torch.zeros(6, 4, 4, 3)
    texels[3] = 1.0  # the face of -y
    again = replace(context, out=context.out.with_name("again"))
    again.out.mkdir()
    light = CubemapLight(texels, CubemapSettings(side=4, activation="identity"))
    run(again, CountingMethod(glass=False, light=light), monkeypatch, maps=False)
    faces = {f"{name}.{kind}" for name in FACES for kind in ("png", "exr")}
    assert {path.name for path in (again.out / render.ENVIRONMENT).iterdir()} == {PANORAMA, RADIANCE, CUBE} | faces
    panorama = report._environment(again.out / render.ENVIRONMENT)
    assert panorama is not None
    assert panorama.shape == (256, 512, 3)
    assert (panorama[:32] == 255).all()
    assert (panorama[128:] == 0).all()


@dataclass
class NamedMethod(CountingMethod):
    """Shows a grey that depends on the view."""

    def render(
        self, camera: Camera, step: int, mode: Mode, options: RenderOptions, mask: torch.Tensor | None
    ) -> RenderedView:
        shown = super().render(camera, step, mode, options, mask)
        return replace(shown, image=torch.full((3, HEIGHT, WIDTH), SHADES.get(camera.name, 0.0)))


SHADES = {"s/t.jpg": 0.25, "s_t.jpg": 0.5, "a.jpg": 0.75, "a.png": 1.0}


def test_views_whose_stems_meet_keep_their_own_pictures(context, monkeypatch) -> None:
    views = tuple(view(index, masked=False, name=name) for index, name in enumerate(SHADES))
    scene = Scene("four", (view(2, masked=True),), views, torch.zeros(4, 3), torch.zeros(4, 3), 1.0, "test")
    save_scene(scene, context.inputs["import_scene"])
    run(context, NamedMethod(glass=False), monkeypatch, maps=False)
    for name, shade in SHADES.items():
        assert read_render(context.out, name)["image"].unique().tolist() == [shade]
    assert len(list((context.out / "images").glob("*.png"))) == 4


def test_finer_images_are_averaged_and_maps_are_not(context, monkeypatch) -> None:
    method = CountingMethod(glass=True)
    params = render.RenderParams(supersample=2)
    run(context, method, monkeypatch, maps=True, params=params)
    for name, keys in (("0.png", ("image", render.GIVEN)), ("1.png", ("image",))):
        kept = read_render(context.out, name)
        for key, value in zip(keys, (0.3, 0.8), strict=False):
            torch.testing.assert_close(kept[key], torch.full((3, HEIGHT, WIDTH), value))
        assert kept["depth"].shape == (HEIGHT, WIDTH)
    masked, bare = (sum(asked == name for asked, _ in method.asked) for name in ("0.png", "1.png"))
    assert (masked, bare) == (3, 2), "maps at the size of the photo, and each image once, finer"
