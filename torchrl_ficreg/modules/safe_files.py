"""What both of our safe formats need: the world model's folder, and the goal policy's."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType
from typing import Any


def require_safetensors() -> ModuleType:
    """The package by which models and policies are saved, looked for before there is something to lose.

    Raises:
        ImportError: it is not installed.
    """
    try:
        import safetensors.torch
    except ImportError as error:
        raise ImportError("safetensors is missing: pip install 'torchrl_ficreg[pretrained]'.") from error
    return safetensors


def read_config(file: Path, kind: str, version: int, *, instead: str) -> dict[str, Any]:
    """The content of one of our JSON files.

    Args:
        file: to be read.
        kind, version: what its fields ``format`` and ``version`` must say.
        instead: what to do about a file of another format.

    Raises:
        ValueError: it is not JSON, or of another format or version.
    """
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{file} is not JSON ({error}): is it damaged?") from error
    if not isinstance(content, dict) or content.get("format") != kind:
        raise ValueError(f"{file} is not of the format {kind!r}: {instead}")
    if content.get("version") != version:
        raise ValueError(
            f"{file} has version {content.get('version')!r}, this release reads {version}: update torchrl_ficreg."
        )
    return content
