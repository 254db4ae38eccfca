"""Claims about the second phase of a run: stopped anywhere, it ends as an unbroken one; it belongs to one encoder."""

from __future__ import annotations

import signal
from functools import partial

import pytest
import torch
import utils
from test_early_refusals import SMALL, write_dataset

from torchrl_ficreg import make_world_model
from torchrl_ficreg.trainers import Preempted
from torchrl_ficreg.trainers.stepper import OfflineStepper

NETWORKS = ["model.conv_channels=[4,8]", "model.predictor_width=16", "model.predictor_depth=1", "model.predictor_mlp_dim=16"]
NETWORKS += ["model.inverse_hidden_dim=16", "model.predictor_dropout=0.1"]
PHASE = ["refine.epochs=2", "refine.prediction_steps=2", "refine.batch_size=64", "optim.precision=fp32"]


@pytest.fixture
def phase(config, tmp_path):
    """``phase(folder)`` runs it on networks that are always the same, and returns their weights and the seconds."""
    cfg = config("train", f"dataset={write_dataset(tmp_path / 'data')}", *SMALL, *NETWORKS, *PHASE)
    data = utils.open_dataset(cfg)

    def run(folder, encoder_seed=0):
        torch.manual_seed(0)
        model, inverse_model = make_world_model(utils.model_config(cfg), 2)
        model.statistics = utils.make_dataset(cfg, data, "train").statistics
        if encoder_seed:
            torch.manual_seed(encoder_seed)
            model.encoder.reset_parameters_recursive()
        seconds = utils.refine(cfg, data, (model, inverse_model), tmp_path / folder, None)
        return [*model.state_dict().values(), *inverse_model.state_dict().values()], seconds

    return run


def stop_at(monkeypatch, number, stop):
    """Calls ``stop`` before the step of that number, counted over one process."""
    step, calls = OfflineStepper.step, iter(range(1, 100))
    monkeypatch.setattr(OfflineStepper, "step", lambda *args: (next(calls) == number and stop(), step(*args))[1])


def test_a_phase_that_is_stopped_ends_as_an_unbroken_one(phase, monkeypatch, tmp_path, capsys):
    """Before its first checkpoint, by a crash in its second epoch, by SIGTERM, and after its last step."""

    def crash():
        raise InterruptedError

    expected, _ = phase("unbroken")
    terminate = partial(signal.raise_signal, signal.SIGTERM)
    for number, stop, error in ((3, crash, InterruptedError), (6, crash, InterruptedError), (2, terminate, Preempted)):
        with monkeypatch.context() as patch, pytest.raises(error):
            stop_at(patch, number, stop)
            phase("stopped")
    weights, seconds = phase("stopped")
    assert [line.split(" after ")[1] for line in capsys.readouterr().out.splitlines()] == ["step 4 of 8", "step 6 of 8"]
    assert all(map(torch.equal, weights, expected))
    monkeypatch.setattr(OfflineStepper, "step", crash)
    weights, again = phase("stopped")
    assert all(map(torch.equal, weights, expected)) and 0 < again <= seconds
    assert not capsys.readouterr().out, "nothing is left to be continued"
    rows = [(tmp_path / name / "metrics.csv").read_text().splitlines() for name in ("unbroken", "stopped")]
    assert [row.split(",")[:2] for row in rows[0]] == [row.split(",")[:2] for row in rows[1]]


def test_a_phase_of_another_encoder_is_not_continued(phase):
    """Such as after an earlier checkpoint of the run was restored and trained on: its latents would be mixed with ours."""
    phase("run")
    with pytest.raises(ValueError, match="run is a training on latents of another encoder: move it away"):
        phase("run", encoder_seed=1)
