"""Notebook 02: its two exercises and the mistakes that people make in them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from coursekit import specifications
from coursekit.arrays import Floats
from coursekit.lessons.exercises import Exercise, Model, Step

Bounds = tuple[int, int, int, int]  # first row, the one after the last; the same for columns

# --- depth_noise ---


def _square(Z: Any) -> Any:
    return Z**2


def _constant(fx: float, baseline: float) -> float:
    return fx * baseline


def _divide(power: Any, constant: float) -> Any:
    return power / constant


def _times(slope: Any, sigma_d: float, Z: Any) -> Any:
    return slope * sigma_d


def _as_it_is(value: Any) -> Any:
    return value


def _build_depth_noise(steps: Mapping[str, Step]) -> Model:
    def depth_noise(Z: Any, fx: float, baseline: float, sigma_d: float) -> Any:
        slope = steps["divide"](steps["power"](Z), steps["constant"](fx, baseline))
        return steps["result"](steps["noise"](slope, sigma_d, Z))

    return depth_noise


def _describe_depth_noise(args: tuple[Any, ...]) -> str:
    Z, fx, baseline, sigma_d = args
    camera = f"fx = {fx:g} px, baseline = {baseline:g} m, sigma_d = {sigma_d:g} px"
    return f"{camera}, Z = {', '.join(f'{z:g}' for z in np.ravel(Z))} m"


DEPTH_NOISE = Exercise(
    name="depth_noise.depth_noise",
    build=_build_depth_noise,
    steps={
        "power": _square,
        "constant": _constant,
        "divide": _divide,
        "noise": _times,
        "result": _as_it_is,
    },
    cases=[
        (0.4, 447.0, 0.05, 0.08),
        (1.0, 447.0, 0.05, 0.08),
        (np.array([0.30, 0.45, 0.60]), 431.1, 0.0502, 0.08),
        (np.array([0.15, 0.20, 0.30, 0.45]), 425.0, 0.018, 0.06),
        (np.array([[0.5, 0.7, 1.1], [1.3, 1.7, 1.9]]), 390.4, 0.0951, 0.25),
    ],
    per_row=1,
    unit="m",
    tolerance=1e-8,
    describe=_describe_depth_noise,
    show=lambda row: ", ".join(f"{v:.7g}" for v in np.ravel(row)),
)


@DEPTH_NOISE.mistake("power")
def linear_in_Z(Z: Any) -> Any:
    """your noise grows in proportion to Z

    At 1 m the disparity is half of what it is at 0.5 m. Differentiate fx B / d: which power of d is
    left, and how many powers of Z is that?
    """
    return Z


@DEPTH_NOISE.mistake("power", same_as=linear_in_Z)
def derivative_of_square(Z: Any) -> Any:
    return 2 * Z


@DEPTH_NOISE.mistake("power")
def cubed(Z: Any) -> Any:
    """your noise grows as the third power of Z

    Twice as far: how many times the noise does yours give, and how many should it be?
    """
    return Z**3


@DEPTH_NOISE.mistake("constant")
def millimetres(fx: float, baseline: float) -> float:
    """millimetres and metres are mixed: the result is off by a factor 1000

    Z and the baseline come in metres and the result leaves in metres. Which of your lines needs a
    1000?
    """
    return fx * baseline * 1000


@DEPTH_NOISE.mistake("constant", same_as=millimetres)
def baseline_through_thousand(fx: float, baseline: float) -> float:
    return fx * baseline / 1000


@DEPTH_NOISE.mistake("constant")
def baseline_forgotten(fx: float, baseline: float) -> float:
    """the baseline is not used

    Two cameras with the same lens, one with its eyes ten times as far apart: does your function see
    any difference?
    """
    return fx


@DEPTH_NOISE.mistake("constant")
def fx_forgotten(fx: float, baseline: float) -> float:
    """fx is not used

    What is the unit of your result? The pixels of sigma_d have to cancel against something.
    """
    return baseline


@DEPTH_NOISE.mistake("constant")
def constant_forgotten(fx: float, baseline: float) -> float:
    """neither fx nor the baseline is used

    Z² sigma_d has the unit m² px. What has to stand below it to leave metres?
    """
    return 1.0


@cache
def _notebooks_baseline() -> float:
    """The simulated camera's, which the notebook calls B, m."""
    return specifications.device("D435").unit.baseline_m


