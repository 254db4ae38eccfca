"""Where a system has no POSIX modules, flags and calls, as Windows has none, everything imports and the doors work.

The program below runs in a process of its own. TorchRL is imported on the system as it is; the package then finds only
what Windows has, and folders that cannot be opened as files.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

PROGRAM = '''
import importlib, inspect, mmap, os, pkgutil, signal, sys, types
from pathlib import Path

import tensorboard, torch, torchrl.collectors, torchrl.trainers

MODULES = "fcntl grp posix pty pwd resource syslog termios tty"
CALLS = """chown chroot confstr ctermid fchdir fchmod fchown fdatasync fork forkpty fstatvfs getegid geteuid getgid
getgroups getloadavg getpgid getpriority getuid killpg lchown lockf major makedev minor mkfifo mknod nice openpty
pathconf pipe2 posix_fadvise posix_fallocate posix_spawn pread preadv pwrite pwritev readv register_at_fork
sched_getaffinity sched_setaffinity sendfile setgid setuid statvfs sync sysconf uname wait wait3 wait4 waitid writev"""
FLAGS = {"O_RDONLY", "O_WRONLY", "O_RDWR", "O_APPEND", "O_CREAT", "O_EXCL", "O_TRUNC"}
SIGNALS = {"SIGABRT", "SIGFPE", "SIGILL", "SIGINT", "SIGSEGV", "SIGTERM"}
BINARY = 1 << 30


def hide(module, *names):
    """In place of a module, for those who import it from now on: one without some names."""
    copy = types.ModuleType(module.__name__)
    copy.__dict__.update({name: value for name, value in vars(module).items() if name not in names})
    sys.modules[module.__name__] = copy
    return copy


def opened(path, flags, *rest, open=os.open):
    if "torchrl_ficreg" in inspect.currentframe().f_back.f_code.co_filename:
        assert flags & BINARY, f"{path} is opened as text"
        if Path(path).is_dir():
            raise PermissionError(13, "Permission denied", str(path))
    return open(path, flags & ~BINARY, *rest)


for name in MODULES.split():
    sys.modules[name] = None
windows = hide(os, *CALLS.split(), *(name for name in vars(os) if name.startswith("O_") and name not in FLAGS))
windows.open, windows.O_BINARY = opened, BINARY
hide(mmap, *(name for name in vars(mmap) if name.startswith(("MAP_", "PROT_", "MADV_"))))
posix = ("SIG", "pthread_", "sig", "set", "alarm", "pause")
keep = {"SIG_DFL", "SIG_IGN", "signal", "set_wakeup_fd", *SIGNALS}
hide(signal, *(name for name in vars(signal) if name.startswith(posix) and name not in keep))

import torchrl_ficreg

assert not hasattr(torchrl_ficreg._utils.os, "pread")
for module in pkgutil.walk_packages(torchrl_ficreg.__path__, "torchrl_ficreg."):
    importlib.import_module(module.name)

from tiny import make_trainer, record
from torchrl_ficreg._utils import lock_folder
from torchrl_ficreg.data import EpisodeWriter, OfflineTrajectories
from torchrl_ficreg._utils import without_interrupts
from torchrl_ficreg.trainers import stop_on_signal
from torchrl_ficreg.trainers.hooks import resident_memory
from torchrl_ficreg.trainers.loggers import CsvRows

here = Path(sys.argv[1])
episodes, path = record(10), here / "data"
for stop in (4, 10):  # the second opening finds what a crash left in the index
    with EpisodeWriter(path, target_episodes=10, meta={"env": "two_room"}) as writer:
        for episode in episodes[writer.num_episodes : stop]:
            writer.append(episode)
    if stop == 4:
        index = path / torchrl_ficreg.data.layout.INDEX_FILE
        index.write_bytes(index.read_bytes() + b"{torn")
assert writer.complete

def data(split="train", **settings):
    return OfflineTrajectories(path, split=split, num_frames=2, frame_skip=2, batch_size=16, **settings)

validation = data("validation", drop_last=False)
for epochs, begun in ((1, 0), (2, 9)):  # the second trainer continues from the checkpoint of the first
    settings = {"validation_buffer": validation, "validate": False, "epochs": epochs, "schedule_epochs": 2}
    trainer = make_trainer(here / "run", data=data(), **settings)
    trainer.resume()
    assert trainer.step == begun, trainer.step
    with stop_on_signal(trainer):
        trainer.train()
with lock_folder(here) as locked:
    assert locked is False  # and says so
with without_interrupts():
    assert resident_memory() is None or resident_memory() > 0
rows = CsvRows(here / "table.csv")
for step in range(2):
    rows.append({"step": step})
print("worked", trainer.step)
'''


def test_without_posix_modules_everything_imports_and_a_run_is_trained_and_continued(tmp_path):
    """A dataset is written in two openings and read, a run is trained, and continued from its checkpoint."""
    root = Path(__file__).resolve().parent
    path = os.pathsep.join([str(root.parent), str(root / "trainers")])
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-c", PROGRAM, str(tmp_path)]
    done = subprocess.run(line, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "worked 18" in done.stdout
    assert "cannot be locked (this system has none)" in done.stdout + done.stderr  # told, and work goes on
