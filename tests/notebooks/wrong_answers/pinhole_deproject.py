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


def _seen(pixels, K):
    return (pixels[:, 0] - K[0, 2]) / K[0, 0], (pixels[:, 1] - K[1, 2]) / K[1, 1]


# --- from the pixel to the ray -------------------------------------------------------------------


@wrong("inverse_missing", "homogeneous product")
def K_for_its_inverse(pixels, depth, K, dist=None):
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
    x, y, _ = K @ homogeneous.T
    with np.errstate(all="ignore"):
        x, y = _straight(x, y, dist)
    return np.column_stack([x * depth, y * depth, depth])


@wrong("principal_point_forgotten", "vectorised")
def pixels_through_focal_length(pixels, depth, K, dist=None):
    x, y = _straight(*(pixels / np.diag(K)[:2]).T, dist)
    return np.stack([x, y, np.ones_like(x)], axis=1) * depth[:, np.newaxis]


@wrong("fx_fy_swapped", "loop over an output array")
def focal_lengths_swapped(pixels, depth, K, dist=None):
    fx, fy = K[1, 1], K[0, 0]
    out = np.zeros((len(pixels), 3))
    for i in range(len(pixels)):
        x = np.array([(pixels[i, 0] - K[0, 2]) / fx])
        y = np.array([(pixels[i, 1] - K[1, 2]) / fy])
        (x,), (y,) = _straight(x, y, dist)
        out[i] = x * depth[i], y * depth[i], depth[i]
    return out


@wrong("input_swapped", "loop over lists")
def row_before_column(pixels, depth, K, dist=None):
    points = []
    for (v, u), Z in zip(pixels, depth, strict=True):
        x, y = _seen(np.array([[u, v]]), K)
        (x,), (y,) = _straight(x, y, dist)
        points.append([x * Z, y * Z, Z])
    return points


@wrong("y_up", "vectorised")
def up_is_positive(pixels, depth, K, dist=None):
    x = (pixels[:, 0] - K[0, 2]) / K[0, 0]
    y = (K[1, 2] - pixels[:, 1]) / K[1, 1]
    x, y = _straight(x, y, dist)
    return np.column_stack([x * depth, y * depth, depth])


# --- the distortion ------------------------------------------------------------------------------


@wrong(None, "inverse of K", kind="core right")
def pinhole_only(pixels, depth, K, dist=None):
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
    return (np.linalg.inv(K) @ homogeneous.T * depth).T


@wrong("distorted_again", "loop over lists")
def distortion_applied_forwards(pixels, depth, K, dist=None):
    points = []
    for (u, v), Z in zip(pixels, depth, strict=True):
        x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
        if dist is not None:
            k1, k2, p1, p2, k3 = dist
            r2 = x * x + y * y
            radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
            xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
            yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
            x, y = xd, yd
        points.append((x * Z, y * Z, Z))
    return points


@wrong("one_step", "vectorised")
def coefficients_negated(pixels, depth, K, dist=None):
    x, y = _seen(pixels, K)
    if dist is not None:
        x, y = _bent(x, y, -dist)
    return np.column_stack([x, y, np.ones_like(x)]) * depth[:, None]


@wrong("one_step", "vectorised")
def divided_by_the_radial_factor(pixels, depth, K, dist=None):
    x, y = _seen(pixels, K)
    if dist is not None:
        k1, k2, p1, p2, k3 = dist
        r2 = x**2 + y**2
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
        dy = p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
        x, y = (x - dx) / radial, (y - dy) / radial
    return np.array([x * depth, y * depth, depth]).T


# --- from the ray to the point -------------------------------------------------------------------


