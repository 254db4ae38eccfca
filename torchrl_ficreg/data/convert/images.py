"""Frames of other formats: decoded, channels first, scaled."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import torch
from torch.nn.functional import interpolate

from torchrl_ficreg._utils import require
from torchrl_ficreg.data.convert.table import brief
from torchrl_ficreg.data.frames import default_threads, run_split

# No others: Pillow also has formats that start other programs, such as EPS.
_PICTURES = ("JPEG", "PNG", "WEBP")

MOST_PIXELS = 4096 * 4096  # of one frame; a small file can declare a picture that fills the memory


def decode(cells: Sequence[bytes], shape: tuple[int, ...] | None = None, *, first_row: int = 0) -> np.ndarray:
    """Decodes pictures (JPEG, PNG, WebP) on several threads: the decoder releases the interpreter.

    Args:
        cells (sequence of bytes): encoded pictures of one size.
        shape (tuple of int, optional): [H, W, 3], the size they must have, compared before a picture is decoded.
            Default: that of the first.

    Keyword Args:
        first_row (int, optional): row of the first picture, for messages. Default: ``0``.

    Returns:
        [L, H, W, 3] uint8.

    Raises:
        ImportError: Pillow is missing.
        ValueError: a picture is damaged, of another format or too large, or they differ in size.
    """
    image = require("PIL.Image", "data", purpose="a column of images", package="Pillow")

    def size_of(row: int) -> tuple[int, int, int]:
        with image.open(io.BytesIO(cells[row]), formats=_PICTURES) as picture:
            if picture.mode.startswith(("I", "F")):  # Pillow would clip them at 255
                raise ValueError(f"it has more than 8 bits a channel (mode {picture.mode}): scale it to 0..255 first")
            return (picture.height, picture.width, 3)

    def work(start: int, stop: int) -> None:
        for row in range(start, stop):
            try:
                if size_of(row) != shape:
                    raise ValueError(f"it is {size_of(row)}, the others are {shape}: frames must have one size")
                with image.open(io.BytesIO(cells[row]), formats=_PICTURES) as picture:
                    frames[row] = np.asarray(picture.convert("RGB"))
            except Exception as error:  # Pillow raises what its decoders do: SyntaxError, struct.error, ...
                raise ValueError(f"the picture of row {first_row + row} cannot be decoded ({brief(error)})") from error

    if shape is None:
        try:
            shape = size_of(0)
        except Exception as error:
            raise ValueError(f"the picture of row {first_row} cannot be decoded ({brief(error)})") from error
    if shape[0] * shape[1] > MOST_PIXELS:
        raise ValueError(f"the picture of row {first_row} declares {shape[0]} x {shape[1]} pixels: scale it down first")
    frames = np.empty((len(cells), *shape), np.uint8)
    run_split(work, len(cells), num_threads=default_threads())
    return frames


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
    raise ValueError(
        f"a frame must be [H, W, 3] or [3, H, W], got {list(shape)}: choose another column by pixels=, or convert the "
        "frames to RGB and use from_arrays()."
    )


def to_frames(images: np.ndarray) -> np.ndarray:
    """Moves the channels in front of height and width.

    Args:
        images (ndarray): [L, H, W, 3] or [L, 3, H, W] uint8.

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
    """Scales frames: each new pixel is the rounded mean of the area it covers.

    Args:
        frames (ndarray): [L, 3, H, W] uint8.
        size (tuple of int): new height and width.

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
