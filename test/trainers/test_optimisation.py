"""One AdamW over all networks, an exact schedule, clipped gradients, and a halt at the first number that is none."""

from __future__ import annotations

import math

import pytest
import torch
from tiny import finite, make_data, make_trainer, same, weights

from torchrl_ficreg.trainers import WarmupCosine


def watch_updates(trainer, what):
    """Collects ``what()`` right before every update of the optimiser."""
    seen = []
    trainer.optimizer.register_step_pre_hook(lambda *_: seen.append(what()))
    return seen


def test_the_learning_rate_rises_linearly_and_falls_as_a_cosine_over_the_real_length():
    """27 steps, a third of them warm-up: k / 9 of the peak at update k, then half a cosine that would be 0 at 28."""
    trainer = make_trainer(warmup=1 / 3, lr=0.5, validate=False)
    rates = watch_updates(trainer, lambda: trainer.optimizer.param_groups[0]["lr"])
    trainer.train()
    rise = [0.5 * k / 9 for k in range(1, 10)]
    fall = [0.25 * (1 + math.cos(math.pi * k / 18)) for k in range(18)]
    assert rates == pytest.approx(rise + fall, rel=1e-12)
    assert trainer.optimizer.param_groups[0]["lr"] == pytest.approx(0, abs=1e-12)


def test_the_factor_peaks_at_one_and_ends_at_zero_for_any_length_and_warm_up():
    for steps in (1, 2, 7, 1000):
        for warmup in (0.0, 0.01, 0.5, 0.99):
            factor = WarmupCosine(steps, warmup)
            values = [factor(step) for step in range(steps)]
            assert max(values) == 1
            assert all(0 < value <= 1 for value in values)
            assert factor(steps) == pytest.approx(0, abs=1e-12) or factor.rise >= steps


def test_the_table_shows_the_learning_rate_of_its_own_step(tmp_path):
    trainer = make_trainer(tmp_path, log_interval=1, validate=False)
    rates = watch_updates(trainer, lambda: trainer.optimizer.param_groups[0]["lr"])
    trainer.train()
    column = [line.split(",")[3] for line in (tmp_path / "metrics.csv").read_text().splitlines()]
    assert column[0] == "learning_rate"
    assert [float(value) for value in column[1:]] == pytest.approx(rates, rel=1e-5)


@pytest.mark.parametrize("method", ["ficreg", "lewm"])
def test_one_adamw_holds_every_trained_parameter_once(method):
    trainer = make_trainer(method=method)
    (group,) = trainer.optimizer.param_groups
    networks = [trainer.loss_module.encoder_params, trainer.loss_module.predictor_params]
    if method == "ficreg":
        networks.append(trainer.loss_module.inverse_model_params)
    expected = {id(p) for network in networks for p in network.parameters()}
    held = [id(p) for p in group["params"]]
    assert isinstance(trainer.optimizer, torch.optim.AdamW)
    assert len(held) == len(set(held))
    assert set(held) == expected


@pytest.mark.parametrize("method", ["ficreg", "lewm"])
def test_every_trained_parameter_moves(method):
    trainer = make_trainer(method=method, epochs=1, validate=False)
    before = {name: p.detach().clone() for name, p in trainer.loss_module.named_parameters()}
    trainer.train()
    still = [name for name, p in trainer.loss_module.named_parameters() if torch.equal(p, before[name])]
    assert not still


def test_gradients_are_clipped_to_the_norm_and_the_norm_before_clipping_is_reported(tmp_path):
    trainer = make_trainer(tmp_path, clip_norm=0.01, log_interval=1, validate=False)
    params = trainer.optimizer.param_groups[0]["params"]
    norms = watch_updates(trainer, lambda: torch.stack([p.grad.norm() for p in params]).norm().item())
    trainer.train()
    assert norms == pytest.approx([0.01] * 27, rel=1e-3)
    reported = [float(line.split(",")[2]) for line in (tmp_path / "metrics.csv").read_text().splitlines()[1:]]
    assert min(reported) > 0.1


