"""The arrays of frit, named after what they hold; a shape stands in the comment or docstring beside the array."""

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
