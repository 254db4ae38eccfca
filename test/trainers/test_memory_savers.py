"""Claims about the switches of a step: what they save costs no accuracy."""

from __future__ import annotations

import copy
import csv

import pytest
import torch
from tiny import make_data, make_trainer, SIZES

from torchrl_ficreg import LeWMLoss, make_world_model, ViTEncoder
from torchrl_ficreg.modules import transformer as recompute
from torchrl_ficreg.modules.transformer import checkpoint_activations
from torchrl_ficreg.trainers import OfflineTrainer


def weights_after(steps: int = 9, **settings) -> list[torch.Tensor]:
    trainer = make_trainer(epochs=1, validate=False, **settings)
    trainer.train()
    assert trainer.step == steps
    return [p.detach().clone() for p in trainer.loss_module.parameters()]


def test_activations_computed_again_give_the_same_weights_to_the_last_bit(monkeypatch):
    """With dropout in the predictor, and a judge whose frozen weights are taken out before the backward pass."""
    expected = weights_after()
    calls = []
    monkeypatch.setattr(recompute, "checkpoint", lambda *a, run=recompute.checkpoint, **k: calls.append(1) or run(*a, **k))

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
    with pytest.raises(ValueError, match="none of these networks"):
        checkpoint_activations(torch.nn.Linear(2, 2))


def test_parts_of_a_batch_give_the_mean_of_their_gradients():
    """One update from two parts is AdamW on the mean of their gradients; dropout is off, SIGReg draws for each part."""
    trainer = make_trainer(
        epochs=1, validate=False, accumulate=2, sizes=SIZES.__class__(**{**vars(SIZES), "predictor_dropout": 0.0})
    )
    loss, clips = copy.deepcopy(trainer.loss_module), make_data()
    batch = clips.sample()
    params = [p for p in loss.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(params, lr=trainer.optimizer.param_groups[0]["lr"], weight_decay=1e-3)
    outputs = []
    for part in batch.chunk(2):
        outputs.append(loss(part))
        (sum(outputs[-1].values()) / 2).backward()
    torch.nn.utils.clip_grad_norm_(params, 1.0)
    optimizer.step()
    found = trainer.optimization_stepper.step(trainer, batch)
    for name in outputs[0].keys():
        torch.testing.assert_close(found[name], (outputs[0][name] + outputs[1][name]).detach() / 2)
    ours = [p for p in trainer.loss_module.parameters() if p.requires_grad]
    torch.testing.assert_close(ours, params, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("reduction", ["sum", "none"])
def test_a_loss_that_is_no_mean_is_refused(reduction):
    """A sum would shrink with every part of a batch and every process."""
    model, _ = make_world_model(SIZES, 2)
    loss = LeWMLoss(model.encoder, model.predictor, reduction=reduction)
    with pytest.raises(ValueError, match=f"needs reduction='mean', got '{reduction}': build the loss with 'mean'"):
        OfflineTrainer(loss, make_data(), epochs=1, lr=1e-3)


@pytest.mark.parametrize("accumulate", [0, 3, 16])
def test_parts_must_be_equal_and_hold_two_clips(accumulate):
    with pytest.raises(ValueError, match=f"accumulate={accumulate} must cut the 16 clips"):
        make_trainer(accumulate=accumulate)


def test_a_compiled_step_learns_the_same(monkeypatch):
    """Traced into one graph and run by autograd's own kernels; what a compiler makes of it is torch's affair."""
    sizes = SIZES.__class__(**{**vars(SIZES), "predictor_dropout": 0.0})
    expected = weights_after(sizes=sizes)
    compiled = []

    def compile(self, *args, **kwargs):
        compiled.append(self)
        self._compiled_call_impl = torch.compile(self._call_impl, backend="aot_eager", fullgraph=True)

    monkeypatch.setattr(torch.nn.Module, "compile", compile)
    torch.testing.assert_close(weights_after(sizes=sizes, compile=True), expected, rtol=1e-4, atol=1e-5)
    assert len(compiled) == 1


@pytest.mark.slow
def test_inductors_step_learns_the_same(tmp_path):
    """Term by term; the weights that BatchNorm makes idle follow the noise of their gradients."""
    sizes, tables = SIZES.__class__(**{**vars(SIZES), "predictor_dropout": 0.0}), []
    for compile in (False, True):
        weights_after(sizes=sizes, compile=compile, run_dir=tmp_path / str(compile), log_interval=1)
        with (tmp_path / str(compile) / "metrics.csv").open() as file:
            tables.append([[float(row[key]) for key in row if key.startswith("loss_")] for row in csv.DictReader(file)])
    assert len(tables[0]) == 9
    torch.testing.assert_close(*map(torch.tensor, tables), rtol=2e-3, atol=1e-4)
