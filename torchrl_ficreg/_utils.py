"""Small files: written in one piece and never through a link, read with a bound and with one line for an error."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import secrets
import shutil
import signal
import stat
import time
import warnings
from collections.abc import Callable, Collection, Iterator
from multiprocessing import resource_tracker
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any


MOST_JSON_BYTES = 64 * 2**20

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

# Neither exists on Windows. O_NONBLOCK: opening a FIFO returns at once, also where one replaced the file after a look.
NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)
NO_WAIT = getattr(os, "O_NONBLOCK", 0)
BINARY = getattr(os, "O_BINARY", 0)  # only Windows has it: without it a descriptor there turns every \n into \r\n
_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP)
_QUIET_SECONDS = 2.0


def write_atomic(path: str | Path, data: bytes | str) -> None:
    """Writes a small file in one piece: a crash or a full disk leaves the old content or the new one.

    The content goes into a new file of a random name beside ``path``, is flushed to the disk, and takes the name
    ``path``. A link at ``path`` is replaced, never followed.

    Args:
        path: the file. Its folder must exist.
        data: the content; text is written as UTF-8.

    Raises:
        OSError: the file cannot be written; ``path`` is what it was.

    Examples:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "notes.json"
        >>> write_atomic(file, "{}")
        >>> file.read_text(), [path.name for path in file.parent.iterdir()]
        ('{}', ['notes.json'])
    """
    path = Path(path)
    part = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
    descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | NO_FOLLOW | BINARY, 0o644)
    try:
        try:
            write_all(descriptor, data.encode() if isinstance(data, str) else data)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def write_all(descriptor: int, data: Any) -> None:
    """Writes a whole buffer: one ``write`` may stop short of it (2 GiB on Linux)."""
    view = memoryview(data)
    view = view.cast("B") if view.nbytes else view[:0]  # an empty state cannot be cast
    while view:
        view = view[os.write(descriptor, view) :]


def require_regular_file(path: str | Path, *, links: bool = True) -> os.stat_result:
    """Checks that a path is a regular file, and returns its ``stat``.

    Opening a FIFO waits for a process at its other end, and a device has no size.

    Args:
        path: what is about to be opened.
        links: accept a link to a regular file. Pass ``False`` before writing.

    Raises:
        FileNotFoundError: there is nothing at ``path``.
        ValueError: a folder, FIFO, socket or device, or a link where ``links`` is false.

    Examples:
        >>> require_regular_file("/dev/null")
        Traceback (most recent call last):
        ...
        ValueError: /dev/null is a device, expected a regular file: restore it, or correct the path.
    """
    found = os.stat(path) if links else os.lstat(path)
    if not stat.S_ISREG(found.st_mode):
        raise ValueError(f"{path} is {_kind(found.st_mode)}, expected a regular file: restore it, or correct the path.")
    return found


def read_bytes(path: str | Path, *, most: int | None = None) -> bytes:
    """The content of a regular file.

    Args:
        path: the file; a link to one is followed.
        most: bytes above which it is refused. Default: none.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no regular file, or larger than ``most``.
    """
    require_regular_file(path)
    descriptor = os.open(path, os.O_RDONLY | NO_WAIT | BINARY)
    with open(descriptor, "rb") as file:
        size = os.fstat(descriptor).st_size
        if most is not None and size > most:
            raise ValueError(f"{path} has {size} bytes, expected at most {most}: it is another file, or damaged.")
        return file.read()


def read_json(path: str | Path, what: str = "JSON file", *, most: int = MOST_JSON_BYTES) -> Any:
    """Reads a JSON file.

    Args:
        path: the file.
        what: what it is meant to be, for errors: ``"header of a dataset"``.
        most: bytes above which it is refused.

    Returns:
        The value; its type and fields are the caller's to check.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is no regular file, too large, not UTF-8, not JSON or nested too deeply.

    Examples:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "a.json"
        >>> write_atomic(file, '{"a": 1}')
        >>> read_json(file)
        {'a': 1}
    """
    content = read_bytes(path, most=most)
    try:
        return json.loads(content.decode("utf-8"))
    # UnicodeDecodeError and JSONDecodeError are ValueErrors, as is an integer of too many digits.
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no readable {what} ({error}): restore the file.") from error


def lock_file(descriptor: int, path: str | Path, *, wait: bool = False) -> bool:
    """Takes the exclusive lock of an open file; closing it, or the end of the process, releases the lock.

    Waiting for longer than two seconds is said once, with the process that holds the lock where the system tells.

    Args:
        descriptor: the open file or folder.
        path: what it protects, for messages.
        wait: wait for another holder.

    Returns:
        False, with a warning, where the system or the file system has no locks.

    Raises:
        BlockingIOError: another process holds it and ``wait`` is false.
        OSError: any other error.
    """
    from torchrl import torchrl_logger

    try:
        if fcntl is None:
            raise OSError(errno.ENOSYS, "this system has none")
        begin = time.monotonic()
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return True
            except BlockingIOError:
                if not wait:
                    raise
            if time.monotonic() - begin > _QUIET_SECONDS:
                torchrl_logger.warning(f"waiting for {path}: another process{_holder(descriptor)} holds it.")
                fcntl.flock(descriptor, fcntl.LOCK_EX)
                return True
            time.sleep(0.05)
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        torchrl_logger.warning(
            f"{path} cannot be locked ({error.strerror}): going on without a lock. Do not start a second process that "
            "writes there."
        )
        return False


def lock_folder(path: str | Path) -> bool:
    """Takes the exclusive lock of a folder until the process ends.

    Args:
        path: the folder.

    Returns:
        False, with a warning, where the system or the file system has no locks.

    Raises:
        BlockingIOError: another process holds it.
        OSError: any other error.
    """
    descriptor = -1 if fcntl is None else os.open(path, os.O_RDONLY)  # Windows opens no folders
    return lock_file(descriptor, path)


def _holder(descriptor: int) -> str:
    """The part of a message that names the holder, from Linux's table of locks; empty where unknown."""
    try:
        found, locks = os.fstat(descriptor), Path("/proc/locks").read_text(encoding="utf-8").splitlines()
    except OSError:
        return ""
    name = f"{os.major(found.st_dev):02x}:{os.minor(found.st_dev):02x}:{found.st_ino}"
    fields = [line.split() for line in locks]  # "1: FLOCK ADVISORY WRITE 12 08:01:345 0 EOF"; a waiting one has "->"
    pids = [field[4] for field in fields if len(field) > 5 and field[1] == "FLOCK" and field[5] == name]
    return f" (pid {pids[0]})" if pids and int(pids[0]) > 0 else ""


