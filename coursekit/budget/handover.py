"""What notebooks 1 to 4 found, as rows of the budget, and the lesson's table to lay beside them.

Each row says whose number it is. A file that is missing, of another version, or damaged is named,
and the reference that comes with the course is used in its place; so is a file that lacks a number.
Nothing is replaced in silence.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from coursekit import checks, results
from coursekit.arm import widowx
from coursekit.budget.budget import SIGMAS, Along, ErrorBudget, ErrorTerm
from coursekit.budget.view import GRIPPER_DOWN, View
from coursekit.checks import want
from coursekit.geometry import Intrinsics
from coursekit.intrinsics.derivatives import PARAMETERS, scaled_root
from coursekit.results import Covariance, ErrorKind, Quantity, Result, Source
from coursekit.specifications import DATA, device
from coursekit.stereo.law import depth_slope
from coursekit.words import say

LESSON = "the lesson"
LESSON_CAMERA = Intrinsics(848, 480, 447.0, 447.0, 424.0, 240.0)
LESSON_BASELINE_M = 0.050
LESSON_DISTANCE_M = 0.45
LESSON_SIGMA_D_PX = 0.08
WRIST_DISTANCE_M = 0.25
REFERENCE = DATA / "reference_results"
MOUNT_TWIST = ("rx", "ry", "rz", "tx", "ty", "tz")
BIAS = "depth_bias_fitted_at_450_mm|depth_bias_at_450_mm"
NEEDED: dict[str, tuple[str, ...]] = {  # by notebook; "a|b": either
    "01_pinhole": ("depth_fx", "depth_fy", "depth_cx", "depth_cy"),
    "02_depth_noise": ("sigma_d", BIAS),
    "03_intrinsics": ("fx", "fy", "cx", "cy"),
    "04_hand_eye": MOUNT_TWIST,
}
BY_SIGMA = ("03_intrinsics", "04_hand_eye")  # their sigmas are the rows; without they say nothing
TOGETHER = ("01_pinhole", "03_intrinsics", "04_hand_eye")  # all of it from one place, or none
LAW = "depth_bias"  # the name in the file of the covariance of s and o
STANDING = "eye_to_hand"
COVARIANCE_OF = {"03_intrinsics": "intrinsics", "04_hand_eye": "X"}  # its name in the file
USUAL_DEPTH_SIZE = (848, 480)  # of the depth image, where notebook 1 did not keep it


# --- the lesson's table ---


def lesson_view() -> View:
    """The lesson's camera: 447 px, 50 mm, the object in the middle of the image at 0.45 m."""
    return View(LESSON_CAMERA, LESSON_DISTANCE_M, LESSON_BASELINE_M)


def lesson_terms(stated: bool) -> tuple[ErrorTerm, ...]:
    """The lesson's six rows; stated: with its own rounded millimetres at the object."""

    def row(
        name: str, kind: ErrorKind, low: float, high: float, along: Along, *at_mm: float
    ) -> ErrorTerm:
        at = (1e-3 * at_mm[0], 1e-3 * at_mm[-1]) if stated else None
        return ErrorTerm(name, kind, low, high, along, LESSON, stated_m=at)

    turn, matching = math.radians(0.5), LESSON_SIGMA_D_PX
    per_px = -float(depth_slope(LESSON_DISTANCE_M, LESSON_CAMERA.fx, LESSON_BASELINE_M))
    depth = (
        row("depth noise", "noise", 7e-4, 7e-4, "ray", 0.7),
        row("depth bias", "bias", 2e-3, 5e-3, "ray", 2.0, 6.0),
    )
    if not stated:
        bias = row("depth bias", "bias", 2e-3 / per_px, 5e-3 / per_px, "disparity")
        bias = replace(bias, source=f"{LESSON}, read as an offset of disparity")
        depth = (row("depth noise", "noise", matching, matching, "disparity"), bias)
    return (
        row("pixel", "noise", 1.0, 1.0, "image", 1.0),
        *depth,
        row("hand-eye rotation", "bias", turn, turn, "turn", 0.0, 3.9),
        row("hand-eye translation", "bias", 1e-3, 2e-3, "shift", 1.0, 2.0),
        row("forward kinematics", "bias", 2e-3, 4e-3, "shift", 2.0, 4.0),
    )


def lesson_budget(stated: bool = True) -> ErrorBudget:
    """The lesson's table for a 25 mm cube seen from 0.45 m, eye-to-hand, tolerance ±7 mm.

    stated: with the lesson's own millimetres at the object, its ranges included ("up to 3.9" is 0
    to 3.9), each in any direction; they hold at 0.45 m only. Otherwise the same magnitudes are
    converted here and the budget can be moved: the depth noise from 0.08 px of disparity, the depth
    bias from 0.22 to 0.55 px, which is **assumed**: an offset of disparity, 2 to 5 mm at 0.45 m.

    >>> [round(1000 * end, 1) for end in lesson_budget().worst_case_m]
    [5.0, 15.9]
    """
    title = "The lesson's table" if stated else "The lesson's magnitudes, converted"
    return ErrorBudget(lesson_terms(stated), lesson_view(), title=title)


