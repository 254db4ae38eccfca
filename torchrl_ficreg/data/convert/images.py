"""Frames from elsewhere: decoded, channels first, at the wanted size."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import torch
from torch.nn.functional import interpolate

from torchrl_ficreg.data.convert.table import require
from torchrl_ficreg.data.threads import default_threads, run_split


def decode(cells: Sequence[bytes]) -> np.ndarray:
    """Decodes pictures (JPEG, PNG, WebP, ...) on several threads: the decoder releases the interpreter.

    Args:
        cells: encoded pictures of one size.

    Returns:
        [L, H, W, 3] uint8.

    Raises:
        ImportError: Pillow is missing.
        ValueError: a picture is damaged, or they differ in size.
    """
    image = require("PIL.Image", "pillow")

    frames: list[np.ndarray] = [np.empty(0)] * len(cells)

    def work(start: int, stop: int) -> None:
        for row in range(start, stop):
            try:
                frames[row] = np.asarray(image.open(io.BytesIO(cells[row])).convert("RGB"))
            except OSError as error:
                raise ValueError(f"a frame of {len(cells[row])} bytes cannot be decoded ({error})") from error

    run_split(work, len(cells), num_threads=default_threads())
    sizes = {frame.shape for frame in frames}
    if len(sizes) > 1:
        raise ValueError(f"frames of one episode must have one size, got {sorted(sizes)}")
    return np.stack(frames)


def is_channels_last(shape: tuple[int, ...]) -> bool:
    """Whether a frame of this shape is [H, W, 3] and not [3, H, W].

    Raises:
        ValueError: it is neither.

    Examples:
        >>> is_channels_last((224, 224, 3)), is_channels_last((3, 64, 64))
        (True, False)
    """
    if len(shape) == 3 and 3 in (shape[0], shape[2]):
        return shape[2] == 3
    raise ValueError(f"a frame must be [H, W, 3] or [3, H, W], got {list(shape)}: choose another column by pixels=.")


def to_frames(images: np.ndarray) -> np.ndarray:
    """Moves the channels in front of height and width.

    Args:
        images: [L, H, W, 3] or [L, 3, H, W] uint8.

    Returns:
        [L, 3, H, W] uint8, contiguous.

    Raises:
        ValueError: another shape or another dtype.
    """
    if images.dtype != np.uint8:
        raise ValueError(f"frames must be uint8 from 0 to 255, got {images.dtype}: scale and convert them first.")
    last = is_channels_last(images.shape[1:])
    return np.ascontiguousarray(images.transpose(0, 3, 1, 2) if last else images)


def resize(frames: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Scales frames, each new pixel being the mean of the area it covers, rounded.

    Args:
        frames: [L, 3, H, W] uint8.
        size: new height and width.

    Returns:
        [L, 3, *size] uint8.

    Examples:
        >>> checker = np.tile(np.array([[0, 255], [255, 0]], np.uint8), (1, 3, 4, 4))
        >>> resize(checker, (4, 4))[0, 0, 0].tolist()
        [128, 128, 128, 128]
    """
    if frames.shape[2:] == size:
        return frames
    scaled = interpolate(torch.from_numpy(frames).float(), size=size, mode="area")
    return (scaled + 0.5).to(torch.uint8).numpy()  # truncation of value + 0.5, so that halves always go up
