"""Claims about private names of other libraries: all are in one file, and each does what the package expects."""

from __future__ import annotations

import ast
import inspect
import json
import sys
import zipfile
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch._subclasses import FakeTensorMode
from torchrl import torchrl_logger
from torchrl.checkpoint import Checkpoint, CheckpointRotation
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.objectives.common import LossModule
from torchrl.trainers.trainers import DefaultOptimizationStepper

import torchrl_ficreg
from torchrl_ficreg import _torchrl_compat as compat

ROOT = Path(torchrl_ficreg.__file__).parent
OTHERS = {"envs/cube/physics.py"}  # drives OGBench's own arm, whose parts have private names
NAMEDTUPLE = {"_replace", "_fields", "_asdict"}


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def defined(tree: ast.AST) -> set[str]:
    """Names that a file defines: functions, classes, variables, and attributes of ``self``."""
    nodes = list(ast.walk(tree))
    names = {node.name for node in nodes if isinstance(node, (ast.FunctionDef, ast.ClassDef))}
    names |= {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
    stored = [node for node in nodes if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)]
    return names | {node.attr for node in stored if getattr(node.value, "id", None) in ("self", "cls")}


def private_names(tree: ast.AST) -> list[tuple[int, str]]:
    """Private names that a file imports from, or reads of, something else than the package; with their lines."""
    found = []
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Attribute):
            names = [node.attr]
        elif isinstance(node, ast.ImportFrom) and not node.module.startswith("torchrl_ficreg"):
            names = [*node.module.split("."), *(alias.name for alias in node.names)]
        elif isinstance(node, ast.Import):
            names = [name for alias in node.names for name in alias.name.split(".")]
        elif isinstance(node, ast.Call) and getattr(node.func, "id", None) in ("getattr", "setattr", "hasattr"):
            names = [node.args[1].value] if isinstance(node.args[1], ast.Constant) else []
        found += [(node.lineno, name) for name in names if is_private(name)]
    return found


def test_no_other_file_touches_a_private_name_of_another_library():
    """Attributes that no file of the package defines, and imports; ``getattr`` with such a name too."""
    trees = {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text()) for path in ROOT.rglob("*.py")}
    compat_tree = trees.pop("_torchrl_compat.py")
    own = NAMEDTUPLE.union(*map(defined, trees.values()))
    foreign = {
        f"{path}:{line}": name
        for path, tree in trees.items()
        if path not in OTHERS
        for line, name in private_names(tree)
        if name not in own
    }
    assert not foreign
    assert len({name for _, name in private_names(compat_tree)}) > 15  # the search finds them where they are


