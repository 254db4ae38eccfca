"""A pool returns results and exceptions of its workers, in order where asked, and leaves no process behind."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import subprocess
import sys
import time

import pytest
import torch

from torchrl_ficreg.envs import _workers
from torchrl_ficreg.envs._workers import ordered_map, WorkerPool


class ComplicatedError(Exception):
    """Pickles, but cannot be unpickled: its constructor takes two arguments and keeps one."""

    def __init__(self, first, second):
        super().__init__(f"{first} and {second}")


class Counter:
    """What a worker holds in these tests."""

    def __init__(self):
        self.count = 0

    def add(self, number):
        self.count += number
        return self.count

    def fail(self, kind):
        if kind == "plain":
            raise KeyError("no such goal")
        if kind == "complicated":
            raise ComplicatedError("arm", "leg")
        return lambda: None  # cannot be pickled

    def threads(self):
        return torch.get_num_threads(), os.environ["OMP_NUM_THREADS"], os.environ["LP_NUM_THREADS"]

    def close(self):
        pass


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    with open(f"/proc/{pid}/stat") as file:
        return file.read().rpartition(")")[2].split()[0] == "Z"  # dead, not yet waited for by its parent


def wait_until(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


@contextlib.contextmanager
def spawned():
    """Worker processes start as they do outside of tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_workers, "multiprocessing", multiprocessing)
        yield


@pytest.fixture(scope="module")
def counters():
    with spawned():
        pool = WorkerPool(Counter, 2)
    yield pool
    pool.close()


def test_each_object_keeps_its_own_state(counters):
    before = counters.call("add", {0: (0,), 1: (0,)})
    assert counters.call("add", {0: (1,), 1: (10,)}) == {0: before[0] + 1, 1: before[1] + 10}
    assert counters.call("add", {1: (100,)}) == {1: before[1] + 110}


def test_exceptions_are_raised_with_their_messages_and_the_object_remains(counters):
    before = counters.call("add", {0: (0,)})[0]
    with pytest.raises(KeyError, match="no such goal") as caught:
        counters.call("fail", {0: ("plain",), 1: ("plain",)})
    assert "in fail" in str(caught.value.__cause__)  # the worker's traceback
    with pytest.raises(RuntimeError, match="ComplicatedError: arm and leg"):
        counters.call("fail", {1: ("complicated",)})
    with pytest.raises((AttributeError, RuntimeError), match="(?i)pickle"):
        counters.call("fail", {1: ("a result that cannot be sent",)})
    assert counters.call("add", {0: (1,)}) == {0: before + 1}


def test_a_worker_has_one_thread_and_ignores_sigint_and_the_parent_keeps_its_environment(counters):
    for pid in counters.pids:
        os.kill(pid, signal.SIGINT)
    assert counters.call("threads", {0: (), 1: ()}) == {0: (1, "1", "0"), 1: (1, "1", "0")}
    assert "LP_NUM_THREADS" not in os.environ or os.environ["LP_NUM_THREADS"] != "0"


def test_a_stopped_worker_causes_a_warning_and_then_an_error(counters, monkeypatch):
    """A stopped process sends nothing and does not end: only the timeout finds it, and closes the pool."""
    monkeypatch.setattr(_workers, "_JOIN_SECONDS", 0.2)
    assert len(counters.call("add", {0: (1,), 1: (1,)})) == 2
    counters._warn_after, counters._timeout, pids = 0.2, 1.0, counters.pids
    os.kill(pids[1], signal.SIGSTOP)
    with pytest.warns(UserWarning, match=f"worker process 2 of 2.*{pids[1]}.*has not answered for 0 s"):
        with pytest.raises(TimeoutError, match="has not answered for 1 s: look whether it is stopped"):
            counters.call("add", {0: (1,), 1: (1,)})
    assert counters.closed
    assert wait_until(lambda: all(map(gone, pids)))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_workers_end_with_a_killed_parent():
    script = """
import os, signal
from torchrl_ficreg.envs._workers import WorkerPool
from test_workers import Counter
if __name__ == "__main__":
    pool = WorkerPool(Counter, 1)
    pool.call("add", {0: (1,)})
    print(*pool.pids, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""
    path = os.pathsep.join([os.path.dirname(__file__), *filter(None, sys.path)])
    outcome = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path}
    )
    assert outcome.returncode == -signal.SIGKILL, outcome.stderr
    pids = [int(word) for word in outcome.stdout.split()]
    assert len(pids) == 1 and wait_until(lambda: all(map(gone, pids)))


@pytest.fixture
def few_handles():
    """``few_handles(n)`` leaves n file handles to this process; the former limit holds again afterwards."""
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)

    def limit(left):
        free = os.open(os.devnull, os.O_RDONLY)  # the lowest number there is
        os.close(free)
        resource.setrlimit(resource.RLIMIT_NOFILE, (free + left, hard))

    yield limit
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize("left", [1, 3, 8])
def test_a_lack_of_file_handles_is_reported_as_such(few_handles, monkeypatch, left):
    monkeypatch.setattr(_workers, "_JOIN_SECONDS", 0.1)
    few_handles(left)
    with spawned(), pytest.raises(RuntimeError, match="too many open files to run the worker processes: raise the limit"):
        WorkerPool(Counter, 4)


def slow_first_and_fails_at_50(item):
    time.sleep(0.3 if item == 0 else 0.0)
    if item == 50:
        raise ValueError(f"{item} is too large")
    return item


def dies_at_two(item):
    if item == 2:
        os._exit(7)
    return item


def test_results_keep_the_order_of_the_items_which_are_drawn_only_as_needed():
    """An exception is raised after the results before it."""
    drawn = []

    def items():
        for item in range(60):
            drawn.append(item)
            yield item

    results = ordered_map(slow_first_and_fails_at_50, items(), num_workers=2)
    with spawned():
        assert next(results) == 0
    assert len(drawn) <= 4
    assert [next(results) for _ in range(49)] == list(range(1, 50))
    with pytest.raises(ValueError, match="50 is too large") as caught:
        next(results)
    cause = str(caught.value.__cause__)
    assert "at item 50" in cause and "in slow_first_and_fails_at_50" in cause and len(drawn) <= 54


def test_a_worker_that_dies_ends_the_map():
    with pytest.raises(RuntimeError, match="worker process 1 of 1 died with exit code 7"):
        list(ordered_map(dies_at_two, range(4), num_workers=1))