def wrist_budget() -> ErrorBudget:
    """The D405 on the wrist, looking at the object from 0.25 m along its optical axis.

    Camera and baseline are those of data/devices.toml. Nobody has published the D405's bias: it is
    the lesson's here, as an offset of disparity. The mount's and the arm's rows are the lesson's;
    for a camera on the wrist the arm's counts for what differs between looking and grasping, so it
    is the upper end. The gripper comes along the fingers' direction of the maker's mount, the
    camera 20° from it.

    >>> wrist_budget().at(distance_m=0.40)["depth bias"].magnitude
    '0.22 to 0.55 px'
    """
    unit = device("D405").unit
    T_base_camera = np.eye(4)  # where it stands does not matter, only how it is turned
    T_base_camera[:3, :3] = GRIPPER_DOWN @ widowx().T_gripper_camera[:3, :3]
    view = View(unit.depth, WRIST_DISTANCE_M, unit.baseline_m, T_base_camera=T_base_camera)
    return ErrorBudget(lesson_terms(False), view, title="D405 on the wrist")


# --- what the notebooks found ---


@dataclass(frozen=True)
class NotebookResult:
    """One notebook's result. says: whose is used, and why if it is not the student's.

    yours: None where it cannot be used. lacks: what it does not hold and the reference gives.
    """

    lesson: str
    yours: Result | None
    reference: Result | None
    says: str
    lacks: tuple[str, ...] = ()

    def result(self, names: str = "") -> Result:
        """The student's, else the reference, of a number in `NEEDED`; ValueError for neither."""
        chosen = self.reference if names in self.lacks else self.yours or self.reference
        if chosen is None:
            raise ValueError(f"{self.lesson}: no number to use. {self.says}")
        return chosen

    def whose(self, names: str = "") -> str:
        """Whose number that is, in a few words, for a row of the table."""
        result = self.result(names)
        if result is self.reference:
            return f"reference ({result.camera})"
        return f"yours ({result.source}: {result.camera}, {result.date[:10]})"


