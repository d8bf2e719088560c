"""What is handed in: raw measurements, what the student claims of them, and what was answered.

Lengths in m, px and s unless a name says otherwise. Every class checks what it is given, whatever
its type, and raises a ValueError that names the field; arrays are kept read-only, lists as tuples,
NumPy's numbers as plain ones. Width is not handed in (FORMAT.md says why).
"""

from __future__ import annotations

import re
import reprlib
import unicodedata
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

EXERCISES = ("studio_1",)
Source = Literal["live", "recorded", "simulated"]
Cause = Literal["bias", "noise"]
Window = tuple[int, int, int, int]
Interval = tuple[float, float]

MAX_STACKS = 12  # distances
MAX_FRAMES = 2_000  # at one distance
MAX_WINDOW_PX = 64  # a side; the exercise asks for 40
MAX_SAMPLES = 1_000_000  # of one stack (600 frames of 40 x 40 px): it sets the grader's memory
MAX_ALL_SAMPLES = 2_000_000  # of all stacks (12 of 100 frames): it sets how long a bundle takes
MAX_ENTRIES = 100  # of any list or dictionary
MAX_NAME = 100  # characters
MAX_PARAGRAPH = 5_000  # characters
LARGEST = 1e9  # of a claimed number; what follows from it stays finite

_BIDI_CONTROLS = "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"
_MADE = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}\+00:00")
_OUTCOME = re.compile(r"[a-z0-9_]+(\.[a-z0-9_]+)*")


@dataclass(frozen=True)
class CameraFacts:
    """The depth camera as it describes itself.

    width, height, fx, fy, cx, cy: of the depth image, px. model, coeffs (5): its distortion.
    baseline_m: None where a recording does not say. depth_scale_m: metres of a count.
    """

    name: str
    serial: str
    source: Source
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str
    coeffs: tuple[float, ...]
    baseline_m: float | None
    depth_scale_m: float

    def __post_init__(self) -> None:
        _put(self, "name", text("name", self.name, MAX_NAME))
        _put(self, "serial", text("serial", self.serial, MAX_NAME, empty=True))
        _put(self, "source", one_of("source", self.source, get_args(Source)))
        for name in ("width", "height"):
            _put(self, name, whole(name, getattr(self, name), 1, 20_000))
        for name in ("fx", "fy"):
            _put(self, name, number(name, getattr(self, name), 1, 1e5))
        for name in ("cx", "cy"):
            _put(self, name, number(name, getattr(self, name), -1e5, 1e5))
        _put(self, "model", text("model", self.model, MAX_NAME))
        coeffs = _numbers("coeffs", self.coeffs, -1e6, 1e6)
        if len(coeffs) != 5:
            raise ValueError(f"coeffs: got {len(coeffs)} numbers, want 5")
        _put(self, "coeffs", coeffs)
        if self.baseline_m is not None:
            _put(self, "baseline_m", number("baseline_m", self.baseline_m, 1e-4, 10))
        _put(self, "depth_scale_m", number("depth_scale_m", self.depth_scale_m, 1e-7, 1))


@dataclass(frozen=True, eq=False)
class Stack:
    """The raw measurement at one distance.

    distance_m: by tape. window: (left, top, width, height) px in the depth image, on the face.
    counts (N, height, width): uint16 depth counts, 0 invalid. times_s (N,): the camera's clock.
    """

    distance_m: float
    window: Window
    counts: NDArray[np.uint16]
    times_s: NDArray[np.float64]

    def __post_init__(self) -> None:
        _put(self, "distance_m", distance("distance_m", self.distance_m))
        left, top, width, height = _window(self.window)
        _put(self, "window", (left, top, width, height))
        counts = _array("counts", self.counts, np.dtype(np.uint16), 3)
        times = _array("times_s", self.times_s, np.dtype(np.float64), 1)
        n = len(counts)
        if not 1 <= n <= MAX_FRAMES or counts.shape[1:] != (height, width):
            raise ValueError(
                f"counts: got shape {counts.shape}, want (1 to {MAX_FRAMES}, {height}, {width}) "
                "as in its window"
            )
        if counts.size > MAX_SAMPLES:
            raise ValueError(f"counts: got {counts.size} values, want {MAX_SAMPLES} at most")
        if times.shape != (n,):
            raise ValueError(f"times_s: got shape {times.shape}, want ({n},), one for each frame")
        if not (np.abs(times) <= 1e12).all():  # also NaN
            raise ValueError("times_s: want finite numbers of seconds")
        _put(self, "counts", counts)
        _put(self, "times_s", times)


