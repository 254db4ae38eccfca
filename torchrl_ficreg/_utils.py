"""Shared helpers: small files, file locks, disk space, optional packages, environment variables, worker processes."""

from __future__ import annotations

import contextlib
import errno
import importlib
import json
import os
import secrets
import shutil
import signal
import stat
import time
import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import wait
from pathlib import Path
from types import ModuleType
from typing import Any

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

MOST_JSON_BYTES = 64 * 2**20

# Flags that some systems lack. NO_WAIT: opening a FIFO returns at once, also where one replaced the file after it was
# checked. BINARY exists on Windows only: without it a descriptor there turns every \n into \r\n.
NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)
NO_WAIT = getattr(os, "O_NONBLOCK", 0)
BINARY = getattr(os, "O_BINARY", 0)

# Read when a library is loaded, before any code of a worker process could set it.
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "LP_NUM_THREADS": "0",  # Mesa's software GL: helpers beside the thread that draws
}

_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP)
_QUIET_SECONDS = 2.0
_RESERVE_BYTES = 256 * 2**20  # disk space left alone: logs, checkpoints, the rest of the system
_RESERVE_FRACTION = 0.02  # and no more than this fraction of a small disk


# ------------------------------------------------------------------ small files


def write_atomic(path: str | Path, data: bytes | str) -> None:
    """Writes a small file in one piece: a crash or a full disk leaves the old content or the new one.

    The content goes into a new file of a random name beside ``path``, is flushed to the disk, and takes the name
    ``path``. A link at ``path`` is replaced, never followed.

    Args:
        path (str or Path): the file. Its folder must exist.
        data (bytes or str): the content; text is written as UTF-8.

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

    Opening a FIFO would wait for a process at its other end, and a device has no size.

    Args:
        path (str or Path): what is about to be opened.

    Keyword Args:
        links (bool, optional): accept a link to a regular file. Pass ``False`` before writing. Default: ``True``.

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


def read_bytes(path: str | Path, *, most: int | None = None) -> bytes:
    """The content of a regular file.

    Args:
        path (str or Path): the file; a link to one is followed.

    Keyword Args:
        most (int, optional): largest number of bytes that is accepted. Default: ``None``, any.

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
        path (str or Path): the file.
        what (str, optional): what it should be, for errors, such as ``"header of a dataset"``. Default: ``"JSON file"``.

    Keyword Args:
        most (int, optional): largest number of bytes that is accepted. Default: 64 MiB.

    Returns:
        The value; the caller checks its type and fields.

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


# ------------------------------------------------------------------ locks and disk space


