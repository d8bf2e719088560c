"""Block matching of a rectified pair: the disparity image a stereo camera computes.

A window of the left image is compared with 127 windows of the right one; the disparity is where
the sum of absolute differences is least, refined below a pixel, and kept only where three gates
agree. Like any matcher it makes noise, holes and false matches of what it is given.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

CANDIDATES = 127  # disparities 0..126 px; a match needs a neighbour on both sides: 1..125
HALF = 5  # windows of 11x11 px
CAP = 63  # of the high-pass image, grey levels to either side
_CROSS = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]], np.float32)


def match(
    left: ArrayLike,
    right: ArrayLike,
    uniqueness: int = 12,
    texture: float = 12.0,
    left_right: int = 1,
) -> NDArray[np.float32]:
    """The disparity in px of every pixel of the left image, 0 where there is none.

    left, right (H, W) uint8: rectified, row v of one is row v of the other. A pixel at u in the
    left image is sought at u - d in the right one, d = 0..126.
    Gates: a second minimum must cost `uniqueness` per cent more; the mean Sobel gradient along the
    row in the window must exceed `texture` grey levels; and of two left pixels that claim one
    right pixel with disparities more than `left_right` px apart the worse match is dropped.
    Sub-pixel: equiangular lines through the three least costs (Shimizu and Okutomi, 2005).
    Raises ValueError for images that are not uint8, not 2-D, not equal in size, or too small.
    """
    from coursekit.simulation import sad  # numba takes half a second to import

    left, right = _pair(left, right)
    a = np.pad(high_pass(left), HALF)
    b = np.pad(high_pass(right), ((HALF, HALF), (HALF + CANDIDATES - 1, HALF)))
    gradient = cv2.convertScaleAbs(cv2.Sobel(left, cv2.CV_16S, 1, 0, ksize=3))
    gradient = cv2.boxFilter(gradient, -1, (2 * HALF + 1, 2 * HALF + 1))
    disparity = np.zeros(left.shape, np.float32)
    sad.match_bands(a, b, gradient, uniqueness, texture, left_right, disparity)
    return disparity


def cost_curve(left: ArrayLike, right: ArrayLike, u: int, v: int) -> NDArray[np.float64]:
    """The cost (127,) of matching the window about pixel (u, v) of the left image, by disparity.

    left, right (H, W) uint8 as for `match`; the cost is the sum of absolute differences of the
    high-pass images over 11x11 px, NaN for a disparity whose window leaves the right image.
    Raises ValueError as `match` does and for a window that leaves the left image.
    """
    left, right = _pair(left, right)
    height, width = left.shape
    if not (HALF <= u < width - HALF and HALF <= v < height - HALF):
        raise ValueError(
            f"u, v: got ({u}, {v}), want a window of {2 * HALF + 1} px inside {width}x{height} px"
        )
    a, b = high_pass(left).astype(np.int64), high_pass(right).astype(np.int64)
    rows = slice(v - HALF, v + HALF + 1)
    window = a[rows, u - HALF : u + HALF + 1]
    costs = np.full(CANDIDATES, np.nan)
    for d in range(min(CANDIDATES, u - HALF + 1)):
        costs[d] = np.abs(window - b[rows, u - d - HALF : u - d + HALF + 1]).sum()
    return costs


def high_pass(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image (H, W) less its local mean, times four, 63 for none and clipped at 0 and 126.

    The difference of a 3x3 cross-shaped smoothing and a 9x9 mean, as OpenCV's StereoBM does with
    PREFILTER_NORMALIZED_RESPONSE: what is left does not know about different brightness in the two
    eyes, and a saturated dot counts no more than an ordinary one.
    """
    smooth = cv2.filter2D(image, cv2.CV_16S, _CROSS)  # 8 times the mean of the cross
    mean = cv2.boxFilter(image, cv2.CV_16S, (9, 9))
    difference = np.asarray(cv2.scaleAdd(mean, -8.0, smooth), np.int16)
    return np.clip((difference >> 1) + CAP, 0, 2 * CAP).astype(np.uint8)


def _pair(left: ArrayLike, right: ArrayLike) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    pair = []
    for name, image in (("left", left), ("right", right)):
        array = np.asarray(image)
        if array.dtype != np.uint8 or array.ndim != 2 or min(array.shape) <= 2 * HALF:
            raise ValueError(
                f"{name}: got {array.dtype} {array.shape}, want (H, W) uint8 of more than "
                f"{2 * HALF} px either way"
            )
        pair.append(np.ascontiguousarray(array))
    if pair[0].shape != pair[1].shape:
        raise ValueError(f"right: got shape {pair[1].shape}, want the left image's {pair[0].shape}")
    return pair[0], pair[1]
