"""Loggers: a CSV table on disk, and a wrapper that keeps a run going when a TorchRL logger fails or hangs."""

from __future__ import annotations

import atexit
import csv
import io
import os
import queue
import re
import threading
import time
import weakref
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchrl import torchrl_logger
from torchrl.record.loggers import Logger

from torchrl_ficreg._torchrl_compat import disconnect_wandb, tree_map, unhook_wandb
from torchrl_ficreg._utils import BINARY, NO_FOLLOW, NO_WAIT, read_bytes, write_all, write_atomic


_STEP = re.compile(r"\d{1,18}", re.ASCII)


class CsvRows:
    """Appends rows to a CSV file. A row may have new columns: the file is then rewritten atomically.

    While the file cannot be written, for example because the disk is full, rows wait in memory. It warns once, and
    removes what was written of an incomplete row.

    Args:
        path (Path): the file. The first row creates it and its folder.
        first (Iterable[str], optional): columns that come first, whether or not a row has them. Default: ``()``.

    Examples:
        >>> import tempfile
        >>> rows = CsvRows(Path(tempfile.mkdtemp()) / "table.csv")
        >>> rows.append({"step": 1, "loss": 0.5})
        >>> rows.append({"step": 2, "rank": 3.0})
        >>> rows.path.read_text().split()
        ['step,loss,rank', '1,0.5,', '2,,3']
    """

    def __init__(self, path: Path, first: Iterable[str] = ()) -> None:
        self.path = path
        self._first = tuple(first)
        self._columns: list[str] | None = None
        self._waiting: list[dict[str, Any]] = []
        self._warned = False

    def append(self, row: dict[str, Any]) -> None:
        """Writes a row, and those that wait in memory."""
        self._waiting.append(row)
        try:
            self._flush()
        except OSError as error:
            if not self._warned:
                torchrl_logger.warning(f"{self.path} cannot be written ({error}): rows wait in memory until it can be.")
            self._warned = True
        else:
            self._warned = False

    def _flush(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        present, old = self._header(), []
        columns = list(dict.fromkeys([*(present or self._first), *(key for row in self._waiting for key in row)]))
        if columns != present:
            if present:
                header, rows = _read(self.path)
                old = [dict(zip(header, row)) for row in rows]
            self._replace(columns, [*old, *self._waiting])
        else:
            _append(self.path, _lines(columns, self._waiting))
        self._columns, self._waiting = columns, []

    def _header(self) -> list[str] | None:
        """Columns of the file; None without a file or a header."""
        if self._columns is None and self.path.exists():
            self._columns = _read(self.path)[0] or None
        return self._columns if self.path.exists() else None

    def _replace(self, columns: list[str], rows: list[dict[str, Any]]) -> None:
        write_atomic(self.path, _lines(columns, [dict(zip(columns, columns)), *rows]))

    def drop_after(self, step: int) -> None:
        """Removes rows of later steps, and incomplete or damaged rows, atomically.

        Raises:
            ValueError: the header is damaged, or the path is not a regular file.
        """
        self._columns, self._waiting = None, []
        if not self.path.exists():
            return
        header, rows = _read(self.path)  # a killed process may leave an empty file
        whole = [row for row in rows if len(row) == len(header) and _STEP.fullmatch(row[0])]
        kept = [dict(zip(header, row)) for row in whole if int(row[0]) <= step]
        if kept:
            self._replace(header, kept)
        else:
            self.path.unlink()


def _read(path: Path) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a table, without the rows that cannot be parsed.

    Raises:
        ValueError: the header cannot be parsed, or the path is not a regular file.
    """
    first, *lines = read_bytes(path).decode(errors="replace").split("\n")
    try:
        header = next(csv.reader([first]), [])
    except csv.Error as error:
        raise ValueError(f"{path} is damaged ({error}, in its first line): restore it, or move it away.") from error
    rows = []
    for line in lines:
        try:
            rows += csv.reader([line])
        except csv.Error:  # a field of more than 128 kB
            continue
    return header, [row for row in rows if row]


def _lines(columns: list[str], rows: list[dict[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="")
    writer.writerows({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()} for row in rows)
    return text.getvalue()


def _append(path: Path, text: str) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | NO_FOLLOW | NO_WAIT | BINARY)
    try:
        before = os.fstat(descriptor).st_size
        try:
            write_all(descriptor, text.encode())
        except OSError:
            os.ftruncate(descriptor, before)
            raise
    finally:
        os.close(descriptor)


class TolerantLogger:
    """Forwards calls to a TorchRL logger until one fails or hangs; then warns once and drops all further calls.

    An unreachable server, one that no longer answers, or a full disk must not stop or block a training of days:
    ``metrics.csv`` has the same numbers. A daemon thread makes the calls in order, so they return None at once; a call
    made inside another one, in that thread, is executed directly. Tensors and arrays are copied.

    It has no state, so that a run may continue with another logger or none.

    Args:
        logger (Logger): any logger. Attributes that are not methods are read from it directly.

    Keyword Args:
        timeout (float, optional): seconds after which a call counts as hung, and that :meth:`flush` waits at most.
            Default: ``60.0``.
        max_calls (int, optional): calls that may be queued; a further one waits, up to ``timeout``. Default: ``1000``.

    Attributes:
        lost (bool): whether the logger has failed or hung.

    Raises:
        ValueError: ``timeout`` or ``max_calls`` is not positive.

    Examples:
        >>> class Server:
        ...     def log_scalar(self, name, value, step=None):
        ...         raise ConnectionError("no route to host")
        >>> logger = TolerantLogger(Server())
        >>> logger.log_scalar("loss", 0.5)
        >>> logger.flush()
        >>> logger.lost
        True
    """

    state_dict = load_state_dict = None

    def __init__(self, logger: Logger, *, timeout: float = 60.0, max_calls: int = 1000) -> None:
        if not timeout > 0 or max_calls < 1:
            raise ValueError(f"timeout and max_calls must be positive, got {timeout} and {max_calls}.")
        self._logger = logger
        self._timeout = timeout
        self.lost = False
        self._calls: queue.Queue[tuple] = queue.Queue(max_calls)
        self._worker: threading.Thread | None = None
        self._began: float | None = None  # time at which the current call began
        self._warning = threading.Lock()
        unhook_wandb()
        atexit.register(_flush, weakref.ref(self))  # runs before the exit handlers that the logger's package registered

    @classmethod
    def around(cls, logger: Logger | TolerantLogger | None) -> TolerantLogger | None:
        """Wraps a logger, unless it is None or wrapped already."""
        return logger if logger is None or isinstance(logger, cls) else cls(logger)

    def __getattr__(self, name: str) -> Any:
        if name == "_logger":  # while copying, before it is set
            raise AttributeError(name)
        value = getattr(self._logger, name)
        return self._guard(value) if callable(value) and not name.startswith("_") else value

    def attempt(self, work: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Queues a call of a function that uses the logger's backend, under the same rules as the logger's own methods.

        Args:
            work (Callable): the function.
            *args, **kwargs: its arguments.

        Returns:
            None; inside another call, the result of the function.
        """
        if threading.current_thread() is self._worker:
            return self._call(work, args, kwargs)
        if self._began is not None and time.monotonic() - self._began > self._timeout:
            self._hung()
        if self.lost:
            return None
        if self._worker is None or not self._worker.is_alive():
            self._worker = threading.Thread(target=self._work, name="logger", daemon=True)
            self._worker.start()
        try:
            self._calls.put((work, *tree_map(_copy, (args, kwargs))), timeout=self._timeout)
        except queue.Full:
            self._hung()

    def flush(self, timeout: float | None = None) -> None:
        """Waits until all queued calls were made.

        Args:
            timeout (float, optional): seconds after which the logger counts as hung. Default: that of the logger.
        """
        deadline = time.monotonic() + (self._timeout if timeout is None else timeout)
        with self._calls.all_tasks_done:
            while self._calls.unfinished_tasks and not self.lost and (left := deadline - time.monotonic()) > 0:
                self._calls.all_tasks_done.wait(min(left, 1.0))
            waiting = self._calls.unfinished_tasks
        if waiting:
            self._hung()

    def shutdown(self, *args: Any, **kwargs: Any) -> None:
        """Closes the logger after all queued calls, and waits as :meth:`flush` does."""
        self.attempt(self._logger.shutdown, *args, **kwargs)
        self.flush()

    close = shutdown

    def _work(self) -> None:
        while True:
            call = self._calls.get()
            self._began = time.monotonic()
            self._call(*call)
            self._began = None
            self._calls.task_done()

    def _call(self, work: Callable[..., Any], args: tuple, kwargs: dict[str, Any]) -> Any:
        if self.lost:
            return None
        try:
            return work(*args, **kwargs)
        except BaseException as error:  # whatever a backend raises, the thread must not end
            self._lose(f"{type(error).__name__}: {error}")

    def _hung(self) -> None:
        if not self.lost:
            self._lose(f"no answer within {self._timeout:g} s")
            disconnect_wandb()

    def _lose(self, reason: str) -> None:
        with self._warning:
            if self.lost:
                return
            self.lost = True
        torchrl_logger.warning(f"{type(self._logger).__name__} is lost ({reason}): the run goes on without it.")

    def _guard(self, method: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *args, **kwargs: self.attempt(method, *args, **kwargs)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._logger!r})"


