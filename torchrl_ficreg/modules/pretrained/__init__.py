"""Weights in and out: the official LeWM checkpoints, and a safe format of our own."""

from torchrl_ficreg.modules.pretrained.folder import load_pretrained, save_pretrained
from torchrl_ficreg.modules.pretrained.lewm import load_lewm, save_lewm

__all__ = ["load_lewm", "load_pretrained", "save_lewm", "save_pretrained"]
