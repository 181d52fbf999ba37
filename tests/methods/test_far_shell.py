"""The far shell: in the base set and in no other."""

from dataclasses import replace

import pytest
import torch
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
    color = torch.stack([view.image.mean((1, 2)) for view in views]).mean(0)
    assert torch.allclose(gaussians.sh_dc[-9:].detach(), rgb_to_sh_dc(color[None]).expand(9, 3), atol=1e-5)
