"""Wrong answers to `sensitivities` of notebook 05."""

import numpy as np

from wrong_answers import changed, wrong


def one_line(u, Z, fx, cx, depth_error):
    return Z / fx, (u - cx) / fx, (u - cx) / fx * depth_error


changed(
    one_line,
    {
        "* depth_error -> * 0 + Z / fx * depth_error": "wrong_price",
        "(u - cx) / fx * depth_error -> abs((u - cx) / fx * depth_error)": "absolute",
        "depth_error\n -> depth_error * 1e3\n": "thousand",
        "Z / fx, (u - cx) / fx, -> (u - cx) / fx, Z / fx,": "exchanged",
        "Z / fx, -> 1 / fx, and (u - cx) / fx * depth_error -> abs((u - cx) / fx * depth_error)": (
            "several, first distance_forgotten"
        ),
        "return Z / fx, (u - cx) / fx, -> return": None,
        "* depth_error -> * bias": "raised",  # a name of the notebook
    },
)


def with_the_slope(u, Z, fx, cx, depth_error):
    slope = (u - cx) / fx
    return np.array([Z / fx, slope, slope * depth_error])


changed(
    with_the_slope,
    {
        "Z / fx -> 1 / fx": "distance_forgotten",
        "u - cx -> u": "centre_forgotten",
        "u - cx -> cx - u": "negative",
        "(u - cx) / fx -> (u - cx) / fx * Z": "not_differentiated",
        "(u - cx) / fx -> math.atan((u - cx) / fx)": "angle",
        "(u - cx) / fx -> math.sin(math.atan((u - cx) / fx))": "sine",
        "slope * depth_error -> slope * (Z + depth_error)": "landing_place",
        "Z / fx, slope, slope -> 1000 * Z / fx, slope, 1000 * slope": "thousand",
    },
)


@wrong("reciprocal")
def pixels_per_metre(u, Z, fx, cx, depth_error):
    X = (u - cx) * Z / fx
    du = (fx * (X + 1e-3) / Z + cx - u) / 1e-3
    return du, (u - cx) / fx, (u - cx) / fx * depth_error
