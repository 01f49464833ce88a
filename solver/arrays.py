"""The arrays of frit, named after what they hold; a shape stands in the comment or docstring beside the array."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Numbers = NDArray[np.int32]  # of nodes and particles, where there are many; -1: none
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]
Bytes = NDArray[np.int8]  # flags that ranks exchange
Codes = NDArray[np.uint64]  # hashes and places on a space-filling curve
Array = NDArray[Any]
LINE = 64  # bytes of a line of the cache


def zeros(*shape: int) -> Floats:
    """Zeros that begin a line of the cache: to load a pack that lies in two of them takes three times as long."""
    size = math.prod(shape) * np.dtype(float).itemsize
    room = np.zeros(size + LINE, dtype=np.uint8)
    first = -room.ctypes.data % LINE
    return room[first : first + size].view(np.float64).reshape(shape)
