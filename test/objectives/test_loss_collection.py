"""Claim: every loss of the collection is a TorchRL loss module as one should be. The tests are in the base class."""

from __future__ import annotations

import pytest
from _loss_test_base import LossTestBase
from loss_collection import COLLECTION, make_networks

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


def test_no_loss_is_left_out():
    assert {case.name for case in LossTestBase.__subclasses__()} == set(COLLECTION)