@DEPTH_NOISE.mistake("constant")
def other_baseline(fx: float, baseline: float) -> float:
    """the baseline is a number of your own: B is this notebook's, the argument is called `baseline`

    A D405 has its eyes 18 mm apart. What does your function return for it?
    """
    return fx * _notebooks_baseline()


@DEPTH_NOISE.mistake("constant", same_as=other_baseline)
def baseline_of_the_data_sheet(fx: float, baseline: float) -> float:
    return fx * 0.050


@DEPTH_NOISE.mistake("divide")
def multiplied(power: Any, constant: float) -> Any:
    """you multiply by fx B where you should divide by it

    A longer baseline sees a larger disparity. Does that make depth worse, as yours says?
    """
    return power * constant


@DEPTH_NOISE.mistake("constant")
def baseline_behind_the_fraction(fx: float, baseline: float) -> float:
    """the baseline multiplies where it should divide

    Python reads a / b * c as (a / b) * c. On which side of your fraction does B end up?
    """
    return fx / baseline


@DEPTH_NOISE.mistake("constant")
def focal_length_behind_the_fraction(fx: float, baseline: float) -> float:
    """fx multiplies where it should divide

    Python reads a / b * c as (a / b) * c. On which side of your fraction does fx end up?
    """
    return baseline / fx


@DEPTH_NOISE.mistake("divide")
def upside_down(power: Any, constant: float) -> Any:
    """the slope is upside down: that is how disparity changes with depth

    You know the noise of the disparity and want that of Z. Is that dZ/dd or dd/dZ?
    """
    return constant / power


@DEPTH_NOISE.mistake("noise")
def noise_divided(slope: Any, sigma_d: float, Z: Any) -> Any:
    """you divide by sigma_d where you should multiply by it

    A matcher that is twice as noisy: does your depth get better?
    """
    return slope / sigma_d


@DEPTH_NOISE.mistake("noise")
def noise_forgotten(slope: Any, sigma_d: float, Z: Any) -> Any:
    """sigma_d is not used: this is the depth error of a whole pixel of disparity

    By how many pixels is the matcher off?
    """
    return slope


@DEPTH_NOISE.mistake("noise")
def root_of_two(slope: Any, sigma_d: float, Z: Any) -> Any:
    """there is a factor √2 too many

    sigma_d is the noise of the *difference* of two positions. Whose errors are in it already?
    """
    return math.sqrt(2) * slope * sigma_d


@DEPTH_NOISE.mistake("noise")
def difference(slope: Any, sigma_d: float, Z: Any) -> Any:
    """this is a difference of two depths; the law is the slope times sigma_d

    Double sigma_d: does your result double exactly? Differentiate fx B / d by hand.
    """
    noise = slope * sigma_d  # fx B / (d - sigma_d) - Z
    return noise / (1 - noise / Z)


@DEPTH_NOISE.mistake("noise", same_as=difference)
def backward_difference(slope: Any, sigma_d: float, Z: Any) -> Any:
    noise = slope * sigma_d  # Z - fx B / (d + sigma_d)
    return noise / (1 + noise / Z)


@DEPTH_NOISE.mistake("noise", same_as=difference)
def central_difference(slope: Any, sigma_d: float, Z: Any) -> Any:
    noise = slope * sigma_d  # half of fx B / (d - sigma_d) - fx B / (d + sigma_d)
    return noise / (1 - (noise / Z) ** 2)


