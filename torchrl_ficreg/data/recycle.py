"""Memory for batches, used again once nobody can see the batch any more."""

from __future__ import annotations

import weakref
from collections import deque
from math import prod

import numpy as np


class Recycler:
    """Hands out uninitialised byte arrays and takes their memory back when the last user has dropped them.

    The kernel clears every page before a process sees it, which takes almost as long as filling a batch of clips (77 MB
    at 3 x 224 x 224) with frames, and the allocator gives blocks of that size back at once. So the last few blocks
    are kept. An array is the caller's for as long as he, or a view or a tensor made from it, holds on to it: only
    the destruction of the array puts its memory on the shelf.

    Keyword Args:
        keep: blocks that wait for their next use; the memory this costs is ``keep`` times one array.
        smallest: bytes below which the allocator does as well.

    Examples:
        >>> recycler = Recycler(smallest=1)
        >>> first = recycler.empty((2, 3))
        >>> address, view = first.ctypes.data, first[0]
        >>> del first
        >>> recycler.empty((2, 3)).ctypes.data == address  # the view still looks at it
        False
        >>> del view
        >>> recycler.empty((2, 3)).ctypes.data == address
        True
    """

    def __init__(self, *, keep: int = 2, smallest: int = 1 << 20) -> None:
        self.smallest = smallest
        # Appending and popping are atomic: memory comes back in whichever thread drops it, even amid a collection
        # of garbage, where waiting for a lock could be waiting for oneself.
        self._shelf: deque[np.ndarray] = deque(maxlen=keep)

    def empty(self, shape: tuple[int, ...]) -> np.ndarray:
        """An uninitialised, contiguous, writable uint8 array."""
        size = prod(shape)
        if size < self.smallest:
            return np.empty(shape, np.uint8)
        memory = self._take(size)
        # Views of a view refer to its owner, not to it, unless the owner is no array: hence the memoryview. With it
        # every view keeps `loan` alive.
        loan = np.frombuffer(memoryview(memory), np.uint8)
        weakref.finalize(loan, self._shelf.append, memory).atexit = False
        return loan.reshape(shape)

    def _take(self, size: int) -> np.ndarray:
        while self._shelf:
            try:
                memory = self._shelf.pop()
            except IndexError:  # another thread was faster
                break
            if memory.size == size:  # others belong to a batch size that is not asked for any more
                return memory
        return np.empty(size, np.uint8)