@dataclass(frozen=True)
class Row:
    """The student's table at one distance; None is what was left out."""

    distance_m: float
    depth_bias_mm: float | None = None
    depth_bias_se_mm: float | None = None
    depth_std_mm: float | None = None
    depth_std_se_mm: float | None = None
    invalid_fraction: float | None = None

    def __post_init__(self) -> None:
        _put(self, "distance_m", distance("distance_m", self.distance_m))
        for name in (
            "depth_bias_mm",
            "depth_bias_se_mm",
            "depth_std_mm",
            "depth_std_se_mm",
            "invalid_fraction",
        ):
            _put(self, name, _claim(name, getattr(self, name)))


@dataclass(frozen=True)
class Claims:
    """The student's table and fit; None is what was left out.

    sigma_d_px: std of disparity with the exponent held at 2, and its 95 % interval (low, high).
    exponent: of a fit with the exponent free, and its 95 % interval.
    """

    rows: tuple[Row, ...] = ()
    sigma_d_px: float | None = None
    sigma_d_interval_px: Interval | None = None
    exponent: float | None = None
    exponent_interval: Interval | None = None

    def __post_init__(self) -> None:
        rows = _several("rows", self.rows, Row, MAX_STACKS)
        _different("rows", [row.distance_m for row in rows])
        _put(self, "rows", rows)
        for name in ("sigma_d_px", "exponent"):
            _put(self, name, _claim(name, getattr(self, name)))
        for name in ("sigma_d_interval_px", "exponent_interval"):
            _put(self, name, _interval(name, getattr(self, name)))


@dataclass(frozen=True)
class Plot:
    """What the student's figure showed: std of depth in mm, one of each for every distance.

    predicted_mm: None where nothing was predicted.
    """

    distances_m: tuple[float, ...]
    measured_mm: tuple[float, ...]
    predicted_mm: tuple[float, ...] | None

    def __post_init__(self) -> None:
        for name in ("distances_m", "measured_mm", "predicted_mm"):
            if name != "predicted_mm" or self.predicted_mm is not None:
                _put(self, name, _numbers(name, getattr(self, name), -LARGEST, LARGEST))
        n = len(self.distances_m)
        predicted = n if self.predicted_mm is None else len(self.predicted_mm)
        if not n == len(self.measured_mm) == predicted:
            raise ValueError(
                f"plot: got {n} distances, {len(self.measured_mm)} measured "
                f"and {predicted} predicted values, want as many of each"
            )


@dataclass(frozen=True)
class Conclusion:
    """The closing paragraph, and what it says: which error dominates at the mounting distance.

    distance_m: where the camera will be mounted. frames: how many are averaged there.
    """

    distance_m: float | None = None
    frames: int = 1
    dominates: Cause | None = None
    paragraph: str = ""

    def __post_init__(self) -> None:
        if self.distance_m is not None:
            _put(self, "distance_m", distance("distance_m", self.distance_m))
        _put(self, "frames", whole("frames", self.frames, 1, 1_000_000))
        if self.dominates is not None:
            _put(self, "dominates", one_of("dominates", self.dominates, get_args(Cause)))
        paragraph = text("paragraph", self.paragraph, MAX_PARAGRAPH, empty=True, lines=True)
        _put(self, "paragraph", paragraph)


@dataclass(frozen=True)
class Outcome:
    """How a checkpoint or an exercise ended: right at last or not, after how many attempts."""

    right: bool
    attempts: int

    def __post_init__(self) -> None:
        if not isinstance(self.right, (bool, np.bool_)):
            raise ValueError(f"right: got {shown(self.right)}, want True or False")
        _put(self, "right", bool(self.right))
        _put(self, "attempts", whole("attempts", self.attempts, 0, 1_000_000))


