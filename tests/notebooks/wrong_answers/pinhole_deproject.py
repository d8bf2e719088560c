"""Wrong answers to `deproject` of notebook 01."""

import cv2
import numpy as np

from wrong_answers import wrong


def _bent(x, y, dist):
    """Where a lens puts the rays (x, y, 1), by OpenCV."""
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), dist)[0][:, 0].T


def _straight(x, y, dist):
    """The rays that a lens puts at x, y: a right iteration."""
    seen = np.array([x, y])
    ideal = seen.copy()
    for _ in range(0 if dist is None else 60):
        ideal += seen - _bent(*ideal, dist)
    return ideal


def vectorised(pixels, depth, K, dist=None):
    x, y = xd, yd = (pixels - K[:2, 2]).T / np.diag(K)[:2, None]
    for _ in range(0 if dist is None else 14):
        bx, by = _bent(x, y, dist)
        x, y = x + xd - bx, y + yd - by
    return np.column_stack([x * depth, y * depth, depth])


def inverse_of_K(pixels, depth, K, dist=None):
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
    x, y, _ = np.linalg.inv(K) @ homogeneous.T
    rays = np.column_stack([*_straight(x, y, dist), np.ones(len(pixels))])
    return rays * depth[:, None]


def loop_over_lists(pixels, depth, K, dist=None):
    (fx, _, cx), (_, fy, cy) = K[:2].tolist()
    points = []
    for (u, v), z in zip(pixels.tolist(), depth.tolist(), strict=True):
        x, y = xd, yd = (u - cx) / fx, (v - cy) / fy
        for _ in range(0 if dist is None else 40):
            k1, k2, p1, p2, k3 = dist
            r2 = x**2 + y**2
            a = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
            bx = a * x + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
            by = a * y + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
            x, y = x + xd - bx, y + yd - by
        points.append([x * z, y * z, z])
    return points


@wrong("inverse_transposed")
def rows_times_the_inverse(pixels, depth, K, dist=None):
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K)
    return rays * depth[:, None]


@wrong("too_few_rounds")
def undistort_points_as_it_comes(pixels, depth, K, dist=None):
    rays = cv2.undistortPoints(pixels[:, None], K, np.zeros(5) if dist is None else dist)[:, 0]
    return depth[:, None] * cv2.convertPointsToHomogeneous(rays)[:, 0]
