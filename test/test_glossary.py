"""The glossary's words are the ones in use: no text of the repository holds a synonym that ``glossary.rst`` rules out.

Text is what people read: docstrings, comments and messages of Python files, comments of configurations, and the
documentation. Code in backquotes or quotes, names of keys and options, and doctest lines are exempt.
"""

from __future__ import annotations

import ast
import functools
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
GLOSSARY = ROOT / "docs" / "source" / "glossary.rst"
SEARCHED = ("torchrl_ficreg", "sota-implementations", "benchmarks", "tools", "sota-check", "docs/source", "README.md")
READERS = (".py", ".yaml", ".rst", ".md", ".sh")

# The same word for another thing: a path and a pattern; what it matches is not searched.
OTHER_MEANINGS = (
    ("torchrl_ficreg/envs/", r"\bfloor\b"),  # of a room or a table
    ("", r"\bsecond moments\b"),  # of a distribution
    ("", r"\bevenly spread\b|\bspread (over|across|evenly)\b"),
)
CODE = r"``[^`]+``|:[\w:]+:`[^`]+`|`[^`\n]+`|\"[\w.=*/-]+\"|'[\w.=*/-]+'"


@functools.cache
def ruled_out() -> list[str]:
    """The synonyms after each "Not:"."""
    text = re.sub(r"\s+", " ", GLOSSARY.read_text(encoding="utf-8"))
    return [word.strip() for found in re.findall(r"Not: ([^.]+)\.", text) for word in found.split(",")]


@functools.cache
def pattern() -> re.Pattern:
    """Finds the synonyms and their plurals."""
    words = "|".join(re.escape(word).replace("\\ ", r"\s+") for word in sorted(ruled_out(), key=len, reverse=True))
    return re.compile(rf"(?<![\w/.={{])(?:{words})(?:s|es)?(?![\w=/])", re.IGNORECASE)


def texts(path: str, content: str) -> Iterator[tuple[int, str]]:
    """What people read in a file: number of its first line, text."""
    if path.endswith(".py"):
        for token in tokenize.generate_tokens(io.StringIO(content).readline):
            if token.type == tokenize.COMMENT:
                yield token.start[0], token.string
        for node in ast.walk(ast.parse(content)):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
                yield node.lineno, re.sub(r"(?m)^\s*(>>>|\.\.\.) .*$", "", node.value)
    elif path.endswith((".yaml", ".sh")):
        for number, line in enumerate(content.splitlines(), 1):
            found = re.search(r"(?:^|\s)#(.*)", line)
            if found:  # without the values that an option may take: "# action (the paper) | judge (the recovered one)"
                yield number, re.sub(r"\|\s*\w+|^\s*\w+(?=\s*[(|])", "", found[1])
    else:
        yield 1, content


def synonyms(path: str, content: str) -> list[str]:
    """Where a file uses a word that is ruled out: ``path:line: word``."""
    exempt = re.compile("|".join([CODE, *(meaning for start, meaning in OTHER_MEANINGS if path.startswith(start))]))
    hits = []
    for first, text in texts(path, content):
        text = exempt.sub(lambda match: "\n" * match[0].count("\n"), text)
        hits += [(first + text.count("\n", 0, found.start()), found[0]) for found in pattern().finditer(text)]
    return [f"{path}:{line}: {' '.join(word.split())}" for line, word in sorted(set(hits))]


def files() -> list[Path]:
    found = [path for place in SEARCHED for path in ([ROOT / place] if "." in place else (ROOT / place).rglob("*"))]
    return sorted(path for path in found if path.suffix in READERS and path != GLOSSARY)


@pytest.mark.parametrize("path", files(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_no_text_uses_a_synonym(path):
    hits = synonyms(path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8"))
    assert not hits, "see docs/source/glossary.rst for the word to use:\n" + "\n".join(hits)


@pytest.mark.parametrize(
    ("path", "content", "count"),
    [
        ("a.py", '"""The judge\'s error."""\n', 1),
        ("a.py", "x = 1  # two judges\n", 1),
        ("a.py", 'raise ValueError(f"consistency={x!r} needs a judge.")\n', 1),
        ("a.yaml", "coeff: 1.0  # weight of the judge\n", 1),
        ("a.rst", "Read by the\njudge twice.\n", 1),
        ("a.md", "- a random\n  floor of 5 %\n", 1),
        ("a.py", 'judge = out["judge_r2_real"] // math.floor(judge)\n', 0),
        ("a.py", '"""Writes ``judge_trust``, consistency_target="judge", see :func:`judge_report`.\n\n>>> judge = 1\n"""\n', 0),
        ("a.yaml", "target: judge  # action (the paper) | judge (what is recovered)\n", 0),
        ("torchrl_ficreg/envs/cube/physics.py", "height = 0.02  # m, on the floor\n", 0),
        ("a.rst", "``judge_r2_real`` and second moments, evenly spread; floor_ratio.\n", 0),
        ("a.md", "consistency_target=judge\n", 0),
    ],
)
def test_a_synonym_is_found_and_code_and_other_meanings_are_exempt(path, content, count):
    assert len(synonyms(path, content)) == count


def test_the_glossary_has_an_entry_for_every_synonym():
    entries = re.split(r"\n   (?=\S)", GLOSSARY.read_text(encoding="utf-8"))
    assert 25 <= len([entry for entry in entries if "\n      " in entry])
    assert all(entry.count("Not:") <= 1 for entry in entries) and len(ruled_out()) > 30
