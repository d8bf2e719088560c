"""Wrong answers to `sensitivities` of notebook 05."""

from wrong_answers import wrong


def one_line(u, Z, fx, cx, depth_error):
    return Z / fx, (u - cx) / fx, (u - cx) / fx * depth_error


@wrong("reciprocal")
def pixels_per_metre(u, Z, fx, cx, depth_error):
    X = (u - cx) * Z / fx
    du = (fx * (X + 1e-3) / Z + cx - u) / 1e-3
    return du, (u - cx) / fx, (u - cx) / fx * depth_error