@dataclass(frozen=True)
class HandOver:
    """What the four notebooks hand over, by name of the lesson."""

    found: dict[str, NotebookResult]

    def __getitem__(self, lesson: str) -> NotebookResult:
        return self.found[checks.choice("lesson", lesson, self.found)]

    def __iter__(self) -> Iterator[NotebookResult]:
        return iter(self.found.values())

    def quantity(self, lesson: str, names: str) -> Quantity:
        """A number of one notebook; names: "a|b" is b where there is no a."""
        found = _first(self[lesson].result(names).quantities, names)
        if found is None:
            raise ValueError(f"{lesson}: holds no {names.replace('|', ' or ')}")
        return found

    @property
    def source(self) -> Source:
        """Of the whole: "reference" as soon as one notebook's numbers are the reference's."""
        sources = [found.yours.source if found.yours else "reference" for found in self]
        order = ("reference", "simulated", "recorded", "live")
        return min(sources, key=order.index)

    @property
    def name(self) -> str:
        """The cameras whose numbers these are."""
        return ", ".join(dict.fromkeys(found.result().camera for found in self))

    def __repr__(self) -> str:
        said = [found.says for found in self]
        own = {found.lesson[:2]: found.yours.serial for found in self if found.yours}
        serials = {lesson: serial for lesson, serial in own.items() if serial}  # an arm has none
        if len(set(serials.values())) > 1:
            which = ", ".join(f"{lesson}: {serial}" for lesson, serial in serials.items())
            said.append(say("budget.cameras", which=which))
        return "\n".join(said)

    # the budget

    def view(self) -> View:
        """The camera of notebook 1 with the object on its axis, at the lesson's distance.

        Its baseline is what that camera reports, and the D435's where it reports none.
        """
        fx, fy, cx, cy = (self.quantity("01_pinhole", name).value for name in NEEDED["01_pinhole"])
        width = round(self._also("01_pinhole", "depth_width", USUAL_DEPTH_SIZE[0]))
        height = round(self._also("01_pinhole", "depth_height", USUAL_DEPTH_SIZE[1]))
        usual_mm = 1e3 * device("D435").unit.baseline_m
        baseline_m = 1e-3 * self._also("01_pinhole", "baseline", usual_mm)
        return View(Intrinsics(width, height, fx, fy, cx, cy), LESSON_DISTANCE_M, baseline_m)

    def terms(
        self, subtract_depth_bias: bool = False, mount: str = STANDING
    ) -> tuple[ErrorTerm, ...]:
        """The rows, each with its source.

        subtract_depth_bias: as if every depth were corrected by the bias that notebook 2 measured,
        so that only what is not known of it stays. mount: of the camera, "eye_to_hand" or
        "eye_in_hand"; the other one's stands in where notebook 4 kept one only. What nobody has
        measured stays the lesson's: the detector's pixel, and the arm where nobody touched the
        board. What was measured with a standard deviation is a normal bias, shown up to two of
        them.
        """
        pixel, arm = lesson_terms(stated=False)[0], self._arm()
        depth = self._depth_noise(), self._depth_bias(subtract_depth_bias)
        return (pixel, *depth, self._intrinsics(), *self._hand_eye(mount), arm)

    def budget(self, subtract_depth_bias: bool = False) -> ErrorBudget:
        """The student's own table, the reference's numbers where there are no others.

        subtract_depth_bias: as for `terms`. `at` and `with_term` of what comes back see it from
        another place, with another grasp, or with another number.
        """
        return ErrorBudget(
            self.terms(subtract_depth_bias),
            self.view(),
            autocorrelation=self._also("02_depth_noise", "frame_autocorrelation", 0.0),
            title="Your budget" if any(found.yours for found in self) else "The reference budget",
        )

    def wrist_budget(self) -> ErrorBudget:
        """The D405 on the wrist with these numbers, as the function `wrist_budget` sees it.

        The matching noise, K and mount are those of the notebooks; the depth bias stays the
        assumed one there, because notebook 2's belongs to another camera.
        """
        wrist, own = wrist_budget(), self.budget()
        for term in self.terms(mount="eye_in_hand"):
            if term.name != "depth bias":
                wrist = wrist.with_term(term)
        return wrist.at(autocorrelation=own.autocorrelation, title=own.title)

    def _known(self, lesson: str) -> Covariance:
        """The covariance that the notebook kept, else the sigmas of the numbers needed."""
        known, names = self[lesson].result().covariances.get(COVARIANCE_OF[lesson]), NEEDED[lesson]
        if known is not None and set(names) <= set(known.names) <= {*PARAMETERS, *MOUNT_TWIST}:
            return known
        sigmas = [self.quantity(lesson, name).sigma for name in names]
        if None in sigmas:
            raise ValueError(f"{lesson}: {names[sigmas.index(None)]} has no sigma")
        return Covariance(names, np.diag(np.square(np.array(sigmas, dtype=np.float64))))  # type: ignore[arg-type]

    def _also(self, lesson: str, name: str, otherwise: float) -> float:
        """A number that the notebook may have kept."""
        found = self[lesson].result().quantities.get(name)
        return otherwise if found is None else found.value

    def _depth_noise(self) -> ErrorTerm:
        """With the pattern that every frame repeats, which no averaging takes away."""
        sigma_d = self.quantity("02_depth_noise", "sigma_d").value
        whose = self["02_depth_noise"].whose("sigma_d")
        floor = self._also("02_depth_noise", "fixed_pattern", 0.0)
        return ErrorTerm("depth noise", "noise", sigma_d, sigma_d, "disparity", whose, floor=floor)

    def _depth_bias(self, subtracted: bool) -> ErrorTerm:
        """By the law s Z - o Z²/(f B) that notebook 2 fitted; a file that holds the bias at 0.45 m
        alone has it taken for a scale, between a shift and what grows with Z². Of a camera whose
        bias nobody measured that of another unit says nothing: it is the lesson's range."""
        name, notebook = BIAS, self["02_depth_noise"]
        if name in notebook.lacks:
            return lesson_terms(stated=False)[2]
        found, whose = notebook.result(name), notebook.whose(name)
        known = found.covariances.get(LAW)
        if known is None:
            at, whose = self.quantity("02_depth_noise", name), whose + ", taken for a scale"
            scale, sigma = (1e-3 / LESSON_DISTANCE_M * v for v in (at.value, at.sigma or 0.0))
            mean, root = (scale, 0.0), np.array([[sigma], [0.0]])
        else:
            scale, offset = (found.quantities[number].value for number in known.names)
            mean, root = (scale, offset), scaled_root(np.array(known.matrix))
        rest = (True, tuple(map(tuple, root.tolist())), None if subtracted else mean)
        return ErrorTerm("depth bias", "bias", 0.0, SIGMAS, "depth", whose, *rest)

    def _intrinsics(self) -> ErrorTerm:
        """By the covariance of K and lens together, where there is one; else by the sigmas.

        Pessimistic where the same K was used for the hand-eye calibration, which takes up a part
        of its error.
        """
        known, whose = self._known("03_intrinsics"), self["03_intrinsics"].whose()
        root = scaled_root(np.array(known.matrix))
        factor = np.zeros((len(PARAMETERS), root.shape[1]))
        factor[[PARAMETERS.index(name) for name in known.names]] = root
        rows = tuple(map(tuple, factor.tolist()))
        return ErrorTerm("intrinsics", "bias", 0.0, SIGMAS, "intrinsics", whose, True, rows)

    def _hand_eye(self, mount: str) -> tuple[ErrorTerm, ErrorTerm]:
        """The root mean square over the three axes: a row knows no frame."""
        notebook, known = self["04_hand_eye"], self._known("04_hand_eye")
        fixed, of = notebook.result().eye_to_hand, notebook.result().quantities["tx"].note
        order = [known.names.index(name) for name in MOUNT_TWIST]
        variances = np.diag(known.matrix)[order] * np.repeat([math.radians(1.0), 1e-3], 3) ** 2
        if mount == STANDING and fixed is not None and fixed.covariance is not None:
            variances, of = np.diag(fixed.covariance), fixed.mount
        turn, shift = (SIGMAS * math.sqrt(part.mean()) for part in np.split(variances, 2))
        whose = notebook.whose() + f", {of.replace('_', ' ')}" * bool(of)
        return (
            ErrorTerm("hand-eye rotation", "bias", 0.0, turn, "turn", whose, normal=True),
            ErrorTerm("hand-eye translation", "bias", 0.0, shift, "shift", whose, normal=True),
        )

    def _arm(self) -> ErrorTerm:
        """From the touch test: rms over all directions of what arm and camera disagree by."""
        touched = self["04_hand_eye"].result().quantities.get("touch_mm")
        if touched is None:
            return lesson_terms(stated=False)[-1]
        high = SIGMAS * 1e-3 * touched.value / math.sqrt(3)
        whose = self["04_hand_eye"].whose() + ", touch test"
        return ErrorTerm("forward kinematics", "bias", 0.0, high, "shift", whose, normal=True)


