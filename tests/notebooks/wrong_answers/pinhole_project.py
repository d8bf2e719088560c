"""Wrong answers to `project` of notebook 01."""

import math

import cv2
import numpy as np

from wrong_answers import wrong

# --- pinhole -------------------------------------------------------------------------------------


@wrong("no_division", "homogeneous product")
def homogeneous_never_divided(points, K, dist=None):
    x, y, z = points.T
    if dist is not None:
        k1, k2, p1, p2, k3 = dist
        r2 = x**2 + y**2
        radial = np.polyval([k3, k2, k1, 1], r2)
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y**2),
        )
    return (K @ np.array([x, y, z]))[:2].T


@wrong("no_division", "loop over an output array")
def metres_times_focal_length(points, K, dist=None):
    out = np.empty((len(points), 2))
    for i in range(len(points)):
        X, Y = points[i, :2]
        if dist is not None:
            r2 = X**2 + Y**2
            radial = 1 + dist[0] * r2 + dist[1] * r2**2 + dist[4] * r2**3
            dx = 2 * dist[2] * X * Y + dist[3] * (r2 + 2 * X**2)
            dy = dist[2] * (r2 + 2 * Y**2) + 2 * dist[3] * X * Y
            X, Y = X * radial + dx, Y * radial + dy
        out[i] = K[0, 0] * X + K[0, 2], K[1, 1] * Y + K[1, 2]
    return out


@wrong("y_up", "OpenCV")
def flipped_before_the_lens(points, K, dist=None):
    flipped = points * [1, -1, 1]
    return cv2.projectPoints(flipped, np.zeros(3), np.zeros(3), K, dist)[0].reshape(-1, 2)


@wrong("y_up", "homogeneous product")
def flipped_after_the_lens(points, K, dist=None):
    x, y = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), dist)[0].reshape(-1, 2).T
    return (K @ np.array([x, -y, np.ones_like(x)])).T[:, :2]


@wrong("fx_fy_swapped", "loop over an output array")
def focal_lengths_swapped(points, K, dist=None):
    fy, fx, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    k1, k2, p1, p2, k3 = (0, 0, 0, 0, 0) if dist is None else dist
    out = np.zeros((len(points), 2))
    for i in range(len(points)):
        x = points[i][0] / points[i][2]
        y = points[i][1] / points[i][2]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        out[i, 0] = fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx
        out[i, 1] = fy * (y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)) + cy
    return out


@wrong("cx_cy_swapped", "vectorised")
def centre_as_row_and_column(points, K, dist=None):
    focal, centre = np.diag(K)[:2], K[1::-1, 2]
    ideal = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), dist)[0][:, 0]
    return ideal * focal + centre


@wrong("principal_point_forgotten", "loop over lists")
def only_focal_lengths(points, K, dist=None):
    k1, k2, p1, p2, k3 = dist if dist is not None else [0] * 5
    pixels = []
    for X, Y, Z in points:
        x, y = X / Z, Y / Z
        r2 = x**2 + y**2
        a = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        xd = a * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = a * y + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
        pixels.append((K[0, 0] * xd, K[1, 1] * yd))
    return pixels


@wrong("principal_point_subtracted", "OpenCV")
def centre_with_the_other_sign(points, K, dist=None):
    camera = K * np.array([[1, 1, -1], [1, 1, -1], [1, 1, 1]])
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera, dist)[0][:, 0]


@wrong("half_pixel", "OpenCV")
def pixel_corner_convention(points, K, dist=None):
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, dist)
    return pixels.reshape(-1, 2) + 0.5


# --- reading the coefficients --------------------------------------------------------------------


@wrong("p1_p2_swapped", "vectorised")
def tangential_coefficients_swapped(points, K, dist=None):
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    if dist is not None:
        k1, k2, p1, p2, k3 = dist
        r2 = x**2 + y**2
        factor = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        x, y = (
            factor * x + 2 * p2 * x * y + p1 * (r2 + 2 * x**2),
            factor * y + p2 * (r2 + 2 * y**2) + 2 * p1 * x * y,
        )
    return np.column_stack((K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]))


@wrong("k3_before_p1", "vectorised")
def coefficients_in_textbook_order(points, K, dist=None):
    xy = points[:, :2] / points[:, 2:3]
    if dist is not None:
        k, p = dist[:3], dist[3:]
        r2 = (xy**2).sum(axis=1, keepdims=True)
        product = xy.prod(axis=1, keepdims=True)
        radial = 1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3
        xy = xy * radial + 2 * p * product + p[::-1] * (r2 + 2 * xy**2)
    return xy * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]


@wrong("r6_missing", "OpenCV")
def four_coefficients(points, K, dist=None):
    four = None if dist is None else dist[:4]
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, four)[0].reshape(-1, 2)