@wrong("depth_along_ray", "unit rays")
def depth_is_the_length_of_the_ray(pixels, depth, K, dist=None):
    x, y = _straight(*_seen(pixels, K), dist)
    rays = np.column_stack([x, y, np.ones(len(pixels))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays * depth[:, None]


@wrong("millimetres", "vectorised")
def answer_in_millimetres(pixels, depth, K, dist=None):
    x, y = _straight(*_seen(pixels, K), dist)
    return np.column_stack([x * depth, y * depth, depth]) * 1000


@wrong("millimetres", "inverse of K")
def depth_taken_for_millimetres(pixels, depth, K, dist=None):
    z = depth * 1e-3
    straight = K @ np.vstack([_straight(*_seen(pixels, K), dist), np.ones(len(pixels))])
    return (np.linalg.inv(K) @ straight * z).T


@wrong("not_scaled", "loop over an output array")
def rays_with_the_depth_beside(pixels, depth, K, dist=None):
    out = np.empty((len(pixels), 3))
    out[:, :2] = np.transpose(_straight(*_seen(pixels, K), dist))
    for i, Z in enumerate(depth):
        out[i, 2] = Z
    return out


# --- what is returned ----------------------------------------------------------------------------


@wrong("transposed", "inverse of K")
def one_column_a_point(pixels, depth, K, dist=None):
    x, y = _straight(*_seen(pixels, K), dist)
    return np.array([x * depth, y * depth, depth])


@wrong("in_place", "vectorised")
def the_callers_pixels_shifted(pixels, depth, K, dist=None):
    pixels -= K[:2, 2]
    pixels /= np.diag(K)[:2]
    x, y = _straight(*pixels.T, dist)
    return np.column_stack([x * depth, y * depth, depth])


@wrong("several, first y_up", "vectorised")
def y_up_and_along_the_ray(pixels, depth, K, dist=None):
    x, y = _seen(pixels, K)
    x, y = _straight(x, -y, dist)
    scale = depth / np.sqrt(x**2 + y**2 + 1)
    return np.column_stack([x * scale, y * scale, scale])


@wrong("too_few_rounds", "vectorised")
def two_rounds_are_too_few(pixels, depth, K, dist=None):
    x, y = seen = np.array(_seen(pixels, K))
    for _ in range(0 if dist is None else 2):
        x, y = np.array([x, y]) + seen - _bent(x, y, dist)
    return np.column_stack([x * depth, y * depth, depth])


@wrong(None, "vectorised", kind="raised")
def depth_times_columns(pixels, depth, K, dist=None):
    x, y = _straight(*_seen(pixels, K), dist)
    return np.column_stack([x, y, np.ones_like(x)]) * depth


@wrong(None, "vectorised", kind="raised")
def K_times_columns(pixels, depth, K, dist=None):
    rays = np.linalg.inv(K) @ np.column_stack([pixels, np.ones(len(pixels))])
    return rays * depth[:, None]


@wrong("target_overwritten", "in-place sums")
def twenty_rounds_on_one_array(pixels, depth, K, dist=None):
    xd, yd = (np.array(a) for a in _seen(pixels, K))
    x, y = xd, yd
    for _ in range(0 if dist is None else 20):
        bent_x, bent_y = _bent(x, y, dist)
        x += xd - bent_x
        y += yd - bent_y
    return np.column_stack([x * depth, y * depth, depth])


@wrong("p1_p2_swapped", "vectorised")
def tangential_coefficients_swapped(pixels, depth, K, dist=None):
    swapped = None if dist is None else dist[[0, 1, 3, 2, 4]]
    x, y = _straight(*_seen(pixels, K), swapped)
    return np.column_stack([x * depth, y * depth, depth])


@wrong("k3_before_p1", "loop over lists")
def radial_coefficients_first(pixels, depth, K, dist=None):
    out = []
    for pixel, z in zip(pixels, depth, strict=True):
        if dist is not None:
            k1, k2, k3, p1, p2 = dist
            x, y = _straight(*_seen(pixel[None], K), np.array([k1, k2, p1, p2, k3]))
        else:
            x, y = _seen(pixel[None], K)
        out.append([x[0] * z, y[0] * z, z])
    return out


@wrong("depth_forgotten", "vectorised")
def rays_only(pixels, depth, K, dist=None):
    x, y = _straight(*_seen(pixels, K), dist)
    return np.column_stack([x, y, np.ones_like(x)])


# --- as in the first exercise --------------------------------------------------------------------


@wrong("fx_for_both", "vectorised")
def one_focal_length(pixels, depth, K, dist=None):
    x, y = _straight(*((pixels - K[:2, 2]) / K[0, 0]).T, dist)
    return np.column_stack([x * depth, y * depth, depth])


@wrong("cx_cy_swapped", "vectorised")
def centre_as_row_and_column(pixels, depth, K, dist=None):
    v0, u0 = K[0, 2], K[1, 2]
    x, y = _straight((pixels[:, 0] - u0) / K[0, 0], (pixels[:, 1] - v0) / K[1, 1], dist)
    return np.column_stack([x * depth, y * depth, depth])


@wrong("half_pixel", "inverse of K")
def pixel_corner_convention(pixels, depth, K, dist=None):
    rays = np.linalg.inv(K) @ np.vstack([pixels.T + 0.5, np.ones(len(pixels))])
    x, y = _straight(*rays[:2], dist)
    return np.column_stack([x * depth, y * depth, depth])


@wrong("half_pixel", "loop over lists")
def half_a_pixel_the_other_way(pixels, depth, K, dist=None):
    (fx, _, cx), (_, fy, cy) = K[:2]
    return [
        (z * (u - 0.5 - cx) / fx, z * (v - 0.5 - cy) / fy, z)
        for (u, v), z in zip(pixels, depth, strict=True)
    ]


@wrong("K_transposed", "inverse of K")
def rows_times_the_inverse(pixels, depth, K, dist=None):
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K)
    return rays * depth[:, None]


@wrong("K_transposed", "inverse of K")
def rows_times_the_inverse_and_normalised(pixels, depth, K, dist=None):
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K)
    return rays / rays[:, 2:] * depth[:, None]


