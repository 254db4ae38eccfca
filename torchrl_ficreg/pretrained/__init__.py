"""Weights in and out: the official LeWM checkpoints, and a safe format of our own."""

from torchrl_ficreg.pretrained.folder import load_pretrained, ModelCard, save_pretrained
from torchrl_ficreg.pretrained.lewm import load_lewm, save_lewm

__all__ = ["ModelCard", "load_lewm", "load_pretrained", "save_lewm", "save_pretrained"]
