"""The far shell: in the base set and in no other."""

from dataclasses import replace

import pytest
import torch
from photo_cases import plain
from training_cases import small_method, small_trainer

from rtgs.core.errors import RtgsError
from rtgs.gaussians.harmonics import rgb_to_sh_dc
from rtgs.gaussians.settings import InitSettings
from rtgs.methods.settings import ReflectionSettings, TransmittanceSettings


@pytest.mark.parametrize(
    ("settings", "name"), [(ReflectionSettings, "reflection"), (TransmittanceSettings, "transmittance")]
)
def test_only_the_base_set_has_a_shell(settings, name) -> None:
    with pytest.raises(RtgsError, match=f"method.{name}.init.shell_points=5 must be 0: the base set"):
        settings(init=InitSettings(shell_points=5))


def test_a_base_set_begins_with_the_shell_in_the_color_of_the_photos() -> None:
    plain = small_trainer(settings=small_method()).method.base.set.gaussians
    made = small_trainer(settings=replace(small_method(), init=InitSettings(shell_points=9, shell_distance=4.0)))
    gaussians, views = made.method.base.set.gaussians, made.scene.train
    center = torch.stack([view.camera.center for view in views]).mean(0).float()
    away = (gaussians.means[-9:].detach() - center).norm(dim=1)
    assert len(gaussians) == len(plain) + 9
    assert torch.allclose(away, torch.tensor(4.0 * made.scene.extent), rtol=1e-4)
    color = torch.cat([view.image.flatten(1) for view in views], 1).mean(1)
    assert torch.allclose(gaussians.sh_dc[-9:].detach(), rgb_to_sh_dc(color[None]).expand(9, 3), atol=0.1)


@pytest.mark.parametrize("kind", ["2dgs", "3dgs"])
def test_a_shell_is_never_too_large(kind) -> None:
    settings = replace(plain(kind), init=InitSettings(shell_points=30))
    base = small_trainer(settings=settings).method.base
    far = base.set.density.beyond
    assert int(far.holds(base.set.gaussians.means).sum()) == 30
    count = len(base.set)
    for _ in range(3):
        base.set.density.densify(base.set.gaussians, base.set.optimizer, torch.Generator())
    assert int(far.holds(base.set.gaussians.means).sum()) == 30
    base.set.density.beyond = None
    base.set.density.densify(base.set.gaussians, base.set.optimizer, torch.Generator())
    assert int(far.holds(base.set.gaussians.means).sum()) != 30, f"{count} at first: nothing was too large"