def test_the_objective_is_the_plain_sum_of_the_terms():
    """One plain AdamW step by hand, from the same seed, lands on the same weights."""
    trainer, by_hand = make_trainer(validate=False), make_trainer(validate=False)
    trainer.request_stop()
    torch.manual_seed(5)
    trainer.train()
    assert trainer.step == 1
    torch.manual_seed(5)
    loss, optimizer = by_hand.loss_module, by_hand.optimizer
    sum(loss(make_data().sample()).values()).backward()
    torch.nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], 1.0)
    optimizer.step()
    assert same(weights(trainer), weights(by_hand))


def poison(trainer, step: int, value: float) -> None:
    """Turns one number of the encoder's last layer into ``value`` before the given step."""
    parameter = next(p for name, p in trainer.loss_module.named_parameters() if name.startswith("predictor_params"))

    def inject(batch):
        if trainer.step == step - 1:
            with torch.no_grad():
                parameter.view(-1)[0] = value
        return batch

    trainer.register_op("batch_process", inject)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_stops_the_run_and_says_where(tmp_path, value):
    """The message names the step, the terms and the last good checkpoint; no other weight has moved."""
    trainer = make_trainer(tmp_path)
    poison(trainer, 12, value)
    kept = {}
    trainer.register_op("batch_process", lambda batch: kept.update(weights(trainer)))
    with pytest.raises(FloatingPointError) as caught:
        trainer.train()
    message = str(caught.value)
    assert message.startswith("step 12: not finite: ")
    assert "loss_pred=nan" in message and "loss_consistency=nan" in message
    assert "loss_sigreg" not in message and "loss_idm" not in message
    last = trainer.checkpoint_rotation.latest()
    assert f"the last good checkpoint is {last}" in message and last.exists()
    moved = [
        name for name, p in trainer.loss_module.named_parameters() if not torch.equal(p, kept[name]) and not p.isnan().any()
    ]
    assert not moved
    again = make_trainer(tmp_path)
    assert again.resume() and again.step == 9 and finite(weights(again))


def test_the_first_step_may_fail_too_and_without_a_checkpoint():
    trainer = make_trainer()
    poison(trainer, 1, math.nan)
    with pytest.raises(FloatingPointError, match="step 1: not finite: .*; there is no checkpoint yet"):
        trainer.train()


def test_a_huge_learning_rate_is_stopped_not_followed():
    """Weights blown up by lr = 1e30 end the run in words instead of training on NaN."""
    with pytest.raises(FloatingPointError, match="Try a smaller learning rate"):
        make_trainer(lr=1e30, warmup=0).train()


def test_bf16_trains_to_about_the_same_losses_and_keeps_float32_weights():
    """Autocast touches the computation alone: weights and moments stay float32, losses agree within 10 %."""
    ends = {}
    for precision in ("fp32", "bf16"):
        trainer = make_trainer(precision=precision, validate=False)
        trainer.train()
        ends[precision] = trainer._log_dict["loss_sigreg"][-1]
        assert all(p.dtype == torch.float32 for p in trainer.loss_module.parameters())
        assert all(state["exp_avg"].dtype == torch.float32 for state in trainer.optimizer.state.values())
    assert ends["bf16"] != ends["fp32"]
    assert ends["bf16"] == pytest.approx(ends["fp32"], rel=0.1)


@pytest.mark.parametrize(
    "setting",
    [
        {"epochs": 0},
        {"lr": 0.0},
        {"weight_decay": -1.0},
        {"warmup": 1.0},
        {"warmup": -0.1},
        {"clip_norm": 0.0},
        {"log_interval": 0},
        {"validation_batches": 0},
    ],
)
def test_settings_out_of_range_are_refused(setting):
    with pytest.raises(ValueError, match="positive"):
        make_trainer(**setting)


def test_incomplete_batches_are_refused():
    """An epoch's short last batch would make the run longer than its schedule."""
    with pytest.raises(ValueError, match="drop_last=True"):
        make_trainer(data=make_data(drop_last=False))


def test_an_unknown_precision_is_refused():
    with pytest.raises(ValueError, match="unknown precision 'fp16'"):
        make_trainer(precision="fp16").train()
