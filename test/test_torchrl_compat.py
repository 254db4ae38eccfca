"""Claims about private names of other libraries: all are in one file, and each does what the package expects.

Those of datasets, networks and planners are tested where they are used.
"""

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
from torch import nn
from torchrl.checkpoint import Checkpoint, CheckpointRotation
from torchrl.objectives.common import LossModule
from torchrl.trainers.trainers import DefaultOptimizationStepper

import torchrl_ficreg
from torchrl_ficreg import _torchrl_compat as compat

ROOT = Path(torchrl_ficreg.__file__).parent
OTHERS = {"envs/cube/physics.py"}  # drives OGBench's own arm, whose parts have private names
NAMEDTUPLE = {"_replace", "_fields", "_asdict"}


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
        found += [(node.lineno, name) for name in names if name.startswith("_") and not name.startswith("__")]
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


def test_batch_norm_layers_are_known_and_take_batches_alone():
    assert isinstance(nn.BatchNorm2d(3), compat.BatchNorm)
    with pytest.raises(ValueError, match="expected 2D or 3D input"):
        compat.check_batch_norm_input(nn.BatchNorm1d(3), torch.zeros(3))


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
