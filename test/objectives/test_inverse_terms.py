"""Claims about the terms of inverse models: reliability weight, and R² with its shuffled control."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_ficreg.objectives.inverse_terms import inverse_model_r2, reliability_weight


def test_reliability_is_1_without_error_and_0_for_an_error_of_1():
    assert reliability_weight(torch.tensor([0.0, 0.25, 1.0, 9.0, math.inf])).tolist() == [1.0, 0.75, 0.0, 0.0, 0.0]
    assert not reliability_weight(torch.tensor([0.25], requires_grad=True)).requires_grad


def test_an_informative_inverse_model_recovers_the_actions_of_its_own_clip():
    """Its R² is that of its error; on the actions of other clips it is clearly worse than on the true ones."""
    generator = torch.Generator().manual_seed(0)
    action, error = (torch.randn(256, 3, 4, generator=generator) for _ in range(2))
    report = inverse_model_r2(action + 0.3 * error, action + 0.6 * error, action, None)
    for name, expected in (("real", 1 - 0.09), ("imagined", 1 - 0.36), ("shuffled", -1 - 0.36)):
        torch.testing.assert_close(report[f"judge_r2_{name}"], torch.full((4,), expected), rtol=0, atol=0.2)
    assert (report["judge_r2_shuffled"] < report["judge_r2_imagined"] - 0.5).all()


def test_a_constant_inverse_model_has_no_r2():
    action = torch.randn(256, 3, 4, generator=torch.Generator().manual_seed(0))
    report = inverse_model_r2(torch.zeros_like(action), torch.zeros_like(action), action, None)
    assert all((value < 0.01).all() for value in report.values())
    torch.testing.assert_close(report["judge_r2_shuffled"], report["judge_r2_imagined"])


@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e-4])
def test_r2_of_an_action_that_hardly_varies_is_zero(scale):
    """Whatever was recovered, and so is that of a batch whose mask leaves nothing."""
    action, recovered = (torch.randn(64, 3, 4, generator=torch.Generator().manual_seed(seed)) for seed in (0, 1))
    action[..., 1] = 0.3 + scale * action[..., 1]
    for name, value in inverse_model_r2(recovered, action, action, None).items():
        assert value[1] == 0
        assert (value[[0, 2, 3]] != 0).all(), name
    nothing = inverse_model_r2(recovered, recovered, action, torch.zeros(64, 3, dtype=torch.bool))
    assert all((value == 0).all() for value in nothing.values())


def test_masked_transitions_do_not_count():
    """Neither as transitions, nor as actions of another clip."""
    generator = torch.Generator().manual_seed(0)
    action, real, imagined = (torch.randn(32, 3, 4, generator=generator) for _ in range(3))
    mask = torch.arange(32)[:, None].expand(32, 3) < 20
    report = inverse_model_r2(*(torch.where(mask[..., None], value, 1e6) for value in (real, imagined, action)), mask)
    expected = inverse_model_r2(real[:20], imagined[:20], action[:20], None)
    for name in ("judge_r2_real", "judge_r2_imagined"):
        torch.testing.assert_close(report[name], expected[name])
    # clip 0 has clip 31 before it, which is masked: 19 pairs are left
    pairs = inverse_model_r2(imagined[1:20], imagined[1:20], action[:19], None)["judge_r2_imagined"]
    torch.testing.assert_close(report["judge_r2_shuffled"], pairs)