@DEPTH_NOISE.mistake("noise", same_as=difference)
def central_difference_of_halves(slope: Any, sigma_d: float, Z: Any) -> Any:
    noise = slope * sigma_d  # fx B / (d - sigma_d / 2) - fx B / (d + sigma_d / 2)
    return noise / (1 - (noise / Z / 2) ** 2)


@DEPTH_NOISE.mistake("result")
def variance(sigma: Any) -> Any:
    """this is the variance, and the standard deviation is wanted

    What is the unit of your result, m or m²?
    """
    return sigma**2


@DEPTH_NOISE.mistake("result")
def root(sigma: Any) -> Any:
    """a root is taken that nobody needs

    sigma_d is a standard deviation already. What is a slope times a standard deviation?
    """
    return np.sqrt(sigma)


@DEPTH_NOISE.mistake("result")
def negative(sigma: Any) -> Any:
    """the standard deviation is negative

    The slope dZ/dd is negative. Does a spread have a sign?
    """
    return -sigma


# --- robust_depth ---


def _depth_image() -> Floats:
    """A block before a wall, 16x12 px in metres: with zeros, NaN, infinity and flying pixels."""
    rng = np.random.default_rng(2)
    image = np.where(np.arange(16) < 9, 0.45, 0.95) * rng.normal(1.0, 0.01, (12, 16))
    image[:, 9] = rng.uniform(0.5, 0.9, 12)  # flying pixels between block and wall
    image[[0, 1, 3, 6, 8, 9, 10], 8] = 0.0
    image[[4, 5, 6, 7, 7, 8], [1, 3, 2, 0, 3, 1]] = 0.0
    image[[2, 3], [6, 7]] = np.nan
    image[[8, 9, 10], [5, 4, 5]] = np.inf
    image[0:6, 12:15] = 0.0
    image[2, 13] = 0.9317
    return image.round(4)


IMAGE = _depth_image()
IMAGE.setflags(write=False)


def _column_and_row(u: float, v: float) -> Any:
    return u, v


def _no_shortcut(image: Floats, row: int, column: int) -> Any:
    return None


def _nearest(coordinate: float) -> int:
    return round(coordinate)


def _window(row: int, column: int, half: int) -> Bounds:
    return row - half, row + half + 1, column - half, column + half + 1


def _cut(image: Floats, top: int, bottom: int, left: int, right: int) -> Floats:
    return image[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]


def _without_zeros(pixels: Floats) -> Floats:
    return pixels[pixels != 0]


def _finite(pixels: Floats) -> Floats:
    return pixels[np.isfinite(pixels)]


def _enough(valid: Floats, pixels: Floats, min_valid: int) -> bool:
    return len(valid) >= min_valid


def _nan() -> float:
    return math.nan


def _build_robust_depth(steps: Mapping[str, Step]) -> Model:
    def robust_depth(depth_m: Floats, u: float, v: float, half: int = 2, min_valid: int = 5) -> Any:
        column, row = (steps["round"](c) for c in steps["read"](u, v))
        alone = steps["shortcut"](depth_m, row, column)
        if alone is not None:
            return alone
        pixels = steps["cut"](depth_m, *steps["window"](row, column, half))
        valid = steps["finite"](steps["zeros"](pixels.ravel()))
        if len(valid) == 0 or not steps["enough"](valid, pixels, min_valid):
            return steps["none"]()
        return steps["middle"](valid)

    return robust_depth