@dataclass(frozen=True, eq=False)
class Submission:
    """All that one student hands in for one exercise.

    made: UTC, as `results.now()` writes it. versions: of Python and packages, by name.
    tape_sigma_m: std of a tape reading, 0 where distances are exact. caliper_m: the block's width.
    stacks: at different distances. outcomes: by the name of the checkpoint or exercise, such as
    "depth_noise.width".
    """

    student: str
    made: str
    versions: dict[str, str]
    camera: CameraFacts
    tape_sigma_m: float
    caliper_m: float
    stacks: tuple[Stack, ...]
    claims: Claims
    plot: Plot | None
    conclusion: Conclusion
    outcomes: dict[str, Outcome]
    exercise: str = "studio_1"

    def __post_init__(self) -> None:
        _put(self, "student", text("student", self.student, MAX_NAME))
        _put(self, "exercise", one_of("exercise", self.exercise, EXERCISES))
        _put(self, "made", _moment("made", self.made))
        _put(self, "versions", _versions(self.versions))
        _put(self, "tape_sigma_m", number("tape_sigma_m", self.tape_sigma_m, 0, 1))
        _put(self, "caliper_m", number("caliper_m", self.caliper_m, 1e-4, 10))
        _put(self, "stacks", _several("stacks", self.stacks, Stack, MAX_STACKS))
        _different("stacks", [stack.distance_m for stack in self.stacks])
        samples = sum(stack.counts.size for stack in self.stacks)
        if samples > MAX_ALL_SAMPLES:
            raise ValueError(f"stacks: got {samples} values, want {MAX_ALL_SAMPLES} at most")
        _put(self, "outcomes", _outcomes(self.outcomes))
        for name, kind in (("camera", CameraFacts), ("claims", Claims), ("conclusion", Conclusion)):
            _want(name, getattr(self, name), kind)
        if self.plot is not None:
            _want("plot", self.plot, Plot)
        for stack in self.stacks:
            _inside(stack.window, self.camera)


def shown(value: Any) -> str:
    """A value in at most some 40 characters, all of them printable."""
    brief = reprlib.Repr()
    brief.maxlevel, brief.maxother, brief.maxstring = 2, 40, 40
    try:
        return brief.repr(value)
    except ValueError:  # Python does not write out an integer of more than 4300 digits
        return "an integer of thousands of digits"


def number(name: str, value: Any, low: float, high: float) -> float:
    """`value` as a float; ValueError unless it is a number from low to high."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise ValueError(f"{name}: got {shown(value)}, want a number")
    if not low <= value <= high:  # also NaN; an integer of any size is compared exactly
        raise ValueError(f"{name}: got {shown(value)}, want a number from {low:g} to {high:g}")
    return float(value)


def distance(name: str, value: Any) -> float:
    """`value` as metres from the camera; ValueError unless it is from 0.01 to 100."""
    try:
        return number(name, value, 0.01, 100)
    except ValueError as error:
        if isinstance(value, (int, float)) and 100 < value <= 100_000:  # in millimetres, then
            hint = f"metres are wanted: did you mean {value / 1000:g}?"
            raise ValueError(f"{name}: got {shown(value)}; {hint}") from None
        raise error


def whole(name: str, value: Any, low: int, high: int) -> int:
    """`value` as an int; ValueError unless it is a whole number from low to high."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise ValueError(f"{name}: got {shown(value)}, want a whole number")
    if not low <= value <= high:
        raise ValueError(f"{name}: got {shown(value)}, want a whole number from {low} to {high}")
    return int(value)


def text(name: str, value: Any, longest: int, empty: bool = False, lines: bool = False) -> str:
    """`value`; ValueError unless it is text that any file and page can hold.

    empty: may be. lines: may hold line ends and tabs. Refused are control characters, lone
    surrogates (no file can hold them) and the signs that make text run backwards (a name could look
    like another).
    """
    if not isinstance(value, str):
        raise ValueError(f"{name}: got {shown(value)}, want text")
    if len(value) > longest:
        raise ValueError(f"{name}: got {len(value)} characters, want {longest} at most")
    if not empty and not any(sign.isalnum() for sign in value):  # blanks may be invisible
        raise ValueError(f"{name}: got {shown(value)}, want some letters or digits")
    for sign in value:
        if lines and sign in "\n\t":
            continue
        if unicodedata.category(sign) in ("Cc", "Cs", "Zl", "Zp") or sign in _BIDI_CONTROLS:
            raise ValueError(f"{name}: holds the character U+{ord(sign):04X}, which is no text")
    return value


