"""Notebook 02: its checkpoints, its two exercises and the mistakes that people make in them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from coursekit import specifications
from coursekit.lessons.checkpoints import Choice, Classic, Number, Option
from coursekit.lessons.exercises import Exercise, Model, Step
from coursekit.lessons.objectives import Objective

Array = np.ndarray
Window = tuple[int, int, int, int]  # first row, the one after the last; the same for columns

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

_LINEAR = (
    "your noise grows in proportion to Z",
    "At 1 m the disparity is half of what it is at 0.5 m. Differentiate fx B / d: which power of "
    "d is left, and how many powers of Z is that?",
)


@DEPTH_NOISE.mistake("power", *_LINEAR, name="linear_in_Z")
def first_power(Z: Any) -> Any:
    return Z


@DEPTH_NOISE.mistake("power", *_LINEAR, name="linear_in_Z")
def derivative_of_square(Z: Any) -> Any:
    return 2 * Z


@DEPTH_NOISE.mistake(
    "power",
    "your noise grows as the third power of Z",
    "Twice as far: how many times the noise does yours give, and how many should it be?",
)
def cubed(Z: Any) -> Any:
    return Z**3


_THOUSAND = (
    "millimetres and metres are mixed: the result is off by a factor 1000",
    "Z and the baseline come in metres and the result leaves in metres. Which of your lines "
    "needs a 1000?",
)


@DEPTH_NOISE.mistake("constant", *_THOUSAND, name="millimetres")
def baseline_times_thousand(fx: float, baseline: float) -> float:
    return fx * baseline * 1000


@DEPTH_NOISE.mistake("constant", *_THOUSAND, name="millimetres")
def baseline_through_thousand(fx: float, baseline: float) -> float:
    return fx * baseline / 1000


@DEPTH_NOISE.mistake(
    "constant",
    "the baseline is not used",
    "Two cameras with the same lens, one with its eyes ten times as far apart: does your function "
    "see any difference?",
)
def baseline_forgotten(fx: float, baseline: float) -> float:
    return fx


@DEPTH_NOISE.mistake(
    "constant",
    "fx is not used",
    "What is the unit of your result? The pixels of sigma_d have to cancel against something.",
)
def fx_forgotten(fx: float, baseline: float) -> float:
    return baseline


@DEPTH_NOISE.mistake(
    "constant",
    "neither fx nor the baseline is used",
    "Z² sigma_d has the unit m² px. What has to stand below it to leave metres?",
)
def constant_forgotten(fx: float, baseline: float) -> float:
    return 1.0


_OTHER_BASELINE = (
    "the baseline is a number of your own: B is this notebook's, the argument is called `baseline`",
    "A D405 has its eyes 18 mm apart. What does your function return for it?",
)


@cache
def _notebooks_baseline() -> float:
    """The simulated camera's, which the notebook calls B, m."""
    return specifications.device("D435").unit.baseline_m


@DEPTH_NOISE.mistake("constant", *_OTHER_BASELINE, name="other_baseline")
def baseline_of_the_notebook(fx: float, baseline: float) -> float:
    return fx * _notebooks_baseline()


@DEPTH_NOISE.mistake("constant", *_OTHER_BASELINE, name="other_baseline")
def baseline_of_the_data_sheet(fx: float, baseline: float) -> float:
    return fx * 0.050


@DEPTH_NOISE.mistake(
    "divide",
    "you multiply by fx B where you should divide by it",
    "A longer baseline sees a larger disparity. Does that make depth worse, as yours says?",
)
def multiplied(power: Any, constant: float) -> Any:
    return power * constant


@DEPTH_NOISE.mistake(
    "constant",
    "the baseline multiplies where it should divide",
    "Python reads a / b * c as (a / b) * c. On which side of your fraction does B end up?",
)
def baseline_behind_the_fraction(fx: float, baseline: float) -> float:
    return fx / baseline


@DEPTH_NOISE.mistake(
    "constant",
    "fx multiplies where it should divide",
    "Python reads a / b * c as (a / b) * c. On which side of your fraction does fx end up?",
)
def focal_length_behind_the_fraction(fx: float, baseline: float) -> float:
    return baseline / fx