class PhaseLogger:
    """Forwards the scalars of a later phase of a run: their names get a prefix, their steps follow those before.

    Args:
        logger (Logger): any logger.
        prefix (str): put in front of every name.
        first_step (int): added to every step; the largest one of the phase before.

    Examples:
        >>> class Print:
        ...     def log_scalar(self, name, value, step=None):
        ...         print(name, value, step)
        >>> PhaseLogger(Print(), "refine/", 100).log_scalar("loss", 0.5, step=10)
        refine/loss 0.5 110
    """

    def __init__(self, logger: Logger | TolerantLogger, prefix: str, first_step: int) -> None:
        self._logger, self._prefix, self._first_step = logger, prefix, first_step

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        """See :meth:`torchrl.record.loggers.Logger.log_scalar`."""
        self._logger.log_scalar(self._prefix + name, value, step=None if step is None else self._first_step + step)


def _copy(value: Any) -> Any:
    """Copies a tensor or an array, which its owner may overwrite before the call is made."""
    if isinstance(value, torch.Tensor):
        return value.detach().clone()
    return value.copy() if isinstance(value, np.ndarray) else value


def _flush(logger: weakref.ref[TolerantLogger]) -> None:
    """Runs at exit, where the daemon thread would end in the middle of a call."""
    if (alive := logger()) is not None:
        alive.flush()
