"""The docs are complete: documented names can be imported, public names are documented, the map names existing files."""

from __future__ import annotations

import importlib
import inspect
import re
from pathlib import Path

import pytest
from test_package import PACKAGES, ROOT

PAGES = sorted((Path(__file__).resolve().parents[1] / "docs" / "source").glob("*.rst"))
DIRECTIVE = re.compile(r"^\.\. auto(class|function|module|data|exception):: +(\S+)((?:\n   :.*)*)", re.M)


def load(name: str) -> object:
    """The object of a dotted name."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            value = importlib.import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        for part in parts[end:]:
            value = getattr(value, part)
        return value
    raise ImportError(name)


def documented() -> dict[str, object]:
    """Every documented name with its object, the members of classes and modules too."""
    found = {}
    for page in PAGES:
        for kind, name, options in DIRECTIVE.findall(page.read_text(encoding="utf-8")):
            value = found[name] = load(name)
            members = re.search(r":members:(.*)", options)
            names = [member.strip() for member in members[1].split(",") if member.strip()] if members else []
            if members and not names and kind == "module":
                own = {key for key, each in vars(value).items() if getattr(each, "__module__", None) == name}
                names = [key for key in own if key[0] != "_"]
            found |= {f"{name}.{member}": getattr(value, member) for member in names}
    return found


def test_every_documented_name_can_be_imported_and_explains_itself():
    names = documented()
    assert len(names) > 100
    assert [name for name, value in names.items() if not inspect.getdoc(value)] == []


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_documented(package):
    module, known = importlib.import_module(package), {id(value) for value in documented().values()}
    public = {name: getattr(module, name) for name in module.__all__}
    missing = [name for name, value in public.items() if callable(value) and id(value) not in known]
    assert missing == [], "add them to docs/source/reference.rst"


def test_the_map_of_the_package_names_existing_files_and_all_folders():
    text = (PAGES[0].parent / "index.rst").read_text()
    rows = re.findall(r"^   \* - ``([\w/.]+)``\n     - (.+?)(?=\n   \* -|\n\n)", text, re.M | re.S)
    folders = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert {place.rstrip("/") for place, _ in rows if place.endswith("/")} == folders
    for place, text in rows:
        assert (ROOT / place).exists(), place
        files = re.findall(r"``([\w/]+\.py|\w+/)``", text)
        assert [name for name in files if not list((ROOT / place).rglob(name.rstrip("/")))] == [], place
