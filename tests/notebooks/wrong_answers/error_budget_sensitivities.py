"""Wrong answers to `sensitivities` of notebook 05."""

import math

import numpy as np

from wrong_answers import wrong


@wrong("distance_forgotten", "by the field of view")
def price_without_distance(u, Z, fx, cx, depth_error):
    slope = (u - cx) / fx
    return 1 / fx, slope, slope * depth_error


@wrong("upside_down", "numerical derivative")
def pixels_per_metre(u, Z, fx, cx, depth_error):
    X = (u - cx) * Z / fx
    du = (fx * (X + 1e-3) / Z + cx - u) / 1e-3
    return du, (u - cx) / fx, (u - cx) / fx * depth_error


@wrong("centre_forgotten", "one line")
def from_the_corner(u, Z, fx, cx, depth_error):
    return np.array([Z / fx, u / fx, u / fx * depth_error])


@wrong("other_way", "one line")
def centre_minus_pixel(u, Z, fx, cx, depth_error):
    return Z / fx, -(u - cx) / fx, -(u - cx) / fx * depth_error


@wrong("not_differentiated", "by X")
def the_point_itself(u, Z, fx, cx, depth_error):
    X = (u - cx) / fx * Z
    return [Z / fx, X, X * depth_error]


@wrong("angle", "by the angle")
def radians_off_the_axis(u, Z, fx, cx, depth_error):
    theta = math.atan((u - cx) / fx)
    return Z / fx, theta, theta * depth_error


@wrong("sine", "by the angle")
def along_the_ray(u, Z, fx, cx, depth_error):
    theta = math.atan((u - cx) / fx)
    return Z / fx, math.sin(theta), math.sin(theta) * depth_error


@wrong("wrong_price", "one line")
def leak_by_the_pixel(u, Z, fx, cx, depth_error):
    return Z / fx, (u - cx) / fx, Z / fx * depth_error


@wrong("sign_lost", "one line")
def size_of_the_leak(u, Z, fx, cx, depth_error):
    return Z / fx, (u - cx) / fx, abs((u - cx) / fx * depth_error)


@wrong("millimetres", "one line")
def leak_in_millimetres(u, Z, fx, cx, depth_error):
    return Z / fx, (u - cx) / fx, (u - cx) / fx * depth_error * 1e3


@wrong("landing_place", "the whole depth")
def where_the_point_ends_up(u, Z, fx, cx, depth_error):
    slope = (u - cx) / fx
    return Z / fx, slope, slope * (Z + depth_error)


@wrong("all_millimetres", "all in mm")
def prices_in_millimetres(u, Z, fx, cx, depth_error):
    slope = (u - cx) / fx
    return 1000 * Z / fx, slope, 1000 * slope * depth_error


@wrong("exchanged", "one line")
def depth_first(u, Z, fx, cx, depth_error):
    return (u - cx) / fx, Z / fx, (u - cx) / fx * depth_error


@wrong("several, first distance_forgotten", "one line")
def no_distance_and_no_sign(u, Z, fx, cx, depth_error):
    return 1 / fx, (u - cx) / fx, abs((u - cx) / fx * depth_error)


@wrong(None, "only one")
def only_the_leak(u, Z, fx, cx, depth_error):
    return (u - cx) / fx * depth_error


@wrong(None, "one line", kind="raised")
def a_name_of_the_notebook(u, Z, fx, cx, depth_error):
    return Z / fx, (u - cx) / fx, (u - cx) / fx * bias  # noqa: F821
