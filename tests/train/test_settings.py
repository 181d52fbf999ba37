"""Numbers that no recipe can mean are refused where they are set, by their config key."""

import math

import pytest

from rtgs.config import compose
from rtgs.core.recipe import canonical_json
from rtgs.gaussians.settings import OptimizerSettings
from rtgs.methods.settings import InterfaceSettings
from rtgs.train.settings import LossSettings


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_weights_and_rates_must_be_finite_and_not_negative(value):
    with pytest.raises(ValueError, match=r"method\.loss\.dssim=.* must be a finite number of at least 0"):
        LossSettings(dssim=value)
    with pytest.raises(ValueError, match=r"method\.optimizer\.means_initial=.* must be a finite number of at least 0"):
        OptimizerSettings(means_initial=value)


@pytest.mark.parametrize("value", [-0.01, 1.5, math.nan])
def test_starts_are_shares_of_the_run(value):
    with pytest.raises(ValueError, match=r"method\.loss\.normal_start=.* must be between 0 and 1"):
        LossSettings(normal_start=value)


def test_zero_weights_are_legal():
    assert LossSettings(dssim=0.0, normal=0.0).dssim == 0.0


@pytest.mark.parametrize("name", ["normal_loss", "normal_hold"])
def test_what_holds_the_normals_of_glass_is_never_negative(name):
    assert getattr(InterfaceSettings(**{name: 0.0}), name) == 0
    key = rf"method\.transmittance\.interface\.{name}"
    with pytest.raises(ValueError, match=rf"{key}=-0\.1 must be a finite number of at least 0"):
        InterfaceSettings(**{name: -0.1})


@pytest.mark.parametrize("preset", ["smoke", "quick", "standard", "paper"])
def test_glass_holds_its_own_normals_and_not_the_rasterised_ones(preset):
    """docs/lab/transmittance.md: 20 and 0, whatever the preset; a recipe without it is one from before it."""
    own = compose(["scene=demo", "method=rtgs", f"preset={preset}"])[0].method.transmittance.interface
    assert (own.normal_hold, own.normal_loss) == (20.0, 0.0)
    free = compose(["scene=demo", "method=rtgs", f"preset={preset}", "method.transmittance.interface.normal_hold=0"])[0]
    assert "normal_hold" not in canonical_json(free.method.transmittance.interface)