class Square(LossModule):
    """The mean square of a weight."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(()))

    def forward(self, tensordict):
        return TensorDict({"loss": self.weight.square()})


class Batches:
    """A collector of the same batch over and over."""

    init_random_frames = 0

    def __iter__(self):
        while True:
            yield TensorDict({}, [1])

    def shutdown(self) -> None:
        pass


def make_trainer(folder: Path | None = None, steps: int = 20, **settings) -> compat.BaseTrainer:
    loss = Square()
    if folder is not None:
        settings |= {"checkpoint": Checkpoint(format="archive"), "checkpoint_rotation": CheckpointRotation(folder, keep_last=1)}
    return compat.BaseTrainer(
        collector=Batches(),
        total_frames=steps,
        frame_skip=1,
        optim_steps_per_batch=1,
        loss_module=loss,
        optimizer=torch.optim.SGD(loss.parameters(), 0.1),
        optimization_stepper=DefaultOptimizationStepper(),
        progress_bar=False,
        log_interval=0,
        **settings,
    )


def test_a_trainer_counts_its_steps_and_keeps_the_latest_numbers_only():
    trainer = make_trainer(history=5)
    trainer.train()
    assert trainer.step == compat.step_count(trainer) == 20
    assert trainer._log_dict and max(len(values) for values in trainer._log_dict.values()) == 5


def test_a_trainer_tells_why_it_was_stopped():
    trainer = make_trainer()
    assert compat.stop_reason(trainer) is None
    trainer.register_op("post_steps", lambda: trainer.step == 3 and trainer.request_stop("enough"))
    trainer.train()
    assert compat.stop_reason(trainer) == "enough" and trainer.step == 3


class Stateless:
    """A logger without a state."""

    def log_scalar(self, *args, **kwargs) -> None:
        pass


def test_a_checkpoint_is_written_where_one_is_due_and_loads_everything(tmp_path, monkeypatch):
    """A logger without a state is left out without a warning."""
    warnings = []
    monkeypatch.setattr(torchrl_logger, "warning", lambda text, *args: warnings.extend(args))
    trainer = make_trainer(tmp_path, logger=Stateless())
    trainer.train()
    assert "collector" in warnings and "logger" not in warnings
    assert "logger" not in Checkpoint.manifest(trainer.checkpoint_rotation.latest())["components"]
    again = make_trainer(tmp_path)
    again.load_checkpoint(trainer.checkpoint_rotation.latest())
    assert again.step == 20
    assert torch.equal(again.loss_module.weight, trainer.loss_module.weight)


def test_an_overridden_write_checkpoint_is_called(monkeypatch, tmp_path):
    calls = []
    monkeypatch.setattr(compat.BaseTrainer, "write_checkpoint", lambda self: calls.append(self.step))
    make_trainer(tmp_path).train()
    assert calls == [20]


@pytest.mark.parametrize("discard", [True, False])
def test_prefetched_batches_are_discarded_on_request_and_one_thread_reads(discard):
    buffer = ReplayBuffer(storage=LazyTensorStorage(4), batch_size=2, prefetch=2)
    buffer.extend(torch.arange(4))
    compat.use_one_reader(buffer)
    assert buffer._prefetch_executor._max_workers == 1
    with compat.prefetching_paused(buffer):
        buffer.sample()
    assert len(buffer._prefetch_queue) == 2
    with compat.locked(buffer, discard=discard):
        assert len(buffer._prefetch_queue) == (0 if discard else 2)
    assert compat.PREFETCHED in buffer.__getstate__()


def test_modules_tell_the_arguments_of_their_inputs():
    module = TensorDictModule(lambda x, y: (x + y, x * y), in_keys={"x": "a", "y": "b"}, out_keys=["sum", "product"])
    assert list(compat.keyword_arguments(module)) == ["x", "y"]
    assert compat.keyword_arguments(nn.Linear(1, 1)) is None


def test_a_compiled_module_gives_back_the_module():
    layer = nn.Linear(1, 1)
    assert compat.without_compile(torch.compile(layer)) is layer and compat.without_compile(layer) is layer


def test_a_copy_with_another_child_shares_the_rest():
    pair = nn.Sequential(nn.Linear(1, 1), nn.Linear(1, 1))
    other = compat.with_child(pair, "1", nn.Identity())
    assert other[0] is pair[0] and isinstance(other[1], nn.Identity) and isinstance(pair[1], nn.Linear)


def test_layers_and_tensors_are_told_apart():
    assert isinstance(nn.BatchNorm2d(3), compat.BatchNorm)
    with pytest.raises(ValueError, match="expected 2D or 3D input"):
        compat.check_batch_norm_input(nn.BatchNorm1d(3), torch.zeros(3))
    with FakeTensorMode():
        assert isinstance(torch.zeros(1), compat.FakeTensor)
    seen = []

    def look(x):
        seen.append((compat.in_functorch_transform(), compat.is_functorch_wrapped_tensor(x)))
        return x

    look(torch.zeros(2)), torch.vmap(look)(torch.zeros(2))
    assert seen == [(False, False), (True, True)]
    assert compat.tree_map(lambda x: x + 1, {"a": [1, 2]}) == {"a": [2, 3]}


def test_datasets_have_a_default_root_and_class_properties():
    class Known:
        @compat.classproperty
        def name(cls):  # noqa: N805
            return cls.__name__

    assert Known.name == "Known"
    assert Path(compat.default_root("somewhere")).name == "somewhere"


def test_names_on_disk_are_those_of_the_installed_torchrl(tmp_path):
    """The folder of a loader's unpacked archive, the patterns of half-written checkpoints, the entries of a tensor state."""
    source = "".join(path.read_text() for path in Path(inspect.getfile(Checkpoint)).parent.glob("*.py"))
    assert compat.UNPACKED.removesuffix("*") in source
    for pattern in compat.HALF_WRITTEN:
        assert pattern.split(".")[-1].removesuffix("*") in source
    make_trainer(tmp_path, 1).train()
    with zipfile.ZipFile(next(tmp_path.glob("*.torchrl"))) as archive:
        notes = [json.loads(archive.read(name)) for name in archive.namelist() if name.endswith("state/meta.json")]
    assert notes and all(compat.STATE_FOLDER.items() <= entries.items() for entries in notes)


def test_wandb_is_left_alone_where_it_is_not_loaded(monkeypatch):
    """With wandb itself: test/trainers/test_loggers.py."""
    for name in ("wandb.sdk.lib.import_hooks", "wandb.sdk.wandb_setup"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    compat.unhook_wandb()
    compat.disconnect_wandb()


def test_every_public_name_is_in_all():
    public = {name for name in defined(ast.parse(Path(compat.__file__).read_text())) if not name.startswith("_")}
    assert {name for name in compat.__all__ if not hasattr(compat, name)} == set()
    assert {name for name in vars(compat) if name in public} <= set(compat.__all__)
