"""The types of arrays, once for all rooms."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["AnyArray", "ArrayLike", "Bools", "Floats", "Image", "Integers", "Interval", "NDArray"]

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bools = NDArray[np.bool_]
Image = NDArray[np.uint8]  # grey (H, W) or BGR (H, W, 3)
AnyArray = NDArray[Any]
Interval = tuple[float, float]  # low and high end, mostly of 95 %
