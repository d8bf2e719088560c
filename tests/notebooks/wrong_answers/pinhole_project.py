"""Wrong answers to `project` of notebook 01."""

import math

import cv2
import numpy as np

from wrong_answers import changed, wrong


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


changed(
    vectorised,
    {
        # pinhole
        "X / Z, Y / Z -> X, Y and fx * x + cx, fy * y + cy -> fx * x + cx * Z, fy * y + cy * Z": (
            "no_division"
        ),
        "cx, cy = -> cy, cx =": "cx_cy_swapped",
        "fy * y -> fx * y": "fx_for_both",
        "X / Z, Y / Z -> X, Y and + cx, fy * y + cy -> / Z + cx, fy * y / Z + cy": (
            "bent_before_division"
        ),
        "fx * x + cx, fy * y + cy -> (fx * x * Z + cx) / Z, (fy * y * Z + cy) / Z": (
            "centre_divided"
        ),
        "fx * x + cx, fy * y + cy -> (fx * X + cx) / Z, (fy * Y + cy) / Z": "centre_divided",
        "X / Z, Y / Z -> (points[:, :2] / np.linalg.norm(points, axis=1)[:, None]).T": (
            "divided_by_range"
        ),
        # reading the coefficients
        "p1, p2, k3 = -> p2, p1, k3 =": "p1_p2_swapped",
        "p1, p2, k3 = -> k3, p1, p2 =": "k3_before_p1",
        # bending
        "2 * p1 -> p1 and 2 * p2 -> p2": "factor_2_missing",
        "2 * x** -> x** and 2 * y** -> y**": "factor_2_missing",
        "2 * p1 -> p1 and 2 * p2 -> p2 and 2 * x** -> x** and 2 * y** -> y**": "factor_2_missing",
        "X / Z, Y / Z -> fx * X / Z + cx, fy * Y / Z + cy and fx * x + cx, fy * y + cy -> x, y": (
            "distortion_in_pixels"
        ),
        "+ k2 -> - k2": "subtracted",
        # powers of the radius
        "1 + k1 -> k1": "one_missing",
        "= x**2 + y**2 -> = np.sqrt(x**2 + y**2)": "r_for_r2",
        "k1 * r2 + k2 * r2**2 + k3 * r2**3 -> k1 * r2**2 + k2 * r2**4 + k3 * r2**6": "r2_for_r",
        "= x**2 + y**2 -> = (x**2 + y**2) ** 2": "r2_for_r",
        "k2 * r2**2 + k3 * r2**3 -> k2 * r2**4 + k3 * r2**6": "r2_for_r",
        # what is returned
        "return -> points /= points[:, 2:]\n    return": "in_place",
        "[u, v] -> [u, v, np.ones_like(u)]": None,
        "if dist is not None: -> if True:": "raised",
        # the core alone
        "k1, k2, p1, p2, k3 = dist -> raise NotImplementedError": "core right",
        "k1, k2, p1, p2, k3 = dist -> return None and Y / Z -> -Y / Z": "y_up",
        "dist is not None -> False and return -> points /= points[:, 2:]\n    return": "in_place",
    },
)


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


changed(
    loop_over_lists,
    {
        "X / Z, Y / Z -> X, Y": "no_division",
        "fx * x + cx, fy * y -> fy * x + cx, fx * y": "fx_fy_swapped",
        "+ cx -> + 0 and + cy -> + 0": "principal_point_forgotten",
        "fx * x + cx, fy * y + cy -> fx * (x + cx), fy * (y + cy)": "centre_before_scale",
        "X / Z, Y / Z -> Z / X, Z / Y": "upside_down",
        "k1 * r**2 + k2 * r**4 + k3 * r**6 -> k1 * r + k2 * r**2 + k3 * r**3": "r_for_r2",
        "dy = p1 -> x = x * radial + dx\n            dy = p1 and = x * radial + dx, y -> = x, y": (
            "x_overwritten"
        ),
        "X / Z, Y / Z -> fx * X / Z, fy * Y / Z and [fx * x + cx, fy * y -> [x + cx, y": (
            "distortion_in_pixels"
        ),
        "pixels.append([fx * x + cx, fy * y + cy]) -> return [fx * x + cx, fy * y + cy]": None,
        "k1, k2, p1, p2, k3 = dist -> return": "core right",
    },
)


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


changed(
    homogeneous_product,
    {
        "K @ p.T -> K @ (p * [1, -1, 1]).T": "y_up",
        "K @ p.T -> K.T @ p.T and uvw[:2].T -> (uvw[:2] / uvw[2]).T": "K_transposed",
        "x * f + dx, y * f + dy -> x * f, y * f": "tangential_missing",
        "dx = -> x, y = x * f, y * f\n        dx = and x * f + dx, y * f + dy -> x + dx, y + dy": (
            "tangential_after_radial"
        ),
        "dist is not None -> False": "core right",
        "dist is not None -> False and p = points / -> p = points * [1, -1, 1] /": "y_up",
        "uvw[:2].T -> uvw[:2]": "transposed",
        "dist is not None -> False and uvw[:2].T -> uvw[:2]": "transposed",
        "dist is not None -> False and K @ p.T -> K[[1, 0, 2]][:, [1, 0, 2]] @ p.T": None,
        "K @ p.T -> K @ points": "raised",
    },
)


def by_opencv(points, K, dist=None):
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, dist)
    return pixels[:, 0]


changed(
    by_opencv,
    {
        "(points, np -> (points * [1, -1, 1], np": "y_up",
        "K, dist) -> K * [[1, 1, -1], [1, 1, -1], [1, 1, 1]], dist)": "principal_point_subtracted",
        "pixels[:, 0] -> pixels[:, 0] + 0.5": "half_pixel",
        "K, dist) -> K, None if dist is None else dist[:4])": "r6_missing",
        "pixels[:, 0] -> np.flip(pixels[:, 0], axis=1)": "exchanged",
        "pixels[:, 0] -> np.round(pixels[:, 0]).astype(int)": "rounded",
        "pixels[:, 0] -> [(int(u), int(v)) for u, v in pixels[:, 0]]": "truncated",
        "K, dist) -> K, None if dist is None else dist[[0, 1, 3, 2, 4]]) "
        "and (points, np -> (points * [1, -1, 1], np": "several, first y_up",
    },
)


@wrong("several, first cx_cy_swapped")
def rows_and_columns_mixed_and_rounded(points, K, dist=None):
    u = K[0, 0] * points[:, 0] / points[:, 2] + K[1, 2]
    v = K[1, 1] * points[:, 1] / points[:, 2] + K[0, 2]
    return np.column_stack([u, v]).round()