@wrong("principal_point_added", "vectorised")
def centre_with_the_other_sign(pixels, depth, K, dist=None):
    x, y = (pixels + K[:2, 2]).T / np.diag(K)[:2, None]
    return np.column_stack([x * depth, y * depth, depth])


@wrong("brackets_missing", "vectorised")
def no_brackets(pixels, depth, K, dist=None):
    x = pixels[:, 0] - K[0, 2] / K[0, 0]
    y = pixels[:, 1] - K[1, 2] / K[1, 1]
    return np.column_stack([x * depth, y * depth, depth])


@wrong("times_focal_length", "loop over lists")
def focal_length_as_a_factor(pixels, depth, K, dist=None):
    (fx, _, cx), (_, fy, cy) = K[:2]
    return [
        [(u - cx) * fx * z, (v - cy) * fy * z, z] for (u, v), z in zip(pixels, depth, strict=True)
    ]


@wrong("divided_by_depth", "vectorised")
def through_the_depth(pixels, depth, K, dist=None):
    x, y = _straight(*_seen(pixels, K), dist)
    return np.transpose([x / depth, y / depth, depth])


@wrong("r6_missing", "OpenCV")
def four_coefficients(pixels, depth, K, dist=None):
    x, y = _straight(*_seen(pixels, K), None if dist is None else dist[:4])
    return np.column_stack([x * depth, y * depth, depth])


@wrong("tangential_missing", "OpenCV")
def radial_only(pixels, depth, K, dist=None):
    radial = None if dist is None else dist * [1, 1, 0, 0, 1]
    x, y = _straight(*_seen(pixels, K), radial)
    return np.column_stack([x * depth, y * depth, depth])


def _inverted(pixels, depth, K, dist, wrongly_bent):
    """Forty rounds with a `bend(x, y, r2, k1, k2, p1, p2, k3)` that has a mistake in it."""
    x, y = xd, yd = _seen(pixels, K)
    for _ in range(0 if dist is None else 40):
        bx, by = wrongly_bent(x, y, x**2 + y**2, *dist)
        x, y = x + (xd - bx), y + (yd - by)
    return np.column_stack([x, y, np.ones_like(x)]) * depth[:, None]