def hand_over(reference: Path = REFERENCE) -> HandOver:
    """Read `results/01` to `04` where they are whole, else their reference, and say which.

    reference: the folder of the stand-ins. Raises nothing: a number that neither has is a
    ValueError when it is asked for.

    >>> [found.lesson for found in hand_over()]
    ['01_pinhole', '02_depth_noise', '03_intrinsics', '04_hand_eye']
    """
    return HandOver({lesson: _find(lesson, reference) for lesson in NEEDED})


def _find(lesson: str, reference: Path) -> NotebookResult:
    stand_in, comes_in = _stand_in(reference / f"{lesson}.json")
    yours, file = None, f"results/{lesson}.json"
    lacks: tuple[str, ...] = ()
    try:
        yours = results.load(lesson)
        want(yours.lesson == lesson, "lesson", yours.lesson, lesson)
        lacks = tuple(names for names in NEEDED[lesson] if not _usable(yours, lesson, names))
    except FileNotFoundError:
        yours, why = None, f"{file} is not there yet, notebook {lesson} has not saved it"
    except (ValueError, OSError) as error:
        again = "" if "again" in str(error) else f". Run notebook {lesson} again"
        yours, why = None, f"{file} cannot be used ({str(error).rstrip('.')}{again})"
    names = ", ".join(name.replace("|", " or ") for name in lacks)
    what = f"holds no {names}" + " with a sigma" * (lesson in BY_SIGMA)
    if lacks and lesson in TOGETHER:
        yours, why = None, f"{file} {what}"
    if yours is None:
        return NotebookResult(lesson, None, stand_in, f"{lesson}: {why}; {comes_in}.")
    if lacks == (BIAS,):
        comes_in = "the lesson's range stays"
    but = f", but it {what}: for that, {comes_in}" if lacks else ""
    whose = NotebookResult(lesson, yours, stand_in, "").whose()
    return NotebookResult(lesson, yours, stand_in, f"{lesson}: {whose}{but}.", lacks)


def _stand_in(path: Path) -> tuple[Result | None, str]:
    """The reference, and what becomes of the rows that need it."""
    try:
        return results.read(path), "the reference is used"
    except FileNotFoundError:
        return None, f"and there is no reference {path.name}"
    except ValueError as error:
        return None, f"and the reference is damaged ({error})"


def _usable(result: Result, lesson: str, names: str) -> bool:
    found = _first(result.quantities, names)
    return found is not None and (lesson not in BY_SIGMA or found.sigma is not None)


def _first(quantities: dict[str, Quantity], names: str) -> Quantity | None:
    """The number of this name; names: "a|b" is b where there is no a."""
    return next((quantities[name] for name in names.split("|") if name in quantities), None)
