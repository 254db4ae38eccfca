"""Claims about the package as a whole: one-way imports, runnable examples, no loose ends."""

from __future__ import annotations

import ast
import doctest
import importlib
import importlib.util
import pkgutil
from pathlib import Path

import pytest

import torchrl_ficreg
from torchrl_ficreg.envs._gl import how_to_install

ROOT = Path(torchrl_ficreg.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
SOURCES = [*FILES, *sorted((ROOT.parent / "sota-implementations").rglob("*.py"))]
TREES = {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text()) for path in FILES}
MODULES = [info.name for info in pkgutil.walk_packages([str(ROOT)], "torchrl_ficreg.")]
FOLDERS = ("data", "envs", "modules", "planners", "objectives", "pretrained", "trainers", "evaluation")
PACKAGES = ["torchrl_ficreg", *(f"torchrl_ficreg.{folder}" for folder in FOLDERS)]

# Who may import whom inside the package: a file or folder those of the rows above it, never of its own row or below.
ORDER = (
    {"keys", "protocols", "_mujoco", "_utils", "_safe_files", "_device", "_torchrl_compat"},
    {"distributed"},
    {"data"},
    {"envs", "modules", "transforms"},
    {"planners", "objectives", "pretrained"},
    {"trainers"},
    {"evaluation"},
)
RANK = {name: rank for rank, row in enumerate(ORDER) for name in row}
SIMULATORS = {"torchrl_ficreg.envs.cube": "ogbench", "torchrl_ficreg.envs.reacher": "dm_control"}


def imports(tree: ast.AST) -> list[str]:
    """Dotted names that a file imports, from inside functions too."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names += [f"{'.' * node.level}{node.module or ''}.{alias.name}" for alias in node.names]
    return names


def calls(tree: ast.AST) -> list[ast.Call]:
    return [node for node in ast.walk(tree) if isinstance(node, ast.Call)]


@pytest.mark.parametrize("path", TREES)
def test_imports_only_go_down(path):
    room = path.removesuffix(".py").split("/")[0]
    for name in imports(TREES[path]):
        assert not name.startswith("."), f"{path}: write the full name instead of {name}"
        if not name.startswith("torchrl_ficreg.") or room == "__init__":
            continue
        target = name.split(".")[1]
        if target in RANK:  # else a name of the package itself
            assert target == room or RANK[target] < RANK[room] or RANK[room] == 0 == RANK[target], f"{path} imports {name}"


def test_collectives_are_called_in_one_file():
    """Elsewhere, a process without a process group would need a second way through."""
    users = [path for path, tree in TREES.items() if any(name.startswith("torch.distributed") for name in imports(tree))]
    assert users == ["distributed.py"]


def test_every_room_is_on_the_plan():
    there = {path.stem for path in ROOT.iterdir() if path.suffix == ".py" or path.is_dir()} - {"__init__", "__pycache__"}
    assert there <= set(RANK) and set(FOLDERS) <= there


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_in_docstrings_run(name):
    for part, needed in SIMULATORS.items():
        if name.startswith(part) and importlib.util.find_spec(needed) is None:
            pytest.skip(f"{needed} is not installed: {how_to_install(needed)}")
    failed, _ = doctest.testmod(importlib.import_module(name))
    assert failed == 0


@pytest.mark.parametrize("path", TREES)
def test_public_classes_functions_and_methods_are_explained(path):
    def undocumented(node, prefix=""):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, (ast.ClassDef, ast.FunctionDef)) and not child.name.startswith("_"):
                setter = any(getattr(mark, "attr", None) == "setter" for mark in child.decorator_list)
                if ast.get_docstring(child) is None and not setter:
                    yield f"{prefix}{child.name}"
                if isinstance(child, ast.ClassDef):
                    yield from undocumented(child, f"{prefix}{child.name}.")

    assert ast.get_docstring(TREES[path]), f"{path} does not say what it is for"
    assert list(undocumented(TREES[path])) == []


@pytest.mark.parametrize("path", TREES)
def test_the_package_neither_prints_nor_asserts_and_annotations_are_lazy(path):
    nodes = list(ast.walk(TREES[path]))
    assert not [node.lineno for node in nodes if isinstance(node, ast.Assert)]
    assert not [call.lineno for call in calls(TREES[path]) if getattr(call.func, "id", None) == "print"]
    annotated = any(isinstance(node, (ast.FunctionDef, ast.AnnAssign)) for node in nodes)
    assert not annotated or "__future__.annotations" in imports(TREES[path])


def test_networks_borrow_weights_without_copying_them():
    """tensordict's default would turn every frozen weight into a fresh trainable one."""
    borrows = [call for tree in TREES.values() for call in calls(tree) if getattr(call.func, "attr", None) == "to_module"]
    keywords = [{word.arg: word.value for word in call.keywords}.get("preserve_module_state") for call in borrows]
    assert keywords and [getattr(keyword, "value", None) for keyword in keywords] == [False] * len(keywords)


@pytest.mark.parametrize("path", SOURCES, ids=str)
def test_text_files_are_utf_8_on_every_system(path):
    """Windows takes another encoding unless told."""
    for call in calls(ast.parse(path.read_text(encoding="utf-8"))):
        name = getattr(call.func, "attr", getattr(call.func, "id", None))
        mode = [argument.value for argument in call.args[1:2] if isinstance(argument, ast.Constant)]
        text = name in ("read_text", "write_text") or getattr(call.func, "id", None) == "open" and "b" not in str(mode)
        assert not text or "encoding" in {word.arg for word in call.keywords}, f"{path}:{call.lineno}"