@wrong("tangential_missing", "homogeneous product")
def radial_only(points, K, dist=None):
    p = points / points[:, 2:]
    if dist is not None:
        r2 = p[:, 0] ** 2 + p[:, 1] ** 2
        p[:, :2] *= (1 + dist[0] * r2 + dist[1] * r2**2 + dist[4] * r2**3)[:, None]
    return p @ K.T[:, :2]


# --- bending -------------------------------------------------------------------------------------


def _bent(points, dist, tangential):
    """x and y of each point, with the tangential terms that a student wrote."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    if dist is None:
        return x, y
    k1, k2, p1, p2, k3 = dist
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    dx, dy = tangential(x, y, r2, p1, p2)
    return x * radial + dx, y * radial + dy


def _pixels(x, y, K):
    return np.stack([K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]], axis=-1)


@wrong("factor_2_missing", "vectorised")
def no_two_before_the_products(points, K, dist=None):
    def tangential(x, y, r2, p1, p2):
        return p1 * x * y + p2 * (r2 + 2 * x**2), p1 * (r2 + 2 * y**2) + p2 * x * y

    return _pixels(*_bent(points, dist, tangential), K)


@wrong("factor_2_missing", "vectorised")
def no_two_before_the_squares(points, K, dist=None):
    def tangential(x, y, r2, p1, p2):
        return 2 * p1 * x * y + p2 * (r2 + x**2), p1 * (r2 + y**2) + 2 * p2 * x * y

    return _pixels(*_bent(points, dist, tangential), K)


@wrong("factor_2_missing", "vectorised")
def no_two_at_all(points, K, dist=None):
    def tangential(x, y, r2, p1, p2):
        return p1 * x * y + p2 * (r2 + x**2), p1 * (r2 + y**2) + p2 * x * y

    return _pixels(*_bent(points, dist, tangential), K)


@wrong("x_overwritten", "loop over lists")
def x_updated_in_place(points, K, dist=None):
    pixels = []
    for X, Y, Z in points.tolist():
        x = X / Z
        y = Y / Z
        if dist is not None:
            k1, k2, p1, p2, k3 = dist
            r = math.hypot(x, y)
            radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
            x = x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2)
            y = y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y
        pixels.append([K[0][0] * x + K[0][2], K[1][1] * y + K[1][2]])
    return pixels


@wrong("tangential_after_radial", "two steps")
def as_librealsense_does_it(points, K, dist=None):
    x, y = (points[:, :2] / points[:, 2:]).T
    if dist is not None:
        r2 = x * x + y * y
        f = 1 + dist[0] * r2 + dist[1] * r2 * r2 + dist[4] * r2 * r2 * r2
        x *= f
        y *= f
        dx = x + 2 * dist[2] * x * y + dist[3] * (r2 + 2 * x * x)
        dy = y + 2 * dist[3] * x * y + dist[2] * (r2 + 2 * y * y)
        x, y = dx, dy
    return np.array([x * K[0, 0] + K[0, 2], y * K[1, 1] + K[1, 2]]).T


@wrong("r_for_r2", "loop over an output array")
def radius_not_squared(points, K, dist=None):
    out = np.zeros((points.shape[0], 2))
    k1, k2, p1, p2, k3 = np.zeros(5) if dist is None else dist
    for i, P in enumerate(points):
        x, y, _ = P / P[2]
        r = np.linalg.norm([x, y])
        L = 1 + k1 * r + k2 * r**2 + k3 * r**3
        out[i, 0] = K[0, 0] * (x * L + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2)) + K[0, 2]
        out[i, 1] = K[1, 1] * (y * L + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y) + K[1, 2]
    return out


@wrong(None, "homogeneous product", kind="core right")
def pinhole_only(points, K, dist=None):
    uvw = (K @ points.T).T
    return uvw[:, :2] / uvw[:, 2:]


@wrong("distortion_in_pixels", "vectorised")
def distortion_of_the_pixels(points, K, dist=None):
    u = K[0, 0] * points[:, 0] / points[:, 2] + K[0, 2]
    v = K[1, 1] * points[:, 1] / points[:, 2] + K[1, 2]
    if dist is not None:
        k1, k2, p1, p2, k3 = dist
        r2 = u**2 + v**2
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        ud = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u**2)
        vd = v * radial + p1 * (r2 + 2 * v**2) + 2 * p2 * u * v
        u, v = ud, vd
    return np.column_stack([u, v])


@wrong("distortion_in_pixels", "loop over lists")
def distortion_of_the_offsets(points, K, dist=None):
    pixels = []
    for X, Y, Z in points:
        du, dv = K[0, 0] * X / Z, K[1, 1] * Y / Z
        if dist is not None:
            k1, k2, p1, p2, k3 = dist
            r2 = du**2 + dv**2
            f = 1 + r2 * (k1 + r2 * (k2 + k3 * r2))
            du, dv = (
                du * f + 2 * p1 * du * dv + p2 * (r2 + 2 * du**2),
                dv * f + p1 * (r2 + 2 * dv**2) + 2 * p2 * du * dv,
            )
        pixels.append([K[0, 2] + du, K[1, 2] + dv])
    return np.array(pixels)


# --- what is returned ----------------------------------------------------------------------------


@wrong("output_swapped", "OpenCV")
def row_before_column(points, K, dist=None):
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, dist)
    return np.flip(pixels.squeeze(axis=1), axis=1)


@wrong("rounded", "OpenCV")
def nearest_whole_pixels(points, K, dist=None):
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, dist)
    return np.round(pixels[:, 0]).astype(int)


@wrong("rounded", "loop over lists")
def whole_pixels_for_indexing(points, K, dist=None):
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, dist)
    return [(int(u), int(v)) for u, v in pixels[:, 0]]


@wrong("transposed", "homogeneous product")
def one_column_a_point(points, K, dist=None):
    rays = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), dist)[0][:, 0]
    return (K @ cv2.convertPointsToHomogeneous(rays)[:, 0].T)[:2]


@wrong("in_place", "vectorised")
def the_callers_points_divided(points, K, dist=None):
    result = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, dist)[0][:, 0]
    points /= points[:, 2:]
    return result


# --- what no name fits ---------------------------------------------------------------------------


@wrong("y_up", "homogeneous product")
def y_up_and_no_distortion(points, K, dist=None):
    uvw = points * [1, -1, 1] @ K.T
    return uvw[:, :2] / uvw[:, 2:]


@wrong("several, first y_up", "homogeneous product")
def y_up_and_swapped_coefficients(points, K, dist=None):
    turned = None if dist is None else dist[[0, 1, 3, 2, 4]]
    return cv2.projectPoints(points * [1, -1, 1], np.zeros(3), np.zeros(3), K, turned)[0][:, 0]


@wrong(None, "vectorised")
def a_sign_in_the_radial_factor(points, K, dist=None):
    turned = None if dist is None else dist * [1, -1, 1, 1, 1]
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, turned)[0][:, 0]


@wrong(None, "vectorised")
def homogeneous_pixels_returned(points, K, dist=None):
    uvw = points @ K.T
    return uvw / uvw[:, 2:]


@wrong(None, "loop over lists")
def only_the_first_point(points, K, dist=None):
    for X, Y, Z in points:
        return K[0, 0] * X / Z + K[0, 2], K[1, 1] * Y / Z + K[1, 2]


@wrong(None, "vectorised", kind="raised")
def none_unpacked(points, K, dist=None):
    radial, tangential = [*dist[:2], dist[4]], dist[2:4]
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x**2 + y**2
    factor = 1 + sum(k * r2 ** (i + 1) for i, k in enumerate(radial))
    x2 = factor * x + 2 * tangential[0] * x * y + tangential[1] * (r2 + 2 * x**2)
    y2 = factor * y + tangential[0] * (r2 + 2 * y**2) + 2 * tangential[1] * x * y
    return np.stack([x2, y2, np.ones_like(x2)], axis=1) @ K[:2].T


@wrong(None, "homogeneous product", kind="raised")
def points_not_transposed(points, K, dist=None):
    uvw = K @ points
    return (uvw[:2] / uvw[2]).T


@wrong("divided_by_range", "vectorised")
def divided_by_distance(points, K, dist=None):
    rays = points / np.linalg.norm(points, axis=1)[:, None]
    rays[:, 2] = 1
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, dist)[0][:, 0]


@wrong("fx_for_both", "vectorised")
def one_focal_length(points, K, dist=None):
    square = K.copy()
    square[1, 1] = K[0, 0]
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), square, dist)[0][:, 0]


@wrong("centre_before_scale", "loop over lists")
def centre_inside_the_bracket(points, K, dist=None):
    out = []
    for X, Y, Z in points:
        ideal = np.array([[X / Z, Y / Z, 1.0]])
        if dist is not None:
            bent = cv2.projectPoints(ideal, np.zeros(3), np.zeros(3), np.eye(3), dist)[0].ravel()
        else:
            bent = ideal[0, :2]
        out.append([K[0, 0] * (bent[0] + K[0, 2]), K[1, 1] * (bent[1] + K[1, 2])])
    return out


@wrong("K_transposed", "homogeneous product")
def points_times_K(points, K, dist=None):
    rays = points / points[:, 2:]
    if dist is not None:
        rays[:, :2] = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), dist)[0][:, 0]
    uvw = rays @ K
    return uvw[:, :2] / uvw[:, 2:]


@wrong("bent_before_division", "vectorised")
def bends_the_metres(points, K, dist=None):
    flat = np.column_stack([points[:, :2], np.ones(len(points))])
    if dist is not None:
        flat = cv2.projectPoints(flat, np.zeros(3), np.zeros(3), np.eye(3), dist)[0][:, 0]
    xy = flat[:, :2] / points[:, 2:]
    return xy * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]


@wrong("centre_divided", "vectorised")
def one_fraction(points, K, dist=None):
    X, Y, Z = points.T
    if dist is not None:
        rays = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), dist)[0][:, 0]
        X, Y = rays[:, 0] * Z, rays[:, 1] * Z
    return np.column_stack([(K[0, 0] * X + K[0, 2]) / Z, (K[1, 1] * Y + K[1, 2]) / Z])


@wrong("centre_divided", "vectorised")
def one_fraction_and_no_lens(points, K, dist=None):
    X, Y, Z = points.T
    return np.column_stack([(K[0, 0] * X + K[0, 2]) / Z, (K[1, 1] * Y + K[1, 2]) / Z])


@wrong("upside_down", "loop over lists")
def depth_over_offset(points, K, dist=None):
    pixels = []
    for X, Y, Z in points:
        ray = np.array([[Z / X, Z / Y, 1.0]])
        pixels.append(cv2.projectPoints(ray, np.zeros(3), np.zeros(3), K, dist)[0].ravel())
    return pixels


# --- powers of the radius ------------------------------------------------------------------------


def _with_radial(points, K, dist, radial, squared=lambda r2: r2):
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    if dist is not None:
        k1, k2, p1, p2, k3 = dist
        s = squared(x**2 + y**2)
        a = radial(x**2 + y**2, k1, k2, k3)
        x, y = (
            x * a + 2 * p1 * x * y + p2 * (s + 2 * x**2),
            y * a + p1 * (s + 2 * y**2) + 2 * p2 * x * y,
        )
    return np.column_stack([x, y]) * np.diag(K)[:2] + K[:2, 2]


@wrong("one_missing", "vectorised")
def no_one(points, K, dist=None):
    return _with_radial(points, K, dist, lambda r2, a, b, c: a * r2 + b * r2**2 + c * r2**3)


@wrong("r_for_r2", "vectorised")
def root_everywhere(points, K, dist=None):
    def radial(r2, a, b, c):
        r = np.sqrt(r2)
        return 1 + a * r + b * r**2 + c * r**3

    return _with_radial(points, K, dist, radial, np.sqrt)


@wrong("r2_for_r", "vectorised")
def powers_of_the_square(points, K, dist=None):
    def radial(r, a, b, c):
        return 1 + a * r**2 + b * r**4 + c * r**6

    return _with_radial(points, K, dist, radial)


@wrong("r2_for_r", "vectorised")
def powers_of_the_square_everywhere(points, K, dist=None):
    def radial(r, a, b, c):
        return 1 + a * r**2 + b * r**4 + c * r**6

    return _with_radial(points, K, dist, radial, np.square)


@wrong("r2_for_r", "vectorised")
def only_the_higher_powers_of_the_square(points, K, dist=None):
    def radial(r2, a, b, c):
        return 1 + a * r2 + b * r2**4 + c * r2**6

    return _with_radial(points, K, dist, radial)


# --- the core alone ------------------------------------------------------------------------------


@wrong(None, "vectorised", kind="core right")
def the_rest_is_still_to_do(points, K, dist=None):
    if dist is not None:
        raise NotImplementedError
    return (points / points[:, 2:] @ K.T)[:, :2]


@wrong(None, "loop over lists", kind="core right")
def nothing_with_a_lens(points, K, dist=None):
    if dist is None:
        return [[K[0, 0] * X / Z + K[0, 2], K[1, 1] * Y / Z + K[1, 2]] for X, Y, Z in points]


@wrong("y_up", "vectorised")
def y_up_and_nothing_with_a_lens(points, K, dist=None):
    if dist is None:
        return (points / points[:, 2:] * [1, -1, 1] @ K.T)[:, :2]


@wrong("transposed", "homogeneous product")
def one_column_a_point_and_no_lens(points, K, dist=None):
    uvw = K @ points.T
    return uvw[:2] / uvw[2]


@wrong("in_place", "vectorised")
def the_callers_points_divided_and_no_lens(points, K, dist=None):
    points /= points[:, 2:]
    return points @ K[:2].T


@wrong("several, first cx_cy_swapped", "homogeneous product")
def rows_and_columns_mixed_and_rounded(points, K, dist=None):
    u = K[0, 0] * points[:, 0] / points[:, 2] + K[1, 2]
    v = K[1, 1] * points[:, 1] / points[:, 2] + K[0, 2]
    return np.column_stack([u, v]).round()
