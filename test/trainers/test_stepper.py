"""Claims about a step: one AdamW update of the sum of the terms, stopped by the first number that is not finite."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from tiny import make_data, make_trainer, SIZES, STILL, table, watch_updates, weights

from torchrl_ficreg import make_world_model, ViTEncoder
from torchrl_ficreg.modules import transformer
from torchrl_ficreg.modules.transformer import checkpoint_activations


def test_gradients_are_clipped_to_the_norm_and_the_norm_before_clipping_is_reported(tmp_path):
    trainer = make_trainer(tmp_path, clip_norm=0.01, log_interval=1, validate=False)
    params = trainer.optimizer.param_groups[0]["params"]
    norms = watch_updates(trainer, lambda: torch.stack([p.grad.norm() for p in params]).norm().item())
    trainer.train()
    assert norms == pytest.approx([0.01] * 27, rel=1e-3)
    assert min(float(row["grad_norm"]) for row in table(tmp_path)) > 0.1


def poison(trainer, step: int, value: float) -> None:
    """Sets one weight of the predictor to ``value`` before a step."""
    parameter = next(p for name, p in trainer.loss_module.named_parameters() if name.startswith("predictor_params"))

    def inject(batch):
        if trainer.step == step - 1:
            with torch.no_grad():
                parameter.view(-1)[0] = value
        return batch

    trainer.register_op("batch_process", inject)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_stops_the_run_and_says_where(tmp_path, continue_run, value):
    """The message names the step, the terms and the last good checkpoint, from which the run ends as it should.

    No other weight has moved.
    """
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
    continue_run(tmp_path, 9)


def test_the_first_step_may_fail_too_and_without_a_checkpoint():
    trainer = make_trainer()
    poison(trainer, 1, math.nan)
    with pytest.raises(FloatingPointError, match="step 1: not finite: .*; there is no checkpoint yet. Try a smaller learning"):
        trainer.train()


def test_bf16_trains_to_about_the_same_losses_and_keeps_float32_weights(tmp_path):
    """Autocast touches the computation alone: weights and moments stay float32, losses agree within 10 %."""
    ends = {}
    for precision in ("fp32", "bf16"):
        trainer = make_trainer(tmp_path / precision, precision=precision, validate=False)
        trainer.train()
        ends[precision] = float(table(tmp_path / precision)[-1]["loss_sigreg"])
        assert all(p.dtype == torch.float32 for p in trainer.loss_module.parameters())
        assert all(state["exp_avg"].dtype == torch.float32 for state in trainer.optimizer.state.values())
    assert ends["bf16"] != ends["fp32"]
    assert ends["bf16"] == pytest.approx(ends["fp32"], rel=0.1)


def weights_after(steps: int = 9, **settings) -> list[torch.Tensor]:
    trainer = make_trainer(epochs=1, validate=False, **settings)
    trainer.train()
    assert trainer.step == steps
    return [p.detach().clone() for p in trainer.loss_module.parameters()]


def test_activations_computed_again_give_the_same_weights_to_the_last_bit(monkeypatch):
    """With dropout in the predictor, and a judge whose frozen weights are taken out before the backward pass."""
    expected = weights_after()
    calls = []
    checkpoint = transformer.checkpoint
    monkeypatch.setattr(transformer, "checkpoint", lambda *a, **k: calls.append(1) or checkpoint(*a, **k))

    def switched(*args, make=make_world_model, **kwargs):
        networks = make(*args, **kwargs)
        checkpoint_activations(networks[0])
        return networks

    monkeypatch.setattr("tiny.make_world_model", switched)
    assert all(map(torch.equal, weights_after(), expected))
    assert len(calls) == 9 * 2 * SIZES.predictor_depth  # both predictions of every step


def test_a_vision_transformer_keeps_less_for_its_backward_pass():
    """And in evaluation, or once switched off, nothing is different."""
    encoder, pixels = ViTEncoder(image_size=28, depth=4), torch.randint(0, 256, (2, 3, 28, 28), dtype=torch.uint8)

    def kept_and_gradients() -> tuple[int, list[torch.Tensor]]:
        kept = {}
        with torch.autograd.graph.saved_tensors_hooks(
            lambda t: kept.setdefault(t.untyped_storage().data_ptr(), t.untyped_storage().nbytes()) and t, lambda t: t
        ):
            encoder(pixels=pixels).square().sum().backward()
        gradients = [p.grad.clone() for p in encoder.parameters()]
        encoder.zero_grad()
        return sum(kept.values()), gradients

    plain, expected = kept_and_gradients()
    checkpoint_activations(encoder)
    less, gradients = kept_and_gradients()
    assert all(map(torch.equal, gradients, expected))
    assert less < plain
    with torch.no_grad():
        assert not encoder(pixels=pixels).requires_grad
    checkpoint_activations(encoder, enabled=False)
    assert kept_and_gradients()[0] == plain


def test_networks_without_transformer_blocks_cannot_be_switched():
    with pytest.raises(ValueError, match="have no transformer blocks"):
        checkpoint_activations(torch.nn.Linear(2, 2))


@pytest.mark.parametrize("parts", [1, 2])
def test_a_step_is_adamw_on_the_mean_of_the_gradients_of_the_parts_of_a_batch(parts):
    """The objective is the plain sum of the terms. Dropout is off, SIGReg draws for each part."""
    trainer = make_trainer(epochs=1, validate=False, accumulate=parts, sizes=STILL)
    loss, batch = copy.deepcopy(trainer.loss_module), make_data().sample()
    params = [p for p in loss.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(params, lr=trainer.optimizer.param_groups[0]["lr"], weight_decay=1e-3)
    outputs = []
    for part in batch.chunk(parts):
        outputs.append(loss(part))
        (sum(outputs[-1].values()) / parts).backward()
    torch.nn.utils.clip_grad_norm_(params, 1.0)
    optimizer.step()
    found = trainer.optimization_stepper.step(trainer, batch)
    for name in outputs[0].keys():
        torch.testing.assert_close(found[name], sum(output[name] for output in outputs).detach() / parts)
    ours = [p for p in trainer.loss_module.parameters() if p.requires_grad]
    torch.testing.assert_close(ours, params, rtol=1e-5, atol=1e-6)


def test_a_compiled_step_learns_the_same(monkeypatch):
    """Traced into one graph and run by eager kernels; test_base_compile.py has larger losses and their backward pass."""
    settings = {"sizes": STILL, "method": "lewm"}
    expected = weights_after(**settings)
    compiled = []

    def compile(self, *args, **kwargs):
        compiled.append(self)
        self._compiled_call_impl = torch.compile(self._call_impl, backend="eager", fullgraph=True)

    monkeypatch.setattr(torch.nn.Module, "compile", compile)
    torch.testing.assert_close(weights_after(**settings, compile=True), expected, rtol=1e-4, atol=1e-5)
    assert len(compiled) == 1


@pytest.mark.slow
def test_inductors_step_learns_the_same(tmp_path):
    """Term by term; the weights that BatchNorm makes idle follow the noise of their gradients."""
    tables = []
    for compile in (False, True):
        weights_after(sizes=STILL, compile=compile, run_dir=tmp_path / str(compile), log_interval=1)
        rows = table(tmp_path / str(compile))
        tables.append([[float(row[key]) for key in row if key.startswith("loss_")] for row in rows])
    assert len(tables[0]) == 9
    torch.testing.assert_close(*map(torch.tensor, tables), rtol=2e-3, atol=1e-4)