@DEPTH_NOISE.mistake(
    "divide",
    "the slope is upside down: that is how disparity changes with depth",
    "You know the noise of the disparity and want that of Z. Is that dZ/dd or dd/dZ?",
)
def upside_down(power: Any, constant: float) -> Any:
    return constant / power


@DEPTH_NOISE.mistake(
    "noise",
    "you divide by sigma_d where you should multiply by it",
    "A matcher that is twice as noisy: does your depth get better?",
)
def noise_divided(slope: Any, sigma_d: float, Z: Any) -> Any:
    return slope / sigma_d


@DEPTH_NOISE.mistake(
    "noise",
    "sigma_d is not used: this is the depth error of a whole pixel of disparity",
    "By how many pixels is the matcher off?",
)
def noise_forgotten(slope: Any, sigma_d: float, Z: Any) -> Any:
    return slope


@DEPTH_NOISE.mistake(
    "noise",
    "there is a factor √2 too many",
    "sigma_d is the noise of the *difference* of two positions. Whose errors are in it already?",
)
def root_of_two(slope: Any, sigma_d: float, Z: Any) -> Any:
    return math.sqrt(2) * slope * sigma_d


_DIFFERENCE = (
    "this is a difference of two depths; the law is the slope times sigma_d",
    "Double sigma_d: does your result double exactly? Differentiate fx B / d by hand.",
)


@DEPTH_NOISE.mistake("noise", *_DIFFERENCE, name="difference")
def forward_difference(slope: Any, sigma_d: float, Z: Any) -> Any:
    noise = slope * sigma_d  # fx B / (d - sigma_d) - Z
    return noise / (1 - noise / Z)


@DEPTH_NOISE.mistake("noise", *_DIFFERENCE, name="difference")
def backward_difference(slope: Any, sigma_d: float, Z: Any) -> Any:
    noise = slope * sigma_d  # Z - fx B / (d + sigma_d)
    return noise / (1 + noise / Z)


@DEPTH_NOISE.mistake("noise", *_DIFFERENCE, name="difference")
def central_difference(slope: Any, sigma_d: float, Z: Any) -> Any:
    noise = slope * sigma_d  # half of fx B / (d - sigma_d) - fx B / (d + sigma_d)
    return noise / (1 - (noise / Z) ** 2)


@DEPTH_NOISE.mistake("noise", *_DIFFERENCE, name="difference")
def central_difference_of_halves(slope: Any, sigma_d: float, Z: Any) -> Any:
    noise = slope * sigma_d  # fx B / (d - sigma_d / 2) - fx B / (d + sigma_d / 2)
    return noise / (1 - (noise / Z / 2) ** 2)


@DEPTH_NOISE.mistake(
    "result",
    "this is the variance, and the standard deviation is wanted",
    "What is the unit of your result, m or m²?",
)
def variance(sigma: Any) -> Any:
    return sigma**2


@DEPTH_NOISE.mistake(
    "result",
    "a root is taken that nobody needs",
    "sigma_d is a standard deviation already. What is a slope times a standard deviation?",
)
def root(sigma: Any) -> Any:
    return np.sqrt(sigma)


@DEPTH_NOISE.mistake(
    "result",
    "the standard deviation is negative",
    "The slope dZ/dd is negative. Does a spread have a sign?",
)
def negative(sigma: Any) -> Any:
    return -sigma


# --- robust_depth ---


def _depth_image() -> Array:
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


def _no_shortcut(image: Array, row: int, column: int) -> Any:
    return None


def _nearest(coordinate: float) -> int:
    return round(coordinate)


def _window(row: int, column: int, half: int) -> Window:
    return row - half, row + half + 1, column - half, column + half + 1


def _cut(image: Array, top: int, bottom: int, left: int, right: int) -> Array:
    return image[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]


def _without_zeros(pixels: Array) -> Array:
    return pixels[pixels != 0]


def _finite(pixels: Array) -> Array:
    return pixels[np.isfinite(pixels)]


def _enough(valid: Array, pixels: Array, min_valid: int) -> bool:
    return len(valid) >= min_valid


def _nan() -> float:
    return math.nan


