"""Claim: every loss of the collection is a TorchRL loss module as one should be. The tests are in the base class."""

from __future__ import annotations

import pytest
import torch
from _loss_test_base import LossTestBase
from loss_collection import COLLECTION, make_clip, make_networks

from torchrl_ficreg import FICRegLoss
from torchrl_ficreg.objectives import PLDMLoss


class TestLeWMLoss(LossTestBase):
    name = "lewm"


class TestFICRegLoss(LossTestBase):
    name = "paper"

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"context": "dead"}, "unknown context 'dead': choose one of 'detached', 'live'"),
            ({"consistency": "mae"}, "unknown consistency 'mae': choose one of 'mse', 'nll', 'trusted'"),
            ({"consistency_target": "goal"}, "unknown consistency_target 'goal': choose one of 'action', 'judge'"),
            ({"consistency_steps": 0}, "consistency_steps must be a positive whole number, got 0"),
            ({"consistency_steps": 1.5}, "consistency_steps must be a positive whole number, got 1.5"),
            ({"consistency": "nll"}, "consistency='nll' needs a judge that writes 'recovered_action_log_var'"),
        ],
    )
    def test_wrong_arguments_are_refused(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            FICRegLoss(*make_networks(), **arguments)


class TestFICRegLossLive(LossTestBase):
    name = "live"


class TestFICRegLossTrusted(LossTestBase):
    name = "trusted"


class TestFICRegLossLikelihood(LossTestBase):
    name = "nll"


class TestFICRegLossEnsemble(LossTestBase):
    name = "ensemble"


class TestFICRegLossTransformer(LossTestBase):
    name = "transformer"


class TestFICRegLossJudgeTarget(LossTestBase):
    name = "judge"


class TestFICRegLossTwoSteps(LossTestBase):
    name = "two_steps"


class TestFICRegLossTwoStepsLive(LossTestBase):
    name = "two_steps_live"


class TestFICRegLossDiagnostics(LossTestBase):
    name = "diagnostics"


class TestJointInverseLoss(LossTestBase):
    name = "joint"


class TestJointInverseLossWithoutSIGReg(LossTestBase):
    name = "joint_bare"


class TestPLDMLoss(LossTestBase):
    name = "pldm"

    @pytest.mark.parametrize("margin", [0.0, -1.0, float("nan")])
    def test_a_margin_out_of_range_is_refused(self, margin):
        with pytest.raises(ValueError, match="std_margin must be positive"):
            PLDMLoss(*make_networks(), std_margin=margin)

    def test_terms_and_weights_are_the_published_ones(self):
        """From the definitions of stable-worldmodel's ``wm/loss.py``, whose recipe has the default weights."""
        weights = {"var": 18.0, "cov": 12.0, "time_sim": 0.2, "time_var": 0.7, "time_cov": 0.0, "idm": 0.0}
        loss = PLDMLoss(*make_networks(0.0)).eval()
        assert {name: getattr(loss, f"{name}_coeff").item() for name in weights} == pytest.approx(weights)
        assert loss.out_keys == ["loss_pred", "loss_var", "loss_cov", "loss_time_sim", "loss_time_var"]
        loss = PLDMLoss(*make_networks(0.0), time_cov_coeff=1.0).eval()
        clip = make_clip(frames=3)
        latent, found = loss.peek(clip).transpose(0, 1), loss(clip)  # [B, T, D]
        centred = latent - latent.mean(0)
        off = ~torch.eye(6, dtype=torch.bool)

        def moments(rows):  # of N centred rows [..., N, D]: mean square of the entries off the diagonal
            return (rows.transpose(-2, -1) @ rows / (rows.shape[-2] - 1))[..., off].square().mean()

        def hinge(rows):
            return torch.relu(1 - (rows.var(-2) + 1e-4).sqrt()).mean()

        over_batch = centred.transpose(0, 1)  # [T, B, D]
        expected = {
            "loss_var": 18 * hinge(over_batch),
            "loss_cov": 12 * moments(over_batch),
            "loss_time_sim": 0.2 * (latent[:, 1:] - latent[:, :-1]).square().mean(),
            "loss_time_var": 0.7 * hinge(centred),
            "loss_time_cov": moments(centred),
        }
        for key, value in expected.items():
            torch.testing.assert_close(found[key], value)


def test_no_loss_is_left_out():
    assert {case.name for case in LossTestBase.__subclasses__()} == set(COLLECTION)
