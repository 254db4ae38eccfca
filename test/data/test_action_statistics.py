"""Claims about z-scoring: population statistics in float64, constant dimensions harmless, blocks as single actions."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_ficreg.data import ActionStatistics


def test_they_are_the_population_statistics():
    action = np.random.default_rng(0).normal(3.0, 2.0, (1001, 3))
    statistics = ActionStatistics.from_actions(torch.from_numpy(action).float())
    np.testing.assert_allclose(statistics.mean, action.mean(0), rtol=1e-6)
    np.testing.assert_allclose(statistics.std, action.std(0), rtol=1e-6)
    assert statistics.mean.dtype == statistics.std.dtype == torch.float32


def test_sums_do_not_lose_small_deviations_to_a_large_mean():
    action = torch.tensor([[4096.0], [4096.001]]).repeat(50_000, 1)  # float32 sums would be off by far more
    expected = action.double().std(correction=0)
    torch.testing.assert_close(ActionStatistics.from_actions(action).std[0].double(), expected, rtol=1e-6, atol=0)


def test_a_constant_dimension_becomes_zero_and_comes_back():
    """It is told from one of deviation 1 by mean and std, which a checkpoint keeps; statistics of ones were not measured."""
    action = torch.tensor([[1.0, 0.1, 1.0], [3.0, 0.1, 5.0]]).repeat(3, 1)  # deviations 1, 0 and 2
    measured = ActionStatistics.from_actions(action)
    torch.testing.assert_close(measured.std, torch.tensor([1.0, 1.0, 2.0]))
    assert (measured.normalize(action)[:, 1] == 0).all()
    torch.testing.assert_close(measured.denormalize(measured.normalize(action)), action)
    for statistics in (measured, ActionStatistics(measured.mean, torch.tensor(measured.std.tolist()))):
        assert statistics.constant.tolist() == [False, True, False]
    assert ActionStatistics(torch.zeros(2), torch.ones(2)).constant.tolist() == [False, False]


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_a_block_is_its_actions_one_after_another(batch):
    statistics = ActionStatistics(torch.tensor([1.0, -2.0, 0.5]), torch.tensor([2.0, 0.5, 1.0]))
    action = torch.randn(*batch, 5, 3)  # [..., F, A]
    before = action.clone()
    block = statistics.normalize(action.flatten(-2))  # [..., F * A]
    torch.testing.assert_close(block, ((action - statistics.mean) / statistics.std).flatten(-2))
    torch.testing.assert_close(block, statistics.normalize(action).flatten(-2))
    torch.testing.assert_close(statistics.denormalize(block), action.flatten(-2))
    assert action.equal(before)


def test_mistakes_are_refused():
    with pytest.raises(ValueError, match=r"\[N, A\] with at least one row, got \(0, 2\)"):
        ActionStatistics.from_actions(torch.zeros(0, 2))
    with pytest.raises(ValueError, match="NaN"):
        ActionStatistics.from_actions(torch.tensor([[float("nan")]]))
    with pytest.raises(ValueError, match="std positive"):
        ActionStatistics(torch.zeros(2), torch.tensor([1.0, 0.0]))
    with pytest.raises(ValueError, match="of one size"):
        ActionStatistics(torch.zeros(2), torch.ones(3))
    with pytest.raises(ValueError, match="multiple of 2"):
        ActionStatistics(torch.zeros(2), torch.ones(2)).normalize(torch.zeros(4, 5))
