"""Claims about preemption: a signal stops a run after a step or in an evaluation, and the same command continues it."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import time
from contextlib import suppress

import pytest
import torch
from tiny import at_step, logged_steps, make_trainer, run_until_signalled, same, weights
from torchrl.checkpoint import Checkpoint

from torchrl_ficreg.trainers import EvaluationHook, find_checkpoint, Preempted, PREEMPTED, stop_on_signal


def kill_in(trainer, step: int, *numbers: int) -> None:
    """Sends signals to this process before a step has ended."""

    def kill(batch) -> None:
        if trainer.step == step:
            for number in numbers:
                os.kill(os.getpid(), number)

    trainer.register_op("post_optim_log", kill)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, PREEMPTED), (signal.SIGINT, 130)])
def test_a_signal_stops_after_the_step_and_the_repeated_command_changes_no_bit(tmp_path, continue_run, number, code):
    """Sent in the middle of steps 5 and 14, which end no epoch; afterwards the former handler is back."""
    handler = signal.getsignal(number)
    for stop_at in (5, 14):
        trainer = make_trainer(tmp_path)
        trainer.resume()
        kill_in(trainer, stop_at, number)
        with pytest.raises(Preempted, match=f"stopped by {number.name}: the same command continues") as caught:
            with stop_on_signal(trainer, signal.SIGTERM, signal.SIGINT):
                trainer.train()
        assert caught.value.code == code and PREEMPTED == 85
        assert trainer.step == stop_at
        assert signal.getsignal(number) is handler
    continue_run(tmp_path, 14)
    assert logged_steps(tmp_path) == [4, 8, 12, 16, 20, 24, 27]


def test_a_second_ctrl_c_stops_at_once(tmp_path):
    """In the middle of step 5, so that no checkpoint is written. SIGTERM may come any number of times."""
    trainer = make_trainer(tmp_path)
    kill_in(trainer, 5, signal.SIGTERM, signal.SIGTERM, signal.SIGINT, signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        with stop_on_signal(trainer, signal.SIGTERM, signal.SIGINT):
            trainer.train()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert not list((tmp_path / "checkpoints").glob("checkpoint-*"))


def test_a_background_job_goes_on_ignoring_ctrl_c():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    with stop_on_signal(make_trainer(), signal.SIGTERM, signal.SIGINT):
        os.kill(os.getpid(), signal.SIGINT)
    assert signal.signal(signal.SIGINT, before) is signal.SIG_IGN


def evaluating(run_dir, evaluate) -> tuple:
    """A run of 27 steps that evaluates after every nine of them; ``evaluate(trainer)`` gets the trainer."""
    trainer = make_trainer(run_dir)
    hook = EvaluationHook(lambda: evaluate(trainer), 9, trainer.metrics_table)
    hook.register(trainer)
    return trainer, hook


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 85), (signal.SIGINT, 130)])
def test_a_signal_ends_an_evaluation_at_once_and_the_epoch_is_kept(tmp_path, unbroken, number, code):
    """The evaluation of step 18 would never end. The run stops there with a checkpoint, and ends as it should."""
    finally_ran = []

    def evaluate(trainer) -> dict[str, float]:
        torch.rand(3)
        try:
            if trainer.step == 18:
                os.kill(os.getpid(), number)
                time.sleep(600)
        finally:
            finally_ran.append(trainer.step)
        return {"success_rate": 0.5}

    trainer, hook = evaluating(tmp_path, evaluate)
    began = time.monotonic()
    with pytest.raises(Preempted) as caught:
        with stop_on_signal(trainer, signal.SIGTERM, signal.SIGINT):
            trainer.train()
    assert time.monotonic() - began < 60
    assert caught.value.code == code
    assert finally_ran == [9, 18]
    assert trainer.loss_module.training
    assert hook.metadata(trainer) == {"success_rate": -1.0}
    rates = [Checkpoint.manifest(p)["metadata"]["success_rate"] for p in trainer.checkpoint_rotation.checkpoints()]
    assert rates == [0.5, -1.0]
    again, _ = evaluating(tmp_path, lambda trainer: {"success_rate": 0.25})
    assert again.resume() and again.step == 18
    again.train()
    assert same(weights(again), unbroken)


def test_an_evaluation_does_not_begin_when_a_signal_came_in_its_step(tmp_path):
    """A stop that a hook of the user requested does not prevent it."""
    asked = []
    for name, stop in (
        ("signal", lambda trainer: os.kill(os.getpid(), signal.SIGTERM)),
        ("hook", lambda trainer: trainer.request_stop("early")),
    ):
        trainer, _ = evaluating(tmp_path / name, lambda trainer, name=name: asked.append(name) or {"success_rate": 1.0})
        at_step(trainer, 9, lambda trainer=trainer, stop=stop: stop(trainer))
        with suppress(Preempted), stop_on_signal(trainer):
            trainer.train()
        assert trainer.step == 9
    assert asked == ["hook"]


def test_a_signal_in_an_evaluation_has_its_usual_effect_outside_of_stop_on_signal(tmp_path):
    """Ctrl-C in a notebook, for example: KeyboardInterrupt, with the networks back in train mode."""

    def evaluate(trainer) -> dict[str, float]:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(600)

    trainer, _ = evaluating(tmp_path, evaluate)
    with pytest.raises(KeyboardInterrupt):
        trainer.train()
    assert trainer.step == 9 and trainer.loss_module.training


def test_preempted_at_any_time_a_process_exits_with_85_and_its_steps_are_kept(tmp_path):
    """Three times at a random time. The last checkpoint has the weights of a run that took as many steps at once."""
    context, chance, reached = multiprocessing.get_context("forkserver"), random.Random(0), 0
    for _ in range(3):
        process = context.Process(target=run_until_signalled, args=(tmp_path / "run",))
        process.start()
        while process.is_alive() and not (tmp_path / f"ready{reached}").exists():
            time.sleep(0.001)
        process.join(chance.uniform(0, 0.1))
        process.terminate()
        process.join(60)
        assert process.exitcode == 85
        before, reached = reached, Checkpoint.manifest(find_checkpoint(tmp_path / "run"))["metadata"]["optim_steps"]
        assert reached > before
    last = make_trainer(tmp_path / "run", validate=False, epochs=60)
    assert last.resume() and last.step == reached
    whole = make_trainer(validate=False, epochs=60)
    at_step(whole, reached, whole.request_stop)
    whole.train()
    assert same(weights(last), weights(whole))
