"""Preemption: on SIGTERM or SIGINT, writes a checkpoint after the current step and exits."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType

from torchrl.trainers import Trainer

from torchrl_ficreg._torchrl_compat import stop_reason
from torchrl_ficreg.distributed import any_rank, world_size

# Exit code for "start the same command again", distinct from success, an error (1) and death by the signal (143).
# HTCondor reads it as "wrote a checkpoint"; a SLURM script can test for it before `scontrol requeue`.
PREEMPTED = 85
_INTERRUPTED = 128 + signal.SIGINT  # what a shell reports for a command that Ctrl-C ended


class Preempted(SystemExit):
    """Ends the process after a signal; the same command continues.

    The exit code is :data:`PREEMPTED`, 85, and 130 after SIGINT. Under torchrun the launcher itself exits with 1.

    Args:
        signum (int): the signal received.
        resumes (bool, optional): whether the same command continues, rather than starting over; it only changes the
            message. Default: ``True``.
    """

    def __init__(self, signum: int, resumes: bool = True) -> None:
        super().__init__(_INTERRUPTED if signum == signal.SIGINT else PREEMPTED)
        self.signal = signal.Signals(signum)
        self.resumes = resumes

    def __str__(self) -> str:
        then = "continues where it stopped" if self.resumes else "starts over"
        return f"stopped by {self.signal.name}: the same command {then}."


class _Handler:
    """Context that handles some signals in the main thread. Subclasses define :meth:`_handle`.

    A signal that the process ignores stays ignored: shells start background jobs with SIGINT ignored.
    """

    def __init__(self, signals: tuple[int, ...]) -> None:
        self._signals = signals
        self._before: dict[int, object] = {}

    def __enter__(self) -> _Handler:
        self._pid = os.getpid()
        if threading.current_thread() is threading.main_thread():  # Python allows handlers nowhere else
            handled = [number for number in self._signals if signal.getsignal(number) is not signal.SIG_IGN]
            self._before = {number: signal.signal(number, self._receive) for number in handled}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() != self._pid:  # a forked worker inherits the handler; the signal shall end it
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        self._handle(number)

    def _handle(self, number: int) -> None:
        raise NotImplementedError


class exit_on_signal(_Handler):  # noqa: N801 (reads as a statement, like contextlib's)
    """Context: a signal raises :class:`Preempted` at the current line, so that ``finally`` clauses run.

    Args:
        *signals (int): the signals. Default: SIGTERM.
        resumes (bool, optional): see :class:`Preempted`. Default: ``True``.

    Examples:
        >>> with exit_on_signal():
        ...     os.kill(os.getpid(), signal.SIGTERM)
        Traceback (most recent call last):
        ...
        torchrl_ficreg.trainers.signals.Preempted: stopped by SIGTERM: the same command continues where it stopped.
    """

    def __init__(self, *signals: int, resumes: bool = True) -> None:
        super().__init__(signals or (signal.SIGTERM,))
        self._resumes = resumes

    def _handle(self, number: int) -> None:
        raise Preempted(number, self._resumes)


class stop_on_signal(_Handler):  # noqa: N801
    """Context around :meth:`OfflineTrainer.train`: on a signal the current step ends and a checkpoint is written.

    With several ranks all stop after the same step, whichever received the signal. With SIGINT among the signals, a
    second Ctrl-C stops a single process at once.

    Args:
        trainer (Trainer): to be stopped.
        *signals (int): the signals. Default: SIGTERM.

    Raises:
        Preempted: on exit, if a signal was received. An exception of the training is raised instead.
        KeyboardInterrupt: at once, at a second SIGINT.
    """

    def __init__(self, trainer: Trainer, *signals: int) -> None:
        super().__init__(signals or (signal.SIGTERM,))
        self._trainer = trainer
        self._received = 0
        self._alone = world_size() == 1
        if not self._alone:
            trainer.register_op("post_steps", self._synchronize)

    def _handle(self, number: int) -> None:
        # torchrun forwards a Ctrl-C that its processes have received already: with several ranks, two may be one.
        if self._alone and number == self._received == signal.SIGINT:
            raise KeyboardInterrupt
        self._received = number
        if self._alone:
            self._trainer.request_stop(signal.Signals(number).name)

    def _synchronize(self) -> None:
        device = next(self._trainer.loss_module.parameters()).device
        if any_rank(self._received != 0, device):
            self._received = self._received or self._signals[0]
            self._trainer.request_stop(signal.Signals(self._received).name)

    def __exit__(self, kind: type[BaseException] | None, *details: object) -> None:
        super().__exit__()
        if kind is None and self._received:
            raise Preempted(self._received)


def stop_requested(trainer: Trainer) -> bool:
    """Whether a signal has asked the trainer to stop after this step. Little time remains then."""
    return stop_reason(trainer) in signal.Signals.__members__
