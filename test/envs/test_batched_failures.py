"""Calls reach the objects, results and exceptions come back, and no process outlives its owner."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest
import torch

from torchrl_ficreg.envs.batched import Actors
from torchrl_ficreg.envs.collect import ordered_map


class ComplicatedError(Exception):
    """Pickles, but cannot be unpickled: its constructor wants two arguments and keeps one."""

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
        return file.read().rpartition(")")[2].split()[0] == "Z"  # dead, and its parent has not looked yet


def wait_until(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


@pytest.fixture(scope="module")
def counters():
    actors = Actors(Counter, 2)
    yield actors
    actors.close()


def test_each_object_keeps_its_own_state(counters):
    before = counters.call("add", {0: (0,), 1: (0,)})
    assert counters.call("add", {0: (1,), 1: (10,)}) == {0: before[0] + 1, 1: before[1] + 10}
    assert counters.call("add", {1: (100,)}) == {1: before[1] + 110}


def test_exceptions_arrive_with_their_words_and_the_object_lives_on(counters):
    before = counters.call("add", {0: (0,)})[0]
    with pytest.raises(KeyError, match="no such goal") as caught:
        counters.call("fail", {0: ("plain",), 1: ("plain",)})
    assert "in fail" in str(caught.value.__cause__)  # the worker's traceback
    with pytest.raises(RuntimeError, match="ComplicatedError: arm and leg"):
        counters.call("fail", {1: ("complicated",)})
    with pytest.raises((AttributeError, RuntimeError), match="(?i)pickle"):
        counters.call("fail", {1: ("a result that cannot be sent",)})
    assert counters.call("add", {0: (1,)}) == {0: before + 1}


def test_a_worker_has_one_thread_and_the_parent_keeps_its_environment(counters):
    assert counters.call("threads", {0: (), 1: ()}) == {0: (1, "1", "0"), 1: (1, "1", "0")}
    assert "LP_NUM_THREADS" not in os.environ or os.environ["LP_NUM_THREADS"] != "0"


def test_workers_leave_ctrl_c_to_their_parent(counters):
    for pid in counters.pids:
        os.kill(pid, signal.SIGINT)
    assert len(counters.call("add", {0: (0,), 1: (0,)})) == 2


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_workers_end_with_a_killed_parent():
    script = """
import os, signal
from torchrl_ficreg.envs.batched import Actors
from torchrl_ficreg.envs.collect import ordered_map
from test_batched_failures import Counter
if __name__ == "__main__":
    actors = Actors(Counter, 1)
    actors.call("add", {0: (1,)})
    print(*actors.pids, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""
    here = os.path.dirname(__file__)
    outcome = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env={**os.environ, "PYTHONPATH": here}
    )
    assert outcome.returncode == -signal.SIGKILL, outcome.stderr
    pids = [int(word) for word in outcome.stdout.split()]
    assert len(pids) == 1
    assert wait_until(lambda: all(map(gone, pids)))


def test_a_stopped_worker_is_warned_of_and_given_up(monkeypatch):
    """Without a limit the call would wait for ever; a stopped process leaves no sign of its own."""
    monkeypatch.setattr("torchrl_ficreg.envs.batched._WARN_SECONDS", 0.2)
    monkeypatch.setattr("torchrl_ficreg.envs.batched._JOIN_SECONDS", 0.2)
    actors = Actors(Counter, 2, timeout=600.0)
    assert actors.call("add", {0: (1,), 1: (1,)}) == {0: 1, 1: 1}
    actors._timeout = 1.0
    os.kill(actors.pids[1], signal.SIGSTOP)
    pids = actors.pids
    with pytest.warns(UserWarning, match=f"worker process 2 of 2.*{pids[1]}.*has not answered for 0 s"):
        with pytest.raises(TimeoutError, match="has not answered for 1 s: look whether it is stopped"):
            actors.call("add", {0: (1,), 1: (1,)})
    assert actors.closed
    assert wait_until(lambda: all(map(gone, pids)))


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


@pytest.mark.parametrize("start", [lambda: Actors(Counter, 4), lambda: list(ordered_map(abs, range(8), num_workers=4))])
@pytest.mark.parametrize("left", [1, 3, 8])
def test_a_lack_of_file_handles_is_said_and_is_no_death(few_handles, start, left):
    few_handles(left)
    with pytest.raises(RuntimeError, match="too many open files to run the worker processes: raise the limit"):
        start()
