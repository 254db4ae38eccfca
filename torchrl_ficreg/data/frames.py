"""Storage of frames: raw rows, or one losslessly compressed image per frame.

Both are read through ``read(rows)``. Compression does not change a byte of a frame, so everything made from frames
(batches, checksums, the fingerprint of a dataset) is the same for every format.
"""

from __future__ import annotations

import io
import os
import weakref
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from math import prod
from typing import Any, get_args, Literal

import numpy as np

from torchrl_ficreg._utils import require

FrameFormat = Literal["raw", "webp", "png"]
FRAME_FORMATS = get_args(FrameFormat)

# Chosen for speed: WebP's default effort takes three to five times as long for files that are 0 to 16 % smaller; its
# lowest effort is three times as fast but makes the flat pictures of PushT seven times as large.
_SAVE_OPTIONS: dict[str, dict[str, Any]] = {
    "webp": {"format": "WEBP", "lossless": True, "quality": 20, "method": 1},
    "png": {"format": "PNG", "compress_level": 6},
}

# Measured bytes per pixel of a side at 64 to 224 px, for (TwoRoom, PushT, Reacher, Cube): webp 7-10, 9, 29-44, 39-53;
# png 11-16, 14-20, 33-54, 48-65.
_BYTES_PER_SIDE = {"webp": 60, "png": 80}

_BYTES_PER_THREAD = 4 << 20  # below this a thread costs more than it copies

MOST_THREADS = 8  # more readers than this only take cores from the training step


def check_frame_format(frames: str) -> None:
    """Checks that frames can be stored in a format.

    Args:
        frames (str): ``"raw"``, ``"webp"`` or ``"png"``.

    Raises:
        ImportError: the format needs Pillow, or a Pillow with WebP, which is not installed.
        ValueError: an unknown format.

    Examples:
        >>> check_frame_format("raw")
    """
    if frames not in FRAME_FORMATS:
        raise ValueError(f"frames must be one of {FRAME_FORMATS}, got {frames!r}.")
    if frames == "raw":
        return
    modules = (
        "PIL.PngImagePlugin",
        "PIL.WebPImagePlugin",
        "PIL.features",
    )  # importing the first two registers the formats
    purpose = f"frames={frames!r}, unlike frames='raw',"
    features = [require(module, "data", purpose=purpose, package="Pillow") for module in modules][-1]
    if frames == "webp" and not features.check("webp"):
        hint = "install Pillow from its wheels, or use frames='png'"
        raise ImportError(f"frames='webp' needs a Pillow with WebP, this one was built without: {hint}.")


def frame_bytes(height: int, width: int, frames: FrameFormat) -> int:
    """Disk space of one frame and its index entry, in bytes: exact for raw frames, otherwise above the average.

    The size of a compressed image is mainly that of its edges, whose length grows with its side, not with its area. The
    factors are slightly above the largest of the four environments, Cube.

    Args:
        height (int): pixels.
        width (int): pixels.
        frames (str): the format.
    """
    raw = 3 * height * width
    return raw if frames == "raw" else min(raw, round(_BYTES_PER_SIDE[frames] * (height * width) ** 0.5)) + 8


def encode_frames(pixels: np.ndarray, frames: FrameFormat, *, num_threads: int | None = None) -> list[bytes]:
    """Compresses frames without loss.

    Args:
        pixels (ndarray): uint8 [L, 3, H, W].
        frames (str): ``"webp"`` or ``"png"``.

    Keyword Args:
        num_threads (int, optional): frames compressed at a time. Default: the usable cores, at most eight.

    Returns:
        L encoded images, which do not depend on the number of threads.

    Examples:
        >>> images = encode_frames(np.zeros((2, 3, 64, 64), np.uint8), "png")
        >>> len(images), images[0] == images[1], len(images[0]) < 200
        (2, True, True)
    """
    check_frame_format(frames)
    if frames == "raw":
        raise ValueError("raw frames are not encoded: choose 'webp' or 'png'.")
    from PIL import Image

    images: list[bytes] = [b""] * len(pixels)

    def work(start: int, stop: int) -> None:
        for row in range(start, stop):
            file = io.BytesIO()
            Image.fromarray(np.ascontiguousarray(pixels[row].transpose(1, 2, 0))).save(file, **_SAVE_OPTIONS[frames])
            images[row] = file.getvalue()

    run_split(work, len(pixels), num_threads=num_threads or default_threads())
    return images


