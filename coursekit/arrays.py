"""The types of arrays, once for all rooms, and an array that stays as it is."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bools = NDArray[np.bool_]
Mask = Bools
Grey = NDArray[np.uint8]  # a grey image (H, W)
Image = NDArray[np.uint8]  # grey (H, W) or BGR (H, W, 3)
AnyArray = NDArray[Any]
Interval = tuple[float, float]  # low and high end, mostly of 95 %
Window = tuple[int, int, int, int]  # left, top, width, height, px


def frozen(values: AnyArray) -> AnyArray:
    """The same array, read-only from now on."""
    values.flags.writeable = False
    return values