def one_of(name: str, value: Any, choices: tuple[str, ...]) -> str:
    """`value`; ValueError unless it is one of `choices`."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name}: got {shown(value)}, want one of {', '.join(choices)}")
    return value


def _put(owner: Any, name: str, value: Any) -> None:
    """Set a field of a frozen dataclass that is being made."""
    object.__setattr__(owner, name, value)


def _want(name: str, value: Any, kind: type) -> None:
    if not isinstance(value, kind):
        raise ValueError(f"{name}: got {shown(value)}, want {kind.__name__}")


def _several(name: str, values: Any, kind: type, most: int) -> tuple[Any, ...]:
    if not isinstance(values, (list, tuple)):
        raise ValueError(f"{name}: got {shown(values)}, want several {kind.__name__}")
    if len(values) > most:
        raise ValueError(f"{name}: got {len(values)} of them, want {most} at most")
    for value in values:
        _want(name, value, kind)
    return tuple(values)


def _different(name: str, distances: list[float]) -> None:
    for z in distances:
        if distances.count(z) > 1:
            raise ValueError(f"{name}: {z:g} m is there twice, want different distances")


def _numbers(name: str, values: Any, low: float, high: float) -> tuple[float, ...]:
    if isinstance(values, np.ndarray):
        values = values.tolist()
    if not isinstance(values, (list, tuple)):
        raise ValueError(f"{name}: got {shown(values)}, want a list of numbers")
    if len(values) > MAX_ENTRIES:
        raise ValueError(f"{name}: got {len(values)} of them, want {MAX_ENTRIES} at most")
    return tuple(number(name, value, low, high) for value in values)


def _claim(name: str, value: Any) -> float | None:
    return None if value is None else number(name, value, -LARGEST, LARGEST)


def _interval(name: str, value: Any) -> Interval | None:
    if value is None:
        return None
    ends = _numbers(name, value, -LARGEST, LARGEST)
    if len(ends) != 2 or ends[0] > ends[1]:
        raise ValueError(f"{name}: got {shown(value)}, want (low, high)")
    return ends[0], ends[1]


def _window(value: Any) -> Window:
    if not isinstance(value, (list, tuple)) or len(value) != 4:
        raise ValueError(f"window: got {shown(value)}, want (left, top, width, height) px")
    left, top = (whole("window", edge, 0, 20_000) for edge in value[:2])
    width, height = (whole("window", size, 1, MAX_WINDOW_PX) for size in value[2:])
    return left, top, width, height


def _inside(window: Window, camera: CameraFacts) -> None:
    left, top, width, height = window
    if left + width > camera.width or top + height > camera.height:
        image = f"{camera.width}x{camera.height} px"
        raise ValueError(f"window: got {window}, want a window inside the image of {image}")


def _array(name: str, values: Any, dtype: np.dtype[Any], rank: int) -> NDArray[Any]:
    """The array itself where nobody can write to it, else a copy that nobody can write to."""
    if not isinstance(values, np.ndarray) or values.dtype != dtype or values.ndim != rank:
        got = f"{values.ndim} of {values.dtype}" if isinstance(values, np.ndarray) else "no array"
        raise ValueError(f"{name}: dimensions: got {got}, want {rank} of {dtype}")
    if values.flags.writeable:
        values = values.copy()
        values.flags.writeable = False
    return values


def _moment(name: str, value: Any) -> str:
    if not isinstance(value, str) or not _MADE.fullmatch(value):
        raise ValueError(f"{name}: got {shown(value)}, want UTC like 2026-03-01T12:00:00+00:00")
    try:
        moment = datetime.fromisoformat(value)
    except ValueError:
        raise ValueError(f"{name}: got {shown(value)}, which is no day or time") from None
    if moment.year < 2000 or moment.utcoffset() != timedelta(0):
        raise ValueError(f"{name}: got {shown(value)}, want a moment after the year 2000, in UTC")
    return value


def _dictionary(name: str, value: Any) -> dict[Any, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{name}: got {shown(value)}, want a dictionary")
    if len(value) > MAX_ENTRIES:
        raise ValueError(f"{name}: got {len(value)} entries, want {MAX_ENTRIES} at most")
    return dict(value)


def _versions(value: Any) -> dict[str, str]:
    versions = _dictionary("versions", value)
    for package, version in versions.items():
        text("versions", package, MAX_NAME)
        text("versions", version, MAX_NAME)
    return versions


def _outcomes(value: Any) -> dict[str, Outcome]:
    outcomes = _dictionary("outcomes", value)
    for name, outcome in outcomes.items():
        if not isinstance(name, str) or len(name) > MAX_NAME or not _OUTCOME.fullmatch(name):
            raise ValueError(f"outcomes: got {shown(name)}, want names like 'depth_noise.width'")
        _want(f"outcomes: {name}", outcome, Outcome)
    return outcomes