def _describe_robust_depth(args: tuple[Any, ...]) -> str:
    """The window in words: its size, where the border cuts it off, what is in it."""
    image, u, v = args[:3]
    half = args[3] if len(args) > 3 else 2
    text = f"a {2 * half + 1}x{2 * half + 1} window about (u, v) = ({u:g}, {v:g}) px"
    if len(args) > 4:
        text += f", min_valid = {args[4]}"
    top, bottom, left, right = _window(_nearest(v), _nearest(u), half)
    cut_at = {
        "top": top < 0,
        "bottom": bottom > image.shape[0],
        "left": left < 0,
        "right": right > image.shape[1],
    }
    pixels = _cut(image, top, bottom, left, right)
    if pixels.size == 0:
        return f"{text}, all of it off the image"
    if any(cut_at.values()):
        borders = " and ".join(name for name, cut in cut_at.items() if cut)
        text += f", cut off at the {borders} border"
    kinds = {
        "valid": len(_finite(_without_zeros(pixels))),
        "zero": int((pixels == 0).sum()),
        "NaN": int(np.isnan(pixels).sum()),
        "infinite": int(np.isinf(pixels).sum()),
    }
    inside = ", ".join(f"{n} {kind}" for kind, n in kinds.items() if n)
    return f"{text} ({inside})"


ROBUST_DEPTH = Exercise(
    name="depth_noise.robust_depth",
    build=_build_robust_depth,
    steps={
        "read": _column_and_row,
        "round": _nearest,
        "shortcut": _no_shortcut,
        "window": _window,
        "cut": _cut,
        "zeros": _without_zeros,
        "finite": _finite,
        "enough": _enough,
        "none": _nan,
        "middle": lambda valid: float(np.median(valid)),
    },
    cases=[
        (IMAGE, 4, 1, 1, 1),
        (IMAGE, 11, 8),
        (IMAGE, 10, 3),
        (IMAGE, 6, 3, 1),
        (IMAGE, 5, 9, 1),
        (IMAGE, 10.7, 7.6),
        (IMAGE, 3.3, 5.8),
        (IMAGE, 0, 6),
        (IMAGE, 4, 0),
        (IMAGE, -0.3, 0.4),
        (IMAGE, 15, 8),
        (IMAGE, 14.6, 11.2),
        (IMAGE, 0, 0, 1),
        (IMAGE, 13, 4, 1, 1),
        (IMAGE, 13, 2, 1, 1),
        (IMAGE, 13, 2, 1),
        (IMAGE, 2, 6, 1, 6),
        (IMAGE, 2, 6, 1, 7),
        (IMAGE, 7, 6, 4, 20),
        (IMAGE, -9, 6),
        (IMAGE, 6, -9),
    ],
    per_row=0,
    unit="m",
    tolerance=1e-6,
    describe=_describe_robust_depth,
    show=lambda depth: "NaN" if np.isnan(depth) else f"{float(depth):.5f}",
    nan_answers=True,
)


@ROBUST_DEPTH.mistake("read")
def u_v_swapped(u: float, v: float) -> Any:
    """u and v are swapped

    u counts columns and v counts rows. Which of them does a NumPy index take first?
    """
    return v, u


@ROBUST_DEPTH.mistake("round")
def truncated(coordinate: float) -> int:
    """the pixel is truncated instead of rounded

    (0, 0) is the centre of a pixel. Which pixel is 3.7 in?
    """
    return int(coordinate)


@ROBUST_DEPTH.mistake("window")
def last_missing(row: int, column: int, half: int) -> Bounds:
    """your window lacks its last row and column

    A slice stops before its end index. How many pixels lie between `v - half` and `v + half`?
    """
    return row - half, row + half, column - half, column + half


@ROBUST_DEPTH.mistake("window")
def half_ignored(row: int, column: int, half: int) -> Bounds:
    """your window does not depend on `half`

    What does your function do when somebody asks for half = 1?
    """
    return _window(row, column, 2)