class RawFrames:
    """Uncompressed frames in memory or in a mapped file.

    Args:
        array (ndarray): uint8 [N, 3, H, W].

    Keyword Args:
        num_threads (int, optional): threads that copy. Default: the usable cores, at most eight.

    Examples:
        >>> frames = RawFrames(np.arange(48, dtype=np.uint8).reshape(4, 3, 2, 2))
        >>> frames.read(np.array([[3, 0]])).shape
        (1, 2, 3, 2, 2)
    """

    def __init__(self, array: np.ndarray, *, num_threads: int | None = None) -> None:
        self._array = np.ascontiguousarray(array)
        self._num_threads = num_threads or default_threads()
        self._buffers = BufferPool()

    def __len__(self) -> int:
        return len(self._array)

    def read(self, rows: slice | np.ndarray) -> np.ndarray:
        """Frames uint8 [..., 3, H, W]: a view for a slice, otherwise a copy. See :meth:`EpisodeStore.frames`."""
        if isinstance(rows, slice):
            return self._array[rows]
        flat = _flat_rows(rows, len(self))  # [N]
        out = self._buffers.empty((len(flat), *self._array.shape[1:]))

        def work(start: int, stop: int) -> None:
            # Many times as fast as torch's advanced indexing, and without its thread pool, which the training step uses.
            # With mode="clip" numpy writes into `out` without a buffer; the rows have been checked.
            np.take(self._array, flat[start:stop], axis=0, out=out[start:stop], mode="clip")

        smallest = max(1, _BYTES_PER_THREAD // max(1, self._array[0].nbytes))
        run_split(work, len(flat), num_threads=self._num_threads, smallest=smallest)
        return out.reshape(*np.shape(rows), *out.shape[1:])


class ImageFrames:
    """Compressed frames, one image after another in one block of bytes.

    Args:
        blob (bytes-like): the images.
        ends (ndarray): int64 [N], one past the last byte of each.
        shape (tuple of int): (3, H, W).
        frames (str): ``"webp"`` or ``"png"``.

    Keyword Args:
        num_threads (int, optional): images decoded at a time: Pillow releases the interpreter lock. The result does not
            depend on it. Default: the usable cores, at most eight.
        where (str, optional): the dataset they belong to, for errors. Default: ``""``.

    Raises:
        ValueError: the first image has another size than ``shape``, or is damaged.

    Examples:
        >>> pixels = np.random.default_rng(0).integers(0, 256, (4, 3, 8, 8), dtype=np.uint8)
        >>> images = encode_frames(pixels, "webp")
        >>> ends = np.cumsum([len(image) for image in images])
        >>> frames = ImageFrames(b"".join(images), ends, (3, 8, 8), "webp")
        >>> bool((frames.read(np.array([3, 1])) == pixels[[3, 1]]).all())
        True
    """

    def __init__(
        self,
        blob: Any,
        ends: np.ndarray,
        shape: tuple[int, ...],
        frames: FrameFormat,
        *,
        num_threads: int | None = None,
        where: str = "",
    ) -> None:
        check_frame_format(frames)
        self._blob = memoryview(blob)
        self._ends = ends
        self._shape = shape
        self._decode = _decoder(frames, shape)
        self._num_threads = num_threads or default_threads()
        self._buffers = BufferPool()
        self._where = f"{where}: " if where else ""
        if len(ends):  # before memory for frames of this shape is allocated
            self._decode_row(0, None)

    def __len__(self) -> int:
        return len(self._ends)

    def _decode_row(self, row: int, frame: np.ndarray | None) -> None:
        from PIL import Image

        begin = self._ends[row - 1] if row else 0
        try:
            self._decode(self._blob[begin : self._ends[row]], frame)
        # Pillow raises all of these.
        except (ValueError, OSError, SyntaxError, EOFError, Image.DecompressionBombError) as error:
            raise ValueError(
                f"{self._where}the image of row {row} is damaged ({error}): restore the files or collect again."
            ) from error

    def read(self, rows: slice | np.ndarray) -> np.ndarray:
        """Decodes frames to a fresh uint8 [..., 3, H, W].

        Raises:
            ValueError: an image cannot be decoded, or has another size.
        """
        if isinstance(rows, slice):
            rows = np.arange(*rows.indices(len(self)))
        flat = _flat_rows(rows, len(self))  # [N]
        out = self._buffers.empty((len(flat), *self._shape))

        def work(start: int, stop: int) -> None:
            for row, frame in zip(flat[start:stop].tolist(), out[start:stop]):
                self._decode_row(row, frame)

        run_split(work, len(flat), num_threads=self._num_threads)
        return out.reshape(*np.shape(rows), *self._shape)


def _flat_rows(rows: np.ndarray, count: int) -> np.ndarray:
    """Row numbers as int64 [N], all of them checked.

    Raises:
        IndexError: a row below 0 or beyond the last.
        TypeError: rows that are not integers, such as a mask.
    """
    rows = np.asarray(rows)
    if rows.size and rows.dtype.kind not in "iu":
        raise TypeError(f"rows are picked by integers, got an index of {rows.dtype}.")
    flat = rows.astype(np.int64).reshape(-1)
    if flat.size and (flat.min() < 0 or flat.max() >= count):
        raise IndexError(f"rows run from 0 to {count - 1}, got {flat.min()} to {flat.max()}.")
    return flat


def _decoder(frames: FrameFormat, shape: tuple[int, ...]) -> Callable[[memoryview, np.ndarray | None], None]:
    """A function that decodes one image into a frame [3, H, W]; without a frame it only checks the size."""
    from PIL import Image

    _, height, width = shape
    formats = [_SAVE_OPTIONS[frames]["format"]]

    def decode(data: memoryview, frame: np.ndarray | None) -> None:
        with Image.open(io.BytesIO(data), formats=formats) as image:
            if image.mode != "RGB" or image.size != (width, height):
                got = f"{image.mode} {image.size[1]} x {image.size[0]}"
                raise ValueError(f"it is {got}, expected RGB {height} x {width}")
            if frame is None:
                return
            # Channel by channel: Pillow extracts one twice as fast as numpy transposes the picture.
            for channel, name in zip(frame, "RGB"):
                channel[...] = np.frombuffer(image.tobytes("raw", name), np.uint8).reshape(height, width)

    return decode


# ------------------------------------------------------------------ threads and memory

_pools: dict[int, ThreadPoolExecutor] = {}

# A forked child has the pools but not their threads, and would wait for them for ever.
if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=_pools.clear)