def lock_file(descriptor: int, path: str | Path, *, wait: bool = False) -> bool:
    """Takes the exclusive lock of an open file; closing it, or the end of the process, releases the lock.

    After two seconds of waiting it warns once, with the id of the process that holds the lock where that is known.

    Args:
        descriptor (int): the open file or folder.
        path (str or Path): what it protects, for messages.

    Keyword Args:
        wait (bool, optional): wait for another holder. Default: ``False``.

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
            f"{path} cannot be locked ({error.strerror}): continuing without a lock. Do not start a second process that "
            "writes there."
        )
        return False


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


@contextmanager
def lock_folder(path: str | Path) -> Iterator[bool]:
    """Holds the exclusive lock of a folder.

    Args:
        path (str or Path): the folder.

    Yields:
        False, with a warning, where the system or the file system has no locks.

    Raises:
        BlockingIOError: another process holds it.
        OSError: any other error.
    """
    descriptor = -1 if fcntl is None else os.open(path, os.O_RDONLY)  # Windows opens no folders
    try:
        yield lock_file(descriptor, path)
    finally:
        if descriptor >= 0:
            os.close(descriptor)


def nearest_folder(path: Path) -> Path:
    """A folder, or the nearest existing one above it."""
    place = path.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    return place


def require_space(
    path: str | Path,
    num_bytes: int,
    *,
    what: str | None = None,
    reserve: int = _RESERVE_BYTES,
    advice: str = "record fewer episodes or smaller frames, or write to another disk",
) -> None:
    """Checks that a folder, which need not exist yet, has space for ``num_bytes`` more.

    Args:
        path (str or Path): where they will be written.
        num_bytes (int): bytes to be written.

    Keyword Args:
        what (str, optional): subject of the message. Default: ``path``.
        reserve (int, optional): bytes that must stay free, but no more than 2 % of the disk. Default: 256 MiB.
        advice (str, optional): end of the message.

    Raises:
        OSError: there is less free space than that and the reserve.

    Examples:
        >>> require_space("somewhere/new", 10**18)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        OSError: somewhere/new needs 1000000000000.0 MB and a reserve of ... MB, ... has ... MB free: record fewer ...
    """
    place = nearest_folder(Path(path).expanduser())
    total, _, free = shutil.disk_usage(place)
    reserve = min(reserve, int(total * _RESERVE_FRACTION))
    if num_bytes + reserve > free:
        also = f" and a reserve of {reserve / 1e6:.1f} MB" if reserve else ""
        raise OSError(
            f"{what or path} needs {num_bytes / 1e6:.1f} MB{also}, {place} has {free / 1e6:.1f} MB free: {advice}."
        )


# ------------------------------------------------------------------ optional packages


def require(module: str, extra: str, *, purpose: str, package: str | None = None) -> ModuleType:
    """Imports an optional module.

    Args:
        module (str): its dotted name.
        extra (str): the extra of this package that installs it.

    Keyword Args:
        purpose (str): what needs it, for the error.
        package (str, optional): the name under which it is installed. Default: ``module``.

    Returns:
        the module.

    Raises:
        ImportError: it is missing, or cannot be imported; the message says how to install it.

    Examples:
        >>> require("no_such_codec", "data", purpose="this format")
        Traceback (most recent call last):
        ...
        ImportError: this format needs no_such_codec: pip install 'torchrl_ficreg[data]' (No module named 'no_such_codec').
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        needed = f"{purpose} needs {package or module}"
        raise ImportError(f"{needed}: pip install 'torchrl_ficreg[{extra}]' ({error}).") from error


# ------------------------------------------------------------------ processes


@contextlib.contextmanager
def environment_variables(variables: dict[str, str]) -> Iterator[None]:
    """Sets environment variables temporarily.

    Args:
        variables (dict): name -> value.

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


@contextlib.contextmanager
def without_interrupts() -> Iterator[None]:
    """Processes started within this context never receive SIGINT: their parent handles Ctrl-C.

    A Ctrl-C during the context reaches this process at its end.

    Examples:
        >>> with without_interrupts():
        ...     signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])
        True
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # it unblocks SIGINT when it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # inherited by processes
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class WorkerTraceback(Exception):
    """Cause of an exception that was raised in a worker process: its traceback there, as text."""


def wait_patiently(
    signs: Collection[Any], workers: Callable[[], str], *, warn_after: float, timeout: float
) -> list[Any]:
    """``multiprocessing.connection.wait`` with a warning and a timeout.

    Args:
        signs (collection): connections and sentinels, of which one has to become ready.
        workers (callable): returns the names of the processes waited for.

    Keyword Args:
        warn_after (float): seconds until a warning.
        timeout (float): seconds until the error.

    Returns:
        the connections and sentinels that are ready.

    Raises:
        TimeoutError: none became ready in time.
    """
    began = time.monotonic()
    ready = wait(list(signs), min(warn_after, timeout))
    if not ready and warn_after < timeout:
        warnings.warn(
            f"{workers()} has not answered for {warn_after:.0f} s: it is slow or was stopped; waiting for up to {timeout:.0f} s.",
            stacklevel=2,
        )
        ready = wait(list(signs), max(0.0, timeout - (time.monotonic() - began)))
    if not ready:
        raise TimeoutError(f"{workers()} has not answered for {timeout:.0f} s: look whether it is stopped or stuck.")
    return ready


def out_of_handles(error: BaseException) -> RuntimeError | None:
    """The error to raise where the limit of open files is the cause of ``error``; None for any other cause."""
    if getattr(error, "errno", None) in (errno.EMFILE, errno.ENFILE) or "Too many open files" in str(error):
        return RuntimeError(
            "too many open files to run the worker processes: raise the limit (ulimit -n 4096), or use fewer workers."
        )
    return None