@ROBUST_DEPTH.mistake("window")
def half_halved(row: int, column: int, half: int) -> Bounds:
    """your window reaches only `half // 2` pixels to each side

    `half = 2` makes a window of 5x5. How many pixels does yours have?
    """
    return _window(row, column, half // 2)


@ROBUST_DEPTH.mistake("shortcut")
def pixel_alone(image: Floats, row: int, column: int) -> Any:
    """where the pixel itself has a depth, you return that alone

    A flying pixel has a depth, too. Who would notice?
    """
    height, width = image.shape
    inside = 0 <= row < height and 0 <= column < width
    return image[row, column] if inside and 0 < image[row, column] < math.inf else None


@ROBUST_DEPTH.mistake("shortcut", same_as=pixel_alone)
def pixel_alone_unless_zero(image: Floats, row: int, column: int) -> Any:
    height, width = image.shape
    known = -height <= row < height and -width <= column < width  # -9 counts from the far end
    return image[row, column] if known and image[row, column] > 0 else None


@ROBUST_DEPTH.mistake("cut")
def negative_index(image: Floats, top: int, bottom: int, left: int, right: int) -> Floats:
    """near the left or top border an index goes negative, and Python counts that from the far end

    Try a list of ten numbers: what is `numbers[-2:3]`, and what is `numbers[-2]`?
    """
    return image[top:bottom, left:right]


@ROBUST_DEPTH.mistake("cut", same_as=negative_index)
def negative_row(image: Floats, top: int, bottom: int, left: int, right: int) -> Floats:
    return image[top:bottom, max(left, 0) : max(right, 0)]


@ROBUST_DEPTH.mistake("cut", same_as=negative_index)
def negative_column(image: Floats, top: int, bottom: int, left: int, right: int) -> Floats:
    return image[max(top, 0) : max(bottom, 0), left:right]


@ROBUST_DEPTH.mistake("cut", same_as=negative_index)
def wrapped_pixel_by_pixel(image: Floats, top: int, bottom: int, left: int, right: int) -> Floats:
    height, width = image.shape
    return image[np.ix_(range(top, min(bottom, height)), range(left, min(right, width)))]


@ROBUST_DEPTH.mistake("cut")
def negative_end(image: Floats, top: int, bottom: int, left: int, right: int) -> Floats:
    """a window left of the image or above it has a negative *end*, and that wraps round, too

    You have looked after the first index of each slice. Where is the last one when u = -9?
    """
    return image[max(top, 0) : bottom, max(left, 0) : right]


@ROBUST_DEPTH.mistake("cut")
def moved_inside(image: Floats, top: int, bottom: int, left: int, right: int) -> Floats:
    """at the border you move the window into the image instead of cutting it off

    Is the pixel that was asked for still in the middle of what is there to see around it?
    """
    row = min(max(top, 0), image.shape[0] - (bottom - top))
    column = min(max(left, 0), image.shape[1] - (right - left))
    return image[row : row + bottom - top, column : column + right - left]


@ROBUST_DEPTH.mistake("cut")
def border_repeated(image: Floats, top: int, bottom: int, left: int, right: int) -> Floats:
    """you count the pixels of the border more than once

    Does a pixel become more certain because the image ends beside it?
    """
    rows = np.clip(range(top, bottom), 0, image.shape[0] - 1)
    columns = np.clip(range(left, right), 0, image.shape[1] - 1)
    return image[np.ix_(rows, columns)]


@ROBUST_DEPTH.mistake("cut")
def border_lost(image: Floats, top: int, bottom: int, left: int, right: int) -> Floats:
    """the last row or column of the image is lost

    In an image of 16 columns the last is number 15. Does a slice that ends at 15 hold it?
    """
    height, width = image.shape
    return _cut(image, top, min(bottom, height - 1), left, min(right, width - 1))


@ROBUST_DEPTH.mistake("cut", same_as=border_lost)
def border_lost_and_negative_end(
    image: Floats, top: int, bottom: int, left: int, right: int
) -> Floats:
    height, width = image.shape
    return image[max(top, 0) : min(bottom, height - 1), max(left, 0) : min(right, width - 1)]


@ROBUST_DEPTH.mistake("cut")
def modulo(image: Floats, top: int, bottom: int, left: int, right: int) -> Floats:
    """indices are taken modulo the image's size: at one border you read the opposite one

    What is -1 % 16? Is the pixel at the right border a neighbour of the one at the left?
    """
    height, width = image.shape
    return image[np.ix_(np.arange(top, bottom) % height, np.arange(left, right) % width)]


@ROBUST_DEPTH.mistake("cut")
def height_width_swapped(image: Floats, top: int, bottom: int, left: int, right: int) -> Floats:
    """height and width of the image are swapped

    An image 16 wide and 12 high has the shape (12, 16). Which of the two limits the columns?
    """
    height, width = image.shape
    return _cut(image, top, min(bottom, width), left, min(right, height))


@ROBUST_DEPTH.mistake("cut")
def border_refused(image: Floats, top: int, bottom: int, left: int, right: int) -> Floats:
    """you give no answer as soon as the window touches the border

    Half of the window is still in the image. What does `min_valid` say about that?
    """
    height, width = image.shape
    inside = top >= 0 and left >= 0 and bottom <= height and right <= width
    return image[top:bottom, left:right] if inside else image[:0, :0]


@ROBUST_DEPTH.mistake("zeros")
def zeros_counted(pixels: Floats) -> Floats:
    """zeros are counted as depths

    What does a camera of this kind write where it has no answer?
    """
    return pixels


@ROBUST_DEPTH.mistake("finite")
def nan_counted(pixels: Floats) -> Floats:
    """NaN is counted as a depth

    What is the median of 1, 2 and NaN? And is NaN != 0?
    """
    return pixels


@ROBUST_DEPTH.mistake("finite")
def infinity_counted(pixels: Floats) -> Floats:
    """infinity is counted as a depth

    NaN does not pass `> 0`. Does infinity?
    """
    return pixels[~np.isnan(pixels)]


@ROBUST_DEPTH.mistake("enough")
def min_valid_ignored(valid: Floats, pixels: Floats, min_valid: int) -> bool:
    """`min_valid` is ignored: a window with a single valid pixel is trusted like a full one

    Near the edge of an object one pixel may be left, and it may be a flying one. Who looks?
    """
    return True


@ROBUST_DEPTH.mistake("enough")
def min_valid_fixed(valid: Floats, pixels: Floats, min_valid: int) -> bool:
    """`min_valid` is always 5 in your function

    What does it do when somebody passes min_valid = 1?
    """
    return len(valid) >= 5


@ROBUST_DEPTH.mistake("enough")
def one_too_strict(valid: Floats, pixels: Floats, min_valid: int) -> bool:
    """exactly `min_valid` valid pixels are refused

    Fewer than min_valid is too few. And min_valid itself?
    """
    return len(valid) > min_valid


@ROBUST_DEPTH.mistake("enough")
def all_pixels_counted(valid: Floats, pixels: Floats, min_valid: int) -> bool:
    """`min_valid` is compared with all pixels of the window

    How many pixels does your count find in a window in which every pixel is 0?
    """
    return pixels.size >= min_valid


@ROBUST_DEPTH.mistake("none")
def zero_returned() -> float:
    """0 is returned where there is no answer, and NaN is wanted

    Whoever averages your depths over 100 frames: will they notice a 0 among them, or a NaN?
    """
    return 0.0


@ROBUST_DEPTH.mistake("middle")
def mean(valid: Floats) -> float:
    """this is the mean, and the median is wanted

    One flying pixel 0.2 m behind the other eight: how far does it move your result?
    """
    return float(np.mean(valid))


@ROBUST_DEPTH.mistake("middle")
def one_of_the_middle_two(valid: Floats) -> float:
    """with an even number of valid pixels you take one of the middle two

    What is the median of 1, 2, 3 and 4?
    """
    return float(np.sort(valid)[len(valid) // 2])


@ROBUST_DEPTH.mistake("middle", same_as=one_of_the_middle_two)
def lower_of_the_middle_two(valid: Floats) -> float:
    return float(np.sort(valid)[(len(valid) - 1) // 2])
