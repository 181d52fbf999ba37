"""Optional maps change no bit of the image: the render step takes both from one call."""

from __future__ import annotations

import pytest
import torch
from glass_cases import begun, glass_recipe, glass_scene, randomised
from training_cases import small_method, small_scene, small_schedule, small_trainer

from rtgs.methods import Method, Mode, RenderOptions
from rtgs.scenes.scene import Scene


def trained(name: str) -> tuple[Method, Scene]:
    """A method of some steps on the small scene; of the third stage one whose sets are all there."""
    if name == "rtgs":
        made = glass_scene()
        method = begun(glass_recipe(), made)
        randomised(method)
        return method, made.scene
    scene = small_scene(points=120)
    trainer = small_trainer(scene, small_method(name), small_schedule(8))
    trainer.run()
    return trainer.method, scene


@pytest.mark.parametrize("name", ["2dgs", "3dgs", "rtgs"])
def test_maps_change_no_bit_of_the_image(name: str) -> None:
    method, scene = trained(name)
    maps = RenderOptions(depth=True, normal="normal" in method.maps, layers=True)
    for view in (*scene.test, *scene.train[:2]):
        with torch.no_grad():
            alone = method.render(view.camera, 59, Mode.EVALUATE, mask=view.mask)
            whole = method.render(view.camera, 59, Mode.EVALUATE, maps, view.mask)
        assert alone.image.any()
        assert torch.equal(whole.image, alone.image)
        assert (whole.maps.get("transparent") is None) == (alone.maps.get("transparent") is None)
        assert whole.buffers.depth is not None