def _build_robust_depth(steps: Mapping[str, Step]) -> Model:
    def robust_depth(depth_m: Array, u: float, v: float, half: int = 2, min_valid: int = 5) -> Any:
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


@ROBUST_DEPTH.mistake(
    "read",
    "u and v are swapped",
    "u counts columns and v counts rows. Which of them does a NumPy index take first?",
)
def u_v_swapped(u: float, v: float) -> Any:
    return v, u


@ROBUST_DEPTH.mistake(
    "round",
    "the pixel is truncated instead of rounded",
    "(0, 0) is the centre of a pixel. Which pixel is 3.7 in?",
)
def truncated(coordinate: float) -> int:
    return int(coordinate)


@ROBUST_DEPTH.mistake(
    "window",
    "your window lacks its last row and column",
    "A slice stops before its end index. How many pixels lie between `v - half` and `v + half`?",
)
def last_missing(row: int, column: int, half: int) -> Window:
    return row - half, row + half, column - half, column + half


@ROBUST_DEPTH.mistake(
    "window",
    "your window does not depend on `half`",
    "What does your function do when somebody asks for half = 1?",
)
def half_ignored(row: int, column: int, half: int) -> Window:
    return _window(row, column, 2)


@ROBUST_DEPTH.mistake(
    "window",
    "your window reaches only `half // 2` pixels to each side",
    "`half = 2` makes a window of 5x5. How many pixels does yours have?",
)
def half_halved(row: int, column: int, half: int) -> Window:
    return _window(row, column, half // 2)


_ALONE = (
    "where the pixel itself has a depth, you return that alone",
    "A flying pixel has a depth, too. Who would notice?",
)


@ROBUST_DEPTH.mistake("shortcut", *_ALONE, name="pixel_alone")
def pixel_alone(image: Array, row: int, column: int) -> Any:
    height, width = image.shape
    inside = 0 <= row < height and 0 <= column < width
    return image[row, column] if inside and 0 < image[row, column] < math.inf else None


@ROBUST_DEPTH.mistake("shortcut", *_ALONE, name="pixel_alone")
def pixel_alone_unless_zero(image: Array, row: int, column: int) -> Any:
    height, width = image.shape
    known = -height <= row < height and -width <= column < width  # -9 counts from the far end
    return image[row, column] if known and image[row, column] > 0 else None


_NEGATIVE = (
    "near the left or top border an index goes negative, and Python counts that from the far end",
    "Try a list of ten numbers: what is `numbers[-2:3]`, and what is `numbers[-2]`?",
)


@ROBUST_DEPTH.mistake("cut", *_NEGATIVE)
def negative_index(image: Array, top: int, bottom: int, left: int, right: int) -> Array:
    return image[top:bottom, left:right]


@ROBUST_DEPTH.mistake("cut", *_NEGATIVE, name="negative_index")
def negative_row(image: Array, top: int, bottom: int, left: int, right: int) -> Array:
    return image[top:bottom, max(left, 0) : max(right, 0)]


@ROBUST_DEPTH.mistake("cut", *_NEGATIVE, name="negative_index")
def negative_column(image: Array, top: int, bottom: int, left: int, right: int) -> Array:
    return image[max(top, 0) : max(bottom, 0), left:right]


@ROBUST_DEPTH.mistake("cut", *_NEGATIVE, name="negative_index")
def wrapped_pixel_by_pixel(image: Array, top: int, bottom: int, left: int, right: int) -> Array:
    height, width = image.shape
    return image[np.ix_(range(top, min(bottom, height)), range(left, min(right, width)))]


@ROBUST_DEPTH.mistake(
    "cut",
    "a window left of the image or above it has a negative *end*, and that wraps round, too",
    "You have looked after the first index of each slice. Where is the last one when u = -9?",
)
def negative_end(image: Array, top: int, bottom: int, left: int, right: int) -> Array:
    return image[max(top, 0) : bottom, max(left, 0) : right]


@ROBUST_DEPTH.mistake(
    "cut",
    "at the border you move the window into the image instead of cutting it off",
    "Is the pixel that was asked for still in the middle of what is there to see around it?",
)
def moved_inside(image: Array, top: int, bottom: int, left: int, right: int) -> Array:
    row = min(max(top, 0), image.shape[0] - (bottom - top))
    column = min(max(left, 0), image.shape[1] - (right - left))
    return image[row : row + bottom - top, column : column + right - left]


@ROBUST_DEPTH.mistake(
    "cut",
    "you count the pixels of the border more than once",
    "Does a pixel become more certain because the image ends beside it?",
)
def border_repeated(image: Array, top: int, bottom: int, left: int, right: int) -> Array:
    rows = np.clip(range(top, bottom), 0, image.shape[0] - 1)
    columns = np.clip(range(left, right), 0, image.shape[1] - 1)
    return image[np.ix_(rows, columns)]


_LOST = (
    "the last row or column of the image is lost",
    "In an image of 16 columns the last is number 15. Does a slice that ends at 15 hold it?",
)


@ROBUST_DEPTH.mistake("cut", *_LOST)
def border_lost(image: Array, top: int, bottom: int, left: int, right: int) -> Array:
    height, width = image.shape
    return _cut(image, top, min(bottom, height - 1), left, min(right, width - 1))


@ROBUST_DEPTH.mistake("cut", *_LOST, name="border_lost")
def border_lost_and_negative_end(
    image: Array, top: int, bottom: int, left: int, right: int
) -> Array:
    height, width = image.shape
    return image[max(top, 0) : min(bottom, height - 1), max(left, 0) : min(right, width - 1)]


@ROBUST_DEPTH.mistake(
    "cut",
    "indices are taken modulo the image's size: at one border you read the opposite one",
    "What is -1 % 16? Is the pixel at the right border a neighbour of the one at the left?",
)
def modulo(image: Array, top: int, bottom: int, left: int, right: int) -> Array:
    height, width = image.shape
    return image[np.ix_(np.arange(top, bottom) % height, np.arange(left, right) % width)]


@ROBUST_DEPTH.mistake(
    "cut",
    "height and width of the image are swapped",
    "An image 16 wide and 12 high has the shape (12, 16). Which of the two limits the columns?",
)
def height_width_swapped(image: Array, top: int, bottom: int, left: int, right: int) -> Array:
    height, width = image.shape
    return _cut(image, top, min(bottom, width), left, min(right, height))


@ROBUST_DEPTH.mistake(
    "cut",
    "you give no answer as soon as the window touches the border",
    "Half of the window is still in the image. What does `min_valid` say about that?",
)
def border_refused(image: Array, top: int, bottom: int, left: int, right: int) -> Array:
    height, width = image.shape
    inside = top >= 0 and left >= 0 and bottom <= height and right <= width
    return image[top:bottom, left:right] if inside else image[:0, :0]


@ROBUST_DEPTH.mistake(
    "zeros",
    "zeros are counted as depths",
    "What does a camera of this kind write where it has no answer?",
)
def zeros_counted(pixels: Array) -> Array:
    return pixels


@ROBUST_DEPTH.mistake(
    "finite",
    "NaN is counted as a depth",
    "What is the median of 1, 2 and NaN? And is NaN != 0?",
)
def nan_counted(pixels: Array) -> Array:
    return pixels


@ROBUST_DEPTH.mistake(
    "finite",
    "infinity is counted as a depth",
    "NaN does not pass `> 0`. Does infinity?",
)
def infinity_counted(pixels: Array) -> Array:
    return pixels[~np.isnan(pixels)]


@ROBUST_DEPTH.mistake(
    "enough",
    "`min_valid` is ignored: a window with a single valid pixel is trusted like a full one",
    "Near the edge of an object one pixel may be left, and it may be a flying one. Who looks?",
)
def min_valid_ignored(valid: Array, pixels: Array, min_valid: int) -> bool:
    return True


@ROBUST_DEPTH.mistake(
    "enough",
    "`min_valid` is always 5 in your function",
    "What does it do when somebody passes min_valid = 1?",
)
def min_valid_fixed(valid: Array, pixels: Array, min_valid: int) -> bool:
    return len(valid) >= 5


@ROBUST_DEPTH.mistake(
    "enough",
    "exactly `min_valid` valid pixels are refused",
    "Fewer than min_valid is too few. And min_valid itself?",
)
def one_too_strict(valid: Array, pixels: Array, min_valid: int) -> bool:
    return len(valid) > min_valid


@ROBUST_DEPTH.mistake(
    "enough",
    "`min_valid` is compared with all pixels of the window",
    "How many pixels does your count find in a window in which every pixel is 0?",
)
def all_pixels_counted(valid: Array, pixels: Array, min_valid: int) -> bool:
    return pixels.size >= min_valid


@ROBUST_DEPTH.mistake(
    "none",
    "0 is returned where there is no answer, and NaN is wanted",
    "Whoever averages your depths over 100 frames: will they notice a 0 among them, or a NaN?",
)
def zero_returned() -> float:
    return 0.0


@ROBUST_DEPTH.mistake(
    "middle",
    "this is the mean, and the median is wanted",
    "One flying pixel 0.2 m behind the other eight: how far does it move your result?",
)
def mean(valid: Array) -> float:
    return float(np.mean(valid))


_EVEN = (
    "with an even number of valid pixels you take one of the middle two",
    "What is the median of 1, 2, 3 and 4?",
)


@ROBUST_DEPTH.mistake("middle", *_EVEN, name="one_of_the_middle_two")
def upper_of_the_middle_two(valid: Array) -> float:
    return float(np.sort(valid)[len(valid) // 2])


@ROBUST_DEPTH.mistake("middle", *_EVEN, name="one_of_the_middle_two")
def lower_of_the_middle_two(valid: Array) -> float:
    return float(np.sort(valid)[(len(valid) - 1) // 2])


EXERCISES = [DEPTH_NOISE, ROBUST_DEPTH]

# --- checkpoints ---

CHECKPOINTS = [
    Choice(
        name="depth_noise.rounded_corner",
        question="A camera looks into the corner of a white room, in the dark. Its depth image "
        "shows the corner rounded off and 20 mm too far away. How does that camera make depth?",
        options=(
            Option(
                "active stereo: two infrared eyes and a dot projector",
                "It measures in which *direction* its two eyes see a dot; light that took a detour "
                "only brightens the wall. It fails otherwise: points that float at edges, holes on "
                "black and on shiny things, nothing at all nearer than its minimum range.",
            ),
            Option(
                "structured light: one eye, and a pattern that it knows",
                "Triangulation as well: direction, not time. In the dark it is at its best; it "
                "fails in sunlight, which drowns the pattern, and where another one like it shines "
                "on the same scene, and it eats away edges.",
            ),
            Option(
                "time of flight: how late does the light come back?",
                "Part of the light reaches the eye by way of the other wall. It comes later, so "
                "the camera reads farther: *multipath*. Its other own failure is wrapping, when "
                "the echo comes back a whole period late.",
                right=True,
            ),
            Option(
                "any of the three: all of them send out infrared light",
                "They do, and all of them suffer from the sun. But light that comes late only "
                "deceives a camera that measures *time*.",
            ),
        ),
    ),
    Number(
        name="depth_noise.twice_as_far",
        question="You measure 0.6 mm of depth noise (standard deviation) on a wall at 0.4 m. Then "
        "you mount the camera for a wider view, 0.8 m away. What noise do you expect there, in mm?",
        value=2.4,
        unit="mm",
        why="Twice as far is half the disparity, and the same error in disparity then costs four "
        "times as much depth: 0.6 mm × (0.8 / 0.4)².",
        hint="Twice as far is half the disparity. How much depth does a tenth of a pixel stand for "
        "at 0.4 m, and how much at 0.8 m?",
        classics=(
            Classic(
                1.2,
                "That is noise in proportion to Z. Disparity is already proportional to "
                "1/Z, and the slope of a reciprocal is its square.",
            ),
            Classic(
                0.6,
                "Constant in *disparity*, yes; but the farther the wall, the more depth "
                "one pixel of disparity stands for.",
            ),
            Classic(
                4.8,
                "That is the third power of Z. dZ/dd = -fx B / d², and d stands for one "
                "power of 1/Z: two powers in all.",
            ),
            Classic(
                9.6,
                "That is the fourth power, which is how the *variance* grows. The "
                "standard deviation is its root.",
            ),
            Classic(0.3, "Halved is the *disparity*. Its noise stays, and weighs more."),
            Classic(
                0.85,
                "A factor √2 is what comes of adding two independent errors. Nothing is "
                "added here.",
            ),
            Classic(
                2.29,
                "That is the formula with fx = 447 px, B = 50 mm and σ_d = 0.08 px. You "
                "have *measured* 0.6 mm on your own camera: scale that.",
            ),
        ),
    ),
    Choice(
        name="depth_noise.why_squared",
        question="Why does the depth noise of a stereo camera grow with the square of the "
        "distance?",
        options=(
            Option(
                "the light that comes back falls with Z², so the image gets noisier",
                "That can happen, and would make σ_d itself grow with distance, on top of the law: "
                "exponents above 2 come from there. The square is there even with a constant σ_d.",
            ),
            Option(
                "a pixel covers an area that grows with Z²",
                "It does, and that is a price *sideways*: each side of it grows with Z, as in "
                "notebook 1. The area plays no part in how well depth is known.",
            ),
            Option(
                "two eyes, so two errors, and they multiply",
                "Independent errors add as squares: two equal ones make √2, at every distance. "
                "They are both in σ_d already.",
            ),
            Option(
                "Z is the reciprocal of the disparity, and the slope of 1/d is -1/d²",
                "Z = fx B / d, so |dZ/dd| = fx B / d² = Z² / (fx B). A constant σ_d, passed "
                "through that slope, comes out with Z².",
                right=True,
            ),
            Option(
                "the matcher finds the disparity less well the farther things are",
                "Its error in pixels stays about the same. What changes is how much depth hangs "
                "on a pixel.",
            ),
        ),
    ),
    Choice(
        name="depth_noise.long_baseline",
        question="The eyes of a camera are 50 mm apart, but its software believes 55 mm. What "
        "happens to the depths that it reports?",
        options=(
            Option(
                "all of them are 10 % too long",
                "Z = fx B / d is proportional to B, at every distance: 45 mm at 0.45 m. That is a "
                "*bias* that grows with Z, not with Z², and no averaging removes it.",
                right=True,
            ),
            Option(
                "all of them are 21 % too long, because the error is squared",
                "The square belongs to the *noise*, which passes through the slope of 1/d. B "
                "stands in the formula once.",
            ),
            Option(
                "all of them are 9 % too short, because B is in the denominator",
                "It is in the denominator of the noise. In Z = fx B / d it is on top: a disparity "
                "that the true B made is multiplied by the wrong one.",
            ),
            Option(
                "they stay right on average and become 10 % noisier",
                "Their noise is scaled like everything else. But so is the mean: the software "
                "cannot know that its ruler is wrong.",
            ),
        ),
    ),
    Number(
        name="depth_noise.short_baseline",
        question="A D405 has its eyes 18 mm apart; your other camera has them 50 mm apart. With "
        "the same fx and the same σ_d, how many times as large is the depth noise of the D405 at "
        "the same distance?",
        value=50 / 18,
        unit="times",
        why="σ_Z is proportional to 1/B: 50 / 18. At 0.4 m, with fx = 447 px and σ_d = 0.08 px, "
        "1.59 mm instead of 0.57 mm. And without a projector it needs a surface with texture to "
        "reach even that. In return it sees things from about 70 mm on.",
        hint="Only B differs. Where does it stand in σ_Z = Z² σ_d / (fx B)?",
        classics=(
            Classic(
                0.36,
                "Upside down: eyes closer together see *less* disparity, so the same "
                "error in it weighs more.",
            ),
            Classic(7.72, "Squared is Z, not B: B stands in the formula once."),
            Classic(1.667, "There is no root in the law: B is in the denominator as it is."),
            Classic(1.0, "fx and σ_d are the same, but the disparity is not: fx B / Z."),
        ),
    ),
    Choice(
        name="depth_noise.hundred_frames",
        question="You average 100 depth frames of a still wall. Is the error of the mean a tenth "
        "of the error of one frame?",
        options=(
            Option(
                "yes: the error of a mean falls with the root of the number",
                "It does for frames that know nothing of each other. Here, frame after frame "
                "looks at the same dots with the same lenses, and part of the error is the same.",
            ),
            Option(
                "no, it is a hundredth: there are 100 frames",
                "Sums of independent errors grow with √N, not with N, so their mean falls with "
                "√N at best: ten, not a hundred.",
            ),
            Option(
                "only the part that is new in each frame falls that far",
                "What wanders slowly falls less (a correlation of 0.5 from one frame to the next "
                "leaves 5.8 instead of 10; a real D435 gained 7.4), and what stands still, "
                "the fixed pattern and the bias, does not fall at all.",
                right=True,
            ),
            Option(
                "no: depth errors are systematic, and averaging never helps",
                "Some of them are. But the flicker that you see from frame to frame is not, and "
                "that does average down.",
            ),
        ),
    ),
    Choice(
        name="depth_noise.width",
        question="In the studio exercise you measure the width of a block in the middle of the "
        "image, between two fixed pixels and from the depth of one pixel on its face, in each of "
        "100 frames, at three distances. Does the standard deviation of that *width* follow the "
        "curve of σ_Z?",
        options=(
            Option(
                "yes: the width is computed from depths, so their noise is its noise",
                "Only a part of it: an edge at angle θ off the axis moves sideways by tan θ times "
                "the error in Z, and for a small block in the middle tan θ is small.",
            ),
            Option(
                "no: a width is a difference, so the noise cancels",
                "X = x Z, and x has opposite signs at the two ends: an error in Z that they share "
                "moves them apart instead of along.",
            ),
            Option(
                "no: it falls with distance, because the block gets smaller in the image",
                "tan θ does shrink, with 1/Z. The noise that it is multiplied with grows with Z².",
            ),
            Option(
                "no: it is several times smaller and grows about like Z",
                "σ_Z times (the width) / Z: Z² / Z = Z. At 0.4 m, 60 mm wide, 0.57 mm in depth "
                "leaves 0.09 mm in width (0.06 mm if each end takes its own depth, less with a "
                "median over a window). How well the *edges* are found matters more: 0.1 px makes "
                "0.13 mm. So the curve goes with the depth of the face.",
                right=True,
            ),
        ),
    ),
    Number(
        name="depth_noise.minimum_range",
        question="A matcher tries disparities up to 126 px. With fx = 431.1 px and a baseline of "
        "50.17 mm, at which distance does a surface reach that limit, in m?",
        value=431.1 * 0.05017 / 126,
        unit="m",
        why="Z = fx B / d = 431.1 px × 0.05017 m / 126 px = 0.172 m. Nearer than that the "
        "disparity is larger than any that is tried, and the camera has no depth, or a wrong one. "
        "In a larger image fx is larger, and so is this distance. The vendor leaves some margin "
        "and says 0.195 m for 848x480.",
        hint="Z = fx B / d with the largest d that the matcher tries, and B in metres.",
        classics=(
            Classic(0.0147, "fx and the disparity are swapped: Z = fx B / d."),
            Classic(5.83, "Upside down: d / (fx B) is 1/Z."),
            Classic(21.6, "That is fx B, in px·m. Divide it by the disparity."),
            Classic(
                0.05017,
                "That is the baseline. A surface there would have a disparity of fx, 431 px.",
            ),
            Classic(3.42, "Where is the baseline?"),
            Classic(
                0.1774,
                "That is the data sheet's camera, 447 px and 50 mm. This one "
                "has numbers of its own.",
            ),
        ),
    ),
]

OBJECTIVES = (
    Objective(
        "predict depth noise from baseline, focal length and distance, and derive the law",
        ("depth_noise.twice_as_far", "depth_noise.depth_noise"),
    ),
    Objective(
        "say what averaging can remove, and what it cannot",
        ("depth_noise.hundred_frames",),
    ),
    Objective(
        "deeper: say where the square comes from, and what a place costs",
        ("depth_noise.why_squared", "depth_noise.short_baseline"),
    ),
    Objective(
        "deeper: say how three kinds of camera make depth, and know each by the way it fails",
        ("depth_noise.rounded_corner", "depth_noise.minimum_range"),
    ),
    Objective(
        "deeper: read one depth out of a depth image without being deceived",
        ("depth_noise.robust_depth",),
    ),
    Objective(
        "studio: tell noise from bias, in depth and in width",
        ("depth_noise.width", "depth_noise.long_baseline"),
    ),
)