@wrong("factor_2_missing", "vectorised")
def no_two_before_the_products(pixels, depth, K, dist=None):
    def bent(x, y, r2, k1, k2, p1, p2, k3):
        a = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        return (
            a * x + p1 * x * y + p2 * (r2 + 2 * x**2),
            a * y + p1 * (r2 + 2 * y**2) + p2 * x * y,
        )

    return _inverted(pixels, depth, K, dist, bent)


@wrong("x_overwritten", "vectorised")
def y_from_the_new_x(pixels, depth, K, dist=None):
    def bent(x, y, r2, k1, k2, p1, p2, k3):
        a = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        x = a * x + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
        y = a * y + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
        return x, y

    return _inverted(pixels, depth, K, dist, bent)


@wrong("tangential_after_radial", "vectorised")
def two_steps(pixels, depth, K, dist=None):
    def bent(x, y, r2, k1, k2, p1, p2, k3):
        a = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        x, y = a * x, a * y
        return (
            x + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            y + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        )

    return _inverted(pixels, depth, K, dist, bent)


@wrong("r_for_r2", "vectorised")
def radius_not_squared(pixels, depth, K, dist=None):
    def bent(x, y, r2, k1, k2, p1, p2, k3):
        r = np.hypot(x, y)
        a = 1 + k1 * r + k2 * r**2 + k3 * r**3
        return (
            a * x + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            a * y + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        )

    return _inverted(pixels, depth, K, dist, bent)


@wrong("r2_for_r", "vectorised")
def powers_of_the_square(pixels, depth, K, dist=None):
    def bent(x, y, r2, k1, k2, p1, p2, k3):
        r4, r6 = r2**4, r2**6
        a = 1 + k1 * r2 + k2 * r4 + k3 * r6
        return (
            a * x + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            a * y + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        )

    return _inverted(pixels, depth, K, dist, bent)


# --- rounds --------------------------------------------------------------------------------------


@wrong("too_few_rounds", "OpenCV")
def undistort_points_as_it_comes(pixels, depth, K, dist=None):
    rays = cv2.undistortPoints(pixels[:, None], K, np.zeros(5) if dist is None else dist)[:, 0]
    return depth[:, None] * cv2.convertPointsToHomogeneous(rays)[:, 0]


def _rounds(pixels, depth, K, dist, count):
    ideal = seen = np.array(_seen(pixels, K))
    for _ in range(0 if dist is None else count):
        ideal = ideal + seen - _bent(*ideal, dist)
    return np.column_stack([*(ideal * depth), depth])


@wrong("too_few_rounds", "vectorised")
def ten_rounds_are_too_few(pixels, depth, K, dist=None):
    return _rounds(pixels, depth, K, dist, 10)


@wrong("too_few_rounds", "vectorised")
def thirteen_rounds_are_too_few(pixels, depth, K, dist=None):
    return _rounds(pixels, depth, K, dist, 13)


@wrong(None, "vectorised", kind="right")
def fourteen_rounds_are_enough(pixels, depth, K, dist=None):
    return _rounds(pixels, depth, K, dist, 14)


@wrong("target_overwritten", "vectorised")
def compared_with_the_guess(pixels, depth, K, dist=None):
    x, y = _seen(pixels, K)
    for _ in range(0 if dist is None else 37):
        bent_x, bent_y = _bent(x, y, dist)
        x, y = x + x - bent_x, y + y - bent_y
    return np.column_stack([x * depth, y * depth, depth])


@wrong(None, "vectorised", kind="core right")
def no_round_at_all(pixels, depth, K, dist=None):
    return _rounds(pixels, depth, K, dist, 0)


@wrong("depth_along_ray", "unit rays")
def along_the_ray_and_no_lens(pixels, depth, K, dist=None):
    x, y = _seen(pixels, K)
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    return rays / np.linalg.norm(rays, axis=1)[:, None] * depth[:, None]


@wrong("transposed", "inverse of K")
def one_column_a_point_and_no_lens(pixels, depth, K, dist=None):
    return np.linalg.inv(K) @ np.vstack([pixels.T, np.ones(len(pixels))]) * depth
