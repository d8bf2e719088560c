"""Wrong answers to `project` of notebook 01."""

import math

import cv2
import numpy as np

from wrong_answers import wrong


def vectorised(points, K, dist=None):
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    X, Y, Z = points.T
    x, y = X / Z, Y / Z
    if dist is not None:
        k1, k2, p1, p2, k3 = dist
        r2 = x**2 + y**2
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
        dy = p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
        x, y = x * radial + dx, y * radial + dy
    u, v = fx * x + cx, fy * y + cy
    return np.column_stack([u, v])


def loop_over_lists(points, K, dist=None):
    (fx, _, cx), (_, fy, cy) = K[:2].tolist()
    pixels = []
    for X, Y, Z in points.tolist():
        x, y = X / Z, Y / Z
        if dist is not None:
            k1, k2, p1, p2, k3 = dist
            r = math.hypot(x, y)
            radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
            dx = 2 * p1 * x * y + p2 * (r**2 + 2 * x**2)
            dy = p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y
            x, y = x * radial + dx, y * radial + dy
        pixels.append([fx * x + cx, fy * y + cy])
    return pixels


def homogeneous_product(points, K, dist=None):
    p = points / points[:, 2:]
    if dist is not None:
        x, y = p[:, 0], p[:, 1]
        r2 = x * x + y * y
        f = 1 + dist[0] * r2 + dist[1] * r2 * r2 + dist[4] * r2 * r2 * r2
        dx = 2 * dist[2] * x * y + dist[3] * (r2 + 2 * x * x)
        dy = 2 * dist[3] * x * y + dist[2] * (r2 + 2 * y * y)
        p[:, :2] = np.stack([x * f + dx, y * f + dy], axis=1)
    uvw = K @ p.T
    return uvw[:2].T


def by_opencv(points, K, dist=None):
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, dist)
    return pixels[:, 0]


@wrong("several, first cx_cy_swapped")
def rows_and_columns_mixed_and_rounded(points, K, dist=None):
    u = K[0, 0] * points[:, 0] / points[:, 2] + K[1, 2]
    v = K[1, 1] * points[:, 1] / points[:, 2] + K[0, 2]
    return np.column_stack([u, v]).round()