def default_threads() -> int:
    """Number of cores that this process may use, at most eight.

    Examples:
        >>> 1 <= default_threads() <= 8
        True
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, MOST_THREADS)


def run_split(work: Callable[[int, int], None], count: int, *, num_threads: int, smallest: int = 1) -> None:
    """Calls ``work(start, stop)`` for consecutive pieces of ``range(count)``, on several threads if there are enough items.

    Args:
        work (callable): handles the items ``start`` to ``stop - 1``. It must not call this function.
        count (int): number of items.

    Keyword Args:
        num_threads (int): largest number of threads. With 1, or with too few items, ``work`` runs in the calling thread.
        smallest (int, optional): fewest items of a piece. Default: ``1``.

    Raises:
        whatever ``work`` raises: of several errors, that of the first piece.

    Examples:
        >>> squares = [0] * 5
        >>> def work(start, stop):
        ...     for item in range(start, stop):
        ...         squares[item] = item**2
        >>> run_split(work, 5, num_threads=2)
        >>> squares
        [0, 1, 4, 9, 16]
    """
    pieces = min(num_threads * 4, count // smallest)  # four per thread, as images differ in the time they take
    if num_threads <= 1 or pieces <= 1:
        return work(0, count)
    if num_threads not in _pools:
        _pools[num_threads] = ThreadPoolExecutor(num_threads, thread_name_prefix="frames")
    bounds = [count * piece // pieces for piece in range(pieces + 1)]
    futures = [_pools[num_threads].submit(work, *piece) for piece in zip(bounds[:-1], bounds[1:])]
    errors = [error for error in [future.exception() for future in futures] if error is not None]
    if errors:
        raise errors[0]


class BufferPool:
    """Hands out uninitialised byte arrays; a buffer is used again once the last reference to it is gone.

    The kernel clears every page before a process can use it, which takes almost as long as filling a batch of clips
    (77 MB at 3 x 224 x 224) with frames, and the allocator returns blocks of that size to the kernel at once. So the
    last few blocks are kept. A buffer returns to the pool when the last reference (array, view or tensor) is
    garbage-collected.

    Keyword Args:
        keep (int, optional): number of free buffers that are kept; each takes the memory of one array. Default: ``2``.
        smallest (int, optional): arrays of fewer bytes are left to the allocator. Default: 1 MiB.

    Examples:
        >>> pool = BufferPool(smallest=1)
        >>> first = pool.empty((2, 3))
        >>> address, view = first.ctypes.data, first[0]
        >>> del first
        >>> pool.empty((2, 3)).ctypes.data == address  # the view still refers to it
        False
        >>> del view
        >>> pool.empty((2, 3)).ctypes.data == address
        True
    """

    def __init__(self, *, keep: int = 2, smallest: int = 1 << 20) -> None:
        self.smallest = smallest
        # A deque, whose appending and popping are atomic, instead of a lock: a buffer may return in any thread, even
        # during a garbage collection within `empty`, where waiting for a lock would be a deadlock.
        self._free: deque[np.ndarray] = deque(maxlen=keep)

    def empty(self, shape: tuple[int, ...]) -> np.ndarray:
        """An uninitialised, contiguous, writable uint8 array.

        Args:
            shape (tuple of int): its shape.
        """
        size = prod(shape)
        if size < self.smallest:
            return np.empty(shape, np.uint8)
        memory = self._take(size)
        # A view of a view refers to the owner of the memory instead of the view, unless the owner is no array: hence
        # the memoryview, through which every view keeps `loan` alive.
        loan = np.frombuffer(memoryview(memory), np.uint8)
        weakref.finalize(loan, self._free.append, memory).atexit = False
        return loan.reshape(shape)

    def _take(self, size: int) -> np.ndarray:
        while self._free:
            try:
                memory = self._free.pop()
            except IndexError:  # another thread was faster
                break
            if memory.size == size:  # other sizes belong to a batch size that is no longer used
                return memory
        return np.empty(size, np.uint8)
