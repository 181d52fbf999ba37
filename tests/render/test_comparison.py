"""The comparison helpers themselves: a helper that always passes would hide every kernel bug."""

import pytest
import torch

from .comparison import ErrorPool, pixel_error, relative_error


def test_relative_error_is_relative_to_the_largest_expected():
    error = relative_error(torch.tensor([1.0, 4.1]), torch.tensor([1.0, -4.0]))
    torch.testing.assert_close(error, torch.tensor([0.0, 8.1 / 4.0]).double(), atol=1e-6, rtol=0)


def test_relative_error_of_zero_expected_is_absolute():
    assert relative_error(torch.tensor([0.5]), torch.zeros(1)).item() == 0.5


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_non_finite_actual_is_an_infinite_error(bad):
    error = relative_error(torch.tensor([bad, 1.0]), torch.ones(2))
    assert error.tolist() == [float("inf"), 0.0]


def test_broken_reference_and_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="reference itself is broken"):
        relative_error(torch.ones(1), torch.tensor([float("nan")]))
    with pytest.raises(ValueError, match="cannot compare shape"):
        relative_error(torch.ones(2), torch.ones(1))


def test_pixel_error_takes_the_worst_channel():
    expected = torch.ones(2, 1, 2)
    actual = expected.clone()
    actual[1, 0, 1] = 1.5
    assert pixel_error(actual, expected).tolist() == [[0.0, 0.5]]
    assert pixel_error(actual[0], expected[0]).tolist() == [[0.0, 0.0]]


def test_pool_counts_shares_over_all_examples():
    pool = ErrorPool()
    pool.add(torch.zeros(9))
    pool.add(torch.tensor([1e-3]))
    assert pool.share_beyond(1e-4) == pytest.approx(0.1)
    assert pool.share_beyond(1e-2) == 0
    assert pool.worst == pytest.approx(1e-3)
    assert pool.beyond_share(0.2) == 0
    assert pool.beyond_share(0.0) == pytest.approx(1e-3)


def test_pool_leaves_flagged_elements_out_but_counts_them():
    pool = ErrorPool()
    pool.add(torch.tensor([1.0, 0.0, 0.0, 0.0]), torch.tensor([True, False, False, False]))
    assert pool.share_beyond(1e-5) == 0
    assert pool.flagged_share == 0.25
    with pytest.raises(ValueError, match="do not fit"):
        pool.add(torch.zeros(2), torch.zeros(3, dtype=torch.bool))


def test_pool_with_nothing_judged_does_not_pass():
    pool = ErrorPool()
    with pytest.raises(ValueError, match="nothing to judge"):
        pool.share_beyond(1.0)
    pool.add(torch.zeros(2), torch.ones(2, dtype=torch.bool))
    with pytest.raises(ValueError, match="2 of them flagged"):
        _ = pool.worst
