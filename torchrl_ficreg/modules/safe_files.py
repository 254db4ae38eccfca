"""What both of our safe formats need: the world model's folder, and the goal policy's."""

from __future__ import annotations

from types import ModuleType


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
