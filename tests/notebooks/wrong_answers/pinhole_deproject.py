"""Wrong answers to `deproject` of notebook 01."""

import cv2
import numpy as np

from wrong_answers import changed, wrong


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


changed(
    vectorised,
    {
        "- K[:2, 2]) -> * 1)": "principal_point_forgotten",
        "(pixels - K[:2, 2]) -> ((pixels - K[:2, 2]) * [1, -1])": "y_up",
        "np.diag(K)[:2, None] -> K[0, 0]": "fx_for_both",
        "K[:2, 2] -> K[1::-1, 2]": "cx_cy_swapped",
        "pixels - K -> pixels + K and else 14 -> else 0": "principal_point_added",
        "else 14 -> else 0 "
        "and K[:2, 2]).T / np.diag(K)[:2, None] -> K[:2, 2] / np.diag(K)[:2]).T": (
            "brackets_missing"
        ),
        "else 14 -> else 1 and x, y, dist -> x, y, -dist and x + xd - bx, y + yd - by -> bx, by": (
            "one_step"
        ),
        "dist)\n -> dist[[0, 1, 3, 2, 4]])\n": "p1_p2_swapped",
        "dist)\n -> dist[:4])\n": "r6_missing",
        "dist)\n -> dist * [1, 1, 0, 0, 1])\n": "tangential_missing",
        "else 14 -> else 60 and x * depth, y * depth -> x / depth, y / depth": "divided_by_depth",
        "x, y = xd, yd = (pixels - K[:2, 2]) -> pixels -= K[:2, 2]\n    x, y = xd, yd = pixels": (
            "in_place"
        ),
        # rounds
        "else 14 -> else 13": "too_few_rounds",
        "else 14 -> else 10": "too_few_rounds",
        "else 14 -> else 2": "too_few_rounds",
        "else 14 -> else 0": "core right",
        "else 14 -> else 20 "
        "and x, y = x + xd - bx, y + yd - by -> x += xd - bx\n        y += yd - by": (
            "target_overwritten"
        ),
        "else 14 -> else 37 and x + xd - bx, y + yd - by -> x + x - bx, y + y - by": (
            "target_overwritten"
        ),
    },
)


def inverse_of_K(pixels, depth, K, dist=None):
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
    x, y, _ = np.linalg.inv(K) @ homogeneous.T
    rays = np.column_stack([*_straight(x, y, dist), np.ones(len(pixels))])
    return rays * depth[:, None]


_NORMALISED = "return rays -> return rays / np.linalg.norm(rays, axis=1)[:, None]"
changed(
    inverse_of_K,
    {
        "np.linalg.inv(K) -> K": "inverse_missing",
        "homogeneous.T -> (homogeneous + [0.5, 0.5, 0]).T": "half_pixel",
        _NORMALISED: "depth_along_ray",
        f"(x, y, dist) -> (x, -y, dist) and {_NORMALISED}": "several, first y_up",
        "rays * depth[:, None] -> rays * depth[:, None] * 1000": "thousand",
        "rays * depth[:, None] -> rays * depth[:, None] * 1e-3": "thousandth",
        "rays * depth[:, None] -> np.column_stack([rays[:, :2], depth])": "not_scaled",
        "rays * depth[:, None] -> rays": "one",
        "rays * depth[:, None] -> (rays * depth[:, None]).T": "transposed",
        "rays * depth[:, None] -> rays * depth": "raised",
        "homogeneous.T -> homogeneous": "raised",
        "*_straight(x, y, dist) -> x, y": "core right",
        f"*_straight(x, y, dist) -> x, y and {_NORMALISED}": "depth_along_ray",
        "*_straight(x, y, dist) -> x, y and rays * depth[:, None] -> rays.T * depth": "transposed",
    },
)


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


changed(
    loop_over_lists,
    {
        "(fx, _, cx), (_, fy, cy) -> (fy, _, cx), (_, fx, cy)": "fx_fy_swapped",
        "(u, v), z -> (v, u), z": "exchanged",
        "(u - cx) / fx, (v - -> (u - 0.5 - cx) / fx, (v - 0.5 -": "half_pixel",
        "/ fx, (v - cy) / fy -> * fx, (v - cy) * fy and else 40 -> else 0": "times_focal_length",
        "else 40 -> else 1 and x + xd - bx, y + yd - by -> bx, by": "distorted_again",
        "else 40 -> else 1 and x + xd - bx, y + yd - by -> x + (x - bx) / a, y + (y - by) / a": (
            "one_step"
        ),
        "k1, k2, p1, p2, k3 = -> k1, k2, k3, p1, p2 =": "k3_before_p1",
        "2 * p1 -> p1 and 2 * p2 -> p2": "factor_2_missing",
        "2 * p2 * x -> 2 * p2 * bx": "x_overwritten",
        "2 * p1 -> 2 * p1 * a * a and 2 * p2 -> 2 * p2 * a * a "
        "and 2 * x -> 2 * a * a * x and 2 * y -> 2 * a * a * y": "tangential_after_radial",
        "k1 * r2 + k2 * r2**2 + k3 * r2**3 -> k1 * r2**0.5 + k2 * r2 + k3 * r2**1.5": "r_for_r2",
        "k2 * r2**2 + k3 * r2**3 -> k2 * r2**4 + k3 * r2**6": "r2_for_r",
    },
)


@wrong("inverse_transposed")
def rows_times_the_inverse(pixels, depth, K, dist=None):
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K)
    return rays * depth[:, None]


@wrong("inverse_transposed")
def rows_times_the_inverse_and_normalised(pixels, depth, K, dist=None):
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K)
    return rays / rays[:, 2:] * depth[:, None]


@wrong("too_few_rounds")
def undistort_points_as_it_comes(pixels, depth, K, dist=None):
    rays = cv2.undistortPoints(pixels[:, None], K, np.zeros(5) if dist is None else dist)[:, 0]
    return depth[:, None] * cv2.convertPointsToHomogeneous(rays)[:, 0]
