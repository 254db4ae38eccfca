"""Claims about the trainer: one AdamW over all networks, an exact schedule, refused settings."""

from __future__ import annotations

import math

import pytest
import torch
from tiny import make_data, make_trainer, SIZES, table, watch_updates

from torchrl_ficreg import LeWMLoss, make_world_model
from torchrl_ficreg.trainers import OfflineTrainer, WarmupCosine


def test_the_learning_rate_rises_linearly_and_falls_as_a_cosine_over_the_real_length(tmp_path):
    """27 steps, a third of them warm-up: k / 9 of the peak at update k, then half a cosine that would be 0 at 28.

    The table shows the rate of its own step.
    """
    trainer = make_trainer(tmp_path, warmup=1 / 3, lr=0.5, log_interval=1, validate=False)
    rates = watch_updates(trainer, lambda: trainer.optimizer.param_groups[0]["lr"])
    trainer.train()
    rise = [0.5 * k / 9 for k in range(1, 10)]
    fall = [0.25 * (1 + math.cos(math.pi * k / 18)) for k in range(18)]
    assert rates == pytest.approx(rise + fall, rel=1e-12)
    assert trainer.optimizer.param_groups[0]["lr"] == pytest.approx(0, abs=1e-12)
    assert [float(row["learning_rate"]) for row in table(tmp_path)] == pytest.approx(rates, rel=1e-5)


def test_the_factor_peaks_at_one_and_ends_at_zero_for_any_length_and_warm_up():
    for steps in (1, 2, 7, 1000):
        for warmup in (0.0, 0.01, 0.5, 0.99):
            factor = WarmupCosine(steps, warmup)
            values = [factor(step) for step in range(steps)]
            assert max(values) == 1
            assert all(0 < value <= 1 for value in values)
            assert factor(steps) == pytest.approx(0, abs=1e-12) or factor.rise >= steps


@pytest.mark.parametrize("method", ["ficreg", "lewm"])
def test_one_adamw_holds_every_trained_parameter_once_and_moves_it(method):
    trainer = make_trainer(method=method, epochs=1, validate=False)
    (group,) = trainer.optimizer.param_groups
    networks = [trainer.loss_module.encoder_params, trainer.loss_module.predictor_params]
    if method == "ficreg":
        networks.append(trainer.loss_module.inverse_model_params)
    expected = {id(p) for network in networks for p in network.parameters()}
    held = [id(p) for p in group["params"]]
    assert isinstance(trainer.optimizer, torch.optim.AdamW)
    assert len(held) == len(set(held))
    assert set(held) == expected
    before = {name: p.detach().clone() for name, p in trainer.loss_module.named_parameters()}
    trainer.train()
    still = [name for name, p in trainer.loss_module.named_parameters() if torch.equal(p, before[name])]
    assert not still


@pytest.mark.parametrize(
    ("setting", "value", "message"),
    [
        ("epochs", 0, "positive"),
        ("lr", 0.0, "positive"),
        ("weight_decay", -1.0, "not negative"),
        ("warmup", 1.0, r"warmup in \[0, 1\)"),
        ("warmup", -0.1, r"warmup in \[0, 1\)"),
        ("clip_norm", 0.0, "positive"),
        ("log_interval", 0, "positive"),
        ("validation_batches", 0, "positive"),
        ("precision", "fp16", "unknown precision 'fp16'"),
        ("data", make_data(drop_last=False), "drop_last=True"),  # short last batches would make a run outlast its schedule
        *(("accumulate", parts, f"accumulate={parts} must cut the 16 clips") for parts in (0, 3, 16)),
    ],
)
def test_settings_out_of_range_are_refused(setting, value, message):
    """Parts of a batch must be equal and hold two clips."""
    with pytest.raises(ValueError, match=message):
        make_trainer(**{setting: value}).train()


@pytest.mark.parametrize("reduction", ["sum", "none"])
def test_a_loss_that_is_no_mean_is_refused(reduction):
    """A sum would shrink with every part of a batch and every process."""
    model, _ = make_world_model(SIZES, 2)
    loss = LeWMLoss(model.encoder, model.predictor, reduction=reduction)
    with pytest.raises(ValueError, match=f"needs reduction='mean', got '{reduction}': build the loss with 'mean'"):
        OfflineTrainer(loss, make_data(), epochs=1, lr=1e-3)