def _kind(mode: int) -> str:
    names = {
        stat.S_ISLNK: "a link",
        stat.S_ISDIR: "a folder",
        stat.S_ISFIFO: "a FIFO",
        stat.S_ISSOCK: "a socket",
        stat.S_ISCHR: "a device",
        stat.S_ISBLK: "a device",
    }
    return next((name for test, name in names.items() if test(mode)), "no regular file")


_RESERVE = 256 * 2**20  # most bytes left alone: logs, checkpoints, the rest of the system
_RESERVED_PART = 0.02  # and no more than this part of a small disk


def nearest_folder(path: Path) -> Path:
    """A folder, or the nearest one there is above it."""
    place = path.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    return place


def require_space(path: str | Path, num_bytes: int) -> None:
    """Checks that a folder, which need not exist yet, can take so many bytes more.

    Args:
        path: where they will be written.
        num_bytes: how many.

    Raises:
        OSError: there is less free space than that and a reserve: 256 MiB, or 2 % of a disk smaller than 13 GB.

    Examples:
        >>> require_space("somewhere/new", 1)
    """
    place = nearest_folder(Path(path).expanduser())
    total, _, free = shutil.disk_usage(place)
    reserve = min(_RESERVE, int(total * _RESERVED_PART))
    if num_bytes + reserve > free:
        raise OSError(
            f"{path} needs {num_bytes / 1e6:.1f} MB and a reserve of {reserve / 1e6:.1f} MB, {place} has "
            f"{free / 1e6:.1f} MB free: record fewer episodes or smaller frames, or write to another disk."
        )


ONE_THREAD = {  # read when a library is loaded, before any code of a worker process could say so
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "LP_NUM_THREADS": "0",  # Mesa's software GL: helpers beside the thread that draws
}


@contextlib.contextmanager
def environment_variables(variables: dict[str, str]) -> Iterator[None]:
    """Sets some variables, and puts the former ones back at the end.

    Args:
        variables: name -> value.

    Examples:
        >>> with environment_variables({"TORCHRL_FICREG_EXAMPLE": "1"}):
        ...     "TORCHRL_FICREG_EXAMPLE" in os.environ
        True
        >>> "TORCHRL_FICREG_EXAMPLE" in os.environ
        False
    """
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


class WorkerTraceback(Exception):
    """Cause of an exception that was raised in a worker process: the traceback there, as text."""


def wait_patiently(
    signs: Collection[Any], workers: Callable[[], str], *, warn_after: float, timeout: float
) -> list[Any]:
    """``multiprocessing.connection.wait`` that warns after a while and gives up in the end.

    Args:
        signs: connections and sentinels, of which one has to become ready.
        workers: names the processes waited for.
        warn_after: seconds until a warning.
        timeout: seconds until the error.

    Returns:
        those that are ready.

    Raises:
        TimeoutError: none became ready in time.
    """
    began = time.monotonic()
    ready = wait(list(signs), min(warn_after, timeout))
    if not ready and warn_after < timeout:
        warnings.warn(
            f"{workers()} has not answered for {warn_after:.0f} s: slow, or stopped? Waiting for up to {timeout:.0f} s.",
            stacklevel=2,
        )
        ready = wait(list(signs), max(0.0, timeout - (time.monotonic() - began)))
    if not ready:
        raise TimeoutError(f"{workers()} has not answered for {timeout:.0f} s: look whether it is stopped or stuck.")
    return ready


def out_of_handles(error: BaseException) -> RuntimeError | None:
    """The error to raise instead of one that stands for too many open files, None for any other."""
    if getattr(error, "errno", None) in (errno.EMFILE, errno.ENFILE) or "Too many open files" in str(error):
        return RuntimeError(
            "too many open files to run the worker processes: raise the limit (ulimit -n 4096), or use fewer workers."
        )
    return None


@contextlib.contextmanager
def without_interrupts() -> Iterator[None]:
    """Processes started meanwhile never receive SIGINT, from their first instant on: Ctrl-C is their parent's to handle.

    A Ctrl-C in the meantime reaches this process at the end.

    Examples:
        >>> with without_interrupts():
        ...     signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])
        True
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # which unblocks SIGINT when it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # inherited by processes
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
