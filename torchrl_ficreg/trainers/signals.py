"""A job that is told to make room (SIGTERM), or is interrupted (Ctrl-C), stops at the next step, in good order."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType

from torchrl.trainers import Trainer

from torchrl_ficreg.distributed import any_process, together

# Told apart from success, from an error (1) and from a death by the signal (143): start the same command again. It is
# the number that HTCondor takes for "wrote a checkpoint", and that a SLURM script can ask for before
# `scontrol requeue`. Under torchrun the launcher itself exits with 1.
PREEMPTED = 85
_INTERRUPTED = 128 + signal.SIGINT  # what a shell shows for a command that Ctrl-C ended


class Preempted(SystemExit):
    """Ends the process in good order; what it was doing continues when the command is repeated.

    The exit code is :data:`PREEMPTED`, 85, and 130 after SIGINT. Under torchrun the launcher itself exits with 1.

    Args:
        signum: the signal received.
        resumes: bool, whether the same command continues, rather than starting over; it only changes the message.
            Default: True.
    """

    def __init__(self, signum: int, resumes: bool = True) -> None:
        super().__init__(_INTERRUPTED if signum == signal.SIGINT else PREEMPTED)
        self.signal, self.resumes = signal.Signals(signum), resumes

    def __str__(self) -> str:
        then = "continues where it stopped" if self.resumes else "starts over"
        return f"stopped by {self.signal.name}: the same command {then}."


class _Handler:
    """Installs itself for some signals, in the main thread, between ``__enter__`` and ``__exit__``.

    A signal that the process ignores stays ignored: shells have their background jobs ignore SIGINT.
    """

    def __init__(self, signals: tuple[int, ...]) -> None:
        self._signals, self._before = signals, {}

    def __enter__(self) -> _Handler:
        self._pid = os.getpid()
        if threading.current_thread() is threading.main_thread():  # Python allows handlers nowhere else
            heard = [number for number in self._signals if signal.getsignal(number) is not signal.SIG_IGN]
            self._before = {number: signal.signal(number, self._receive) for number in heard}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() != self._pid:  # a forked worker inherits the handler, but ends when it is told to
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        self._handle(number)

    def _handle(self, number: int) -> None:
        raise NotImplementedError


class exit_on_signal(_Handler):  # noqa: N801 (reads as a statement, like contextlib's)
    """Context: a signal raises :class:`Preempted` where the process happens to be, so that ``finally`` clauses run.

    Args:
        *signals: SIGTERM unless told otherwise.
        resumes: bool, see :class:`Preempted`. Default: True.

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
    """Context around :meth:`OfflineTrainer.train`: on a signal the step in progress ends, and a checkpoint is written.

    Where several processes train, all of them stop after the same step, whichever received the signal first. Among the
    signals may be SIGINT: a second Ctrl-C then stops a process on its own at once.

    Args:
        trainer: to be stopped.
        *signals: SIGTERM unless told otherwise.

    Raises:
        Preempted: on leaving, when a signal was received. Nothing is raised in its place where training failed.
        KeyboardInterrupt: at once, at a second SIGINT.
    """

    def __init__(self, trainer: Trainer, *signals: int) -> None:
        super().__init__(signals or (signal.SIGTERM,))
        self._trainer, self._received = trainer, 0
        self._alone = not together()
        if not self._alone:
            trainer.register_op("post_steps", self._agree)

    def _handle(self, number: int) -> None:
        # torchrun passes on a Ctrl-C that its processes have received already, so that among them two may be one.
        if self._alone and number == self._received == signal.SIGINT:
            raise KeyboardInterrupt
        self._received = number
        if self._alone:
            self._trainer.request_stop(signal.Signals(number).name)

    def _agree(self) -> None:
        device = next(self._trainer.loss_module.parameters()).device
        if any_process(self._received != 0, device):
            self._received = self._received or self._signals[0]
            self._trainer.request_stop(signal.Signals(self._received).name)

    def __exit__(self, kind: type[BaseException] | None, *details: object) -> None:
        super().__exit__()
        if kind is None and self._received:
            raise Preempted(self._received)


def told_to_stop(trainer: Trainer) -> bool:
    """Whether a signal has asked the trainer to stop after this step: time is short then."""
    return trainer._stop_training and trainer._stop_reason in signal.Signals.__members__
