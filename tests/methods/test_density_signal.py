"""Which signal the base set's density control learns from: method.density.signal."""

from dataclasses import replace

import pytest
import torch
from photo_cases import plain
from training_cases import small_scene, small_schedule

from rtgs.core.errors import RtgsError
from rtgs.gaussians.settings import DensitySettings
from rtgs.methods import Mode, create_method
from rtgs.methods.settings import ReflectionSettings, TransmittanceSettings
from rtgs.train.seeds import generator_for


@pytest.mark.parametrize(
    ("settings", "name"), [(ReflectionSettings, "reflection"), (TransmittanceSettings, "transmittance")]
)
def test_only_the_base_set_has_the_absolute_signal(settings, name) -> None:
    with pytest.raises(RtgsError, match=f"method.{name}.density.signal=absolute must be net: the base set"):
        settings(density=DensitySettings(signal="absolute"))


def test_an_unknown_signal_is_refused() -> None:
    with pytest.raises(RtgsError, match=r"method\.density\.signal"):
        DensitySettings(signal="loud")  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["2dgs", "3dgs"])
def test_density_control_sees_what_does_not_cancel(kind: str) -> None:
    """The same step: the absolute signal has no sign and is larger; what is learned of the picture is the same."""
    scene, before = small_scene(noise=True), plain(kind)

    def observed(signal: str):
        settings = replace(before, density=replace(before.density, signal=signal))
        method = create_method(settings, scene, small_schedule(), generator_for(0, "initialise"))
        rendered = method.render(scene.train[0].camera, 0, Mode.TRAIN)
        method.losses(rendered, scene.train[0], 0).total.backward()
        return rendered.observations[0], method.base.set.gaussians

    net, plainly = observed("net")
    absolute, gaussians = observed("absolute")
    assert bool((net.probe.grad < 0).any())
    assert bool((absolute.probe.grad >= 0).all())
    assert absolute.probe.grad.sum() > 1.2 * net.probe.grad.abs().sum()
    assert torch.equal(absolute.weight_sum, net.weight_sum)
    for name in ("means", "log_scales", "opacity_logits", "sh_dc"):
        assert torch.equal(gaussians[name].grad, plainly[name].grad), name
