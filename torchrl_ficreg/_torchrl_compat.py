"""Every private name of TorchRL, tensordict, torch and wandb that the package uses, each in one place.

Private names may change with any release of their library. A test calls everything in this file, and another one finds
private names of other libraries elsewhere in the package.
"""

from __future__ import annotations

import copy
import sys
from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import nn
from torch._C._functorch import is_functorch_wrapped_tensor
from torch._subclasses import FakeTensor
from torch.nn.modules.batchnorm import _BatchNorm as BatchNorm
from torch.utils._pytree import tree_map
from torchrl.checkpoint import Checkpoint
from torchrl.data import ReplayBuffer
from torchrl.data.datasets.utils import _get_root_dir as default_root
from torchrl.envs.utils import _classproperty as classproperty
from torchrl.record.loggers import Logger
from torchrl.trainers import Trainer

__all__ = [
    "BaseTrainer",
    "BatchNorm",
    "FakeTensor",
    "HALF_WRITTEN",
    "PREFETCHED",
    "STATE_FOLDER",
    "UNPACKED",
    "check_batch_norm_input",
    "classproperty",
    "default_root",
    "disconnect_wandb",
    "in_functorch_transform",
    "is_functorch_wrapped_tensor",
    "keyword_arguments",
    "locked",
    "prefetching_paused",
    "step_count",
    "stop_reason",
    "tree_map",
    "unhook_wandb",
    "use_one_reader",
    "with_child",
    "without_compile",
]

_Module = TypeVar("_Module", bound=nn.Module)


# Trainer


def step_count(trainer: Trainer) -> int:
    """Optimisation steps that a trainer has taken, over all processes of a resumed run."""
    return trainer._optim_count


def stop_reason(trainer: Trainer) -> str | None:
    """The reason given to ``request_stop``; None where nothing has asked the trainer to stop."""
    return trainer._stop_reason if trainer._stop_training else None


class BaseTrainer(Trainer):
    """TorchRL's trainer with public names for what a subclass needs.

    Args:
        *args, **kwargs: as for :class:`torchrl.trainers.Trainer`.
        history (int, optional): latest numbers of each kind that stay in memory, for hooks such as TorchRL's
            ``EarlyStopping``. TorchRL keeps all of them. Default: ``100``.
        logger (Logger, optional): may have no ``state_dict``, in which case checkpoints leave it out without a warning.
            Default: ``None``.
    """

    def __init__(self, *args: Any, history: int = 100, logger: Logger | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._log_dict = defaultdict(partial(deque, maxlen=history))
        self._checkpoint_skip_warnings.add("logger")
        self.logger = logger

    @property
    def step(self) -> int:
        """Optimisation steps taken."""
        return self._optim_count

    def load_checkpoint(self, path: Path | str) -> None:
        """Loads all components of a checkpoint. Each moves its tensors to its own device."""
        checkpoint = Checkpoint() if self.checkpoint is None else self.checkpoint
        self._sync_checkpoint_components(checkpoint).load(path, map_location="cpu")

    def write_checkpoint(self) -> None:
        """Writes a checkpoint. :meth:`save_trainer` calls it where one is due."""
        super()._save_trainer()

    def _save_trainer(self) -> None:
        self.write_checkpoint()


# Checkpoint: names on disk

UNPACKED = "torchrl-checkpoint-load-*"  # folder in the one for temporary files into which an archive is unpacked
HALF_WRITTEN = (".*.stage-*", ".*.archive-*", ".*.delete-*")  # what a killed process leaves beside its checkpoints
STATE_FOLDER = {"shape": [], "_type": "<class 'tensordict._td.TensorDict'>"}  # entries of meta.json beside the tensors


# ReplayBuffer

PREFETCHED = "_prefetch_state"  # entry of a buffer's pickled state that holds prefetched batches


@contextmanager
def locked(buffer: ReplayBuffer, *, discard: bool = False) -> Iterator[None]:
    """Context: no other thread samples from a buffer, and prefetching waits.

    Args:
        buffer (ReplayBuffer): the buffer.
        discard (bool, optional): drop the batches that were prefetched. Default: ``False``.
    """
    with buffer._futures_lock:
        if discard:
            buffer._clear_prefetch_queue_locked()
        with buffer._replay_lock:
            yield


@contextmanager
def prefetching_paused(buffer: ReplayBuffer) -> Iterator[None]:
    """Context: the queue of prefetched batches belongs to this thread; the batches in it may still be read."""
    with buffer._futures_lock:
        yield


def use_one_reader(buffer: ReplayBuffer) -> None:
    """Prefetches with one thread.

    TorchRL starts as many threads as batches to prefetch. They acquire one lock in no fixed order, so that batches could
    change places; one thread is as fast and keeps the order.
    """
    if buffer._prefetch:
        buffer._prefetch_executor.shutdown(wait=False)
        buffer._prefetch_executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="clips")


# Modules


def keyword_arguments(module: nn.Module) -> Sequence[str] | None:
    """Arguments that a ``TensorDictModule`` passes its ``in_keys`` to, in their order; None where it has no such names."""
    return getattr(module, "_kwargs", None)


def without_compile(module: Any) -> Any:
    """The module that ``torch.compile`` wrapped; anything else as it is."""
    return getattr(module, "_orig_mod", module)


def with_child(module: _Module, name: str, child: nn.Module) -> _Module:
    """A shallow copy of a module with another child of that name. Everything else is shared."""
    other = copy.copy(module)
    other._modules = {**module._modules, name: child}
    return other


def check_batch_norm_input(layer: BatchNorm, x: torch.Tensor) -> None:
    """Checks the number of dimensions of a batch-norm layer's input.

    Raises:
        ValueError: x has another number of dimensions than the layer accepts.
    """
    layer._check_input_dim(x)


def in_functorch_transform() -> bool:
    """Whether a transform of ``torch.func``, such as ``vmap``, is active."""
    return torch._C._are_functorch_transforms_active()


# wandb


def unhook_wandb() -> None:
    """Removes wandb's import hooks, which report imports to its service: an import fails when the service is gone."""
    hooks = sys.modules.get("wandb.sdk.lib.import_hooks")
    if hooks is not None:
        hooks.unregister_all_post_import_hooks()


def disconnect_wandb() -> None:
    """Removes wandb's exit handler, which waits for a service that does not answer.

    The service ends when its parent process is gone. No public function does this. With another version of wandb, in
    which these names do not exist, nothing happens and the exit waits.
    """
    setup = getattr(sys.modules.get("wandb.sdk.wandb_setup"), "_singleton", None)
    forget = getattr(getattr(setup, "_connection", None), "_cleanup", None)
    if callable(forget):
        forget()
