"""Numbers that no recipe can mean are refused where they are set, by their config key."""

import math

import pytest

from rtgs.train.settings import LossSettings, OptimizerSettings


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
