"""The findings of `diagnose` in words: what is wrong, the figures, the remedy.

What is wrong with a hand-eye session: causes with their evidence and their remedy.

First what makes any fit meaningless (units, poses that hardly turn), then what readings of the same
numbers would make arm and camera agree (`misread`), then what the residuals speak for (`causes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from coursekit.arm import Arm, ArmErrors, pose_difference, widowx
from coursekit.arrays import ArrayLike, Floats
from coursekit.boards import Board, Detection, Detections
from coursekit.geometry import Intrinsics
from coursekit.hand_eye import causes, misread
from coursekit.hand_eye.causes import Accepted, Arms, Search
from coursekit.hand_eye.closed_form import FEWEST_POSES
from coursekit.hand_eye.misread import Reading
from coursekit.hand_eye.pairs import Fit, Pairs, robust_fit
from coursekit.hand_eye.poses import Mount, camera_board, mean_pose
from coursekit.hand_eye.session import HandEyeSession
from coursekit.words import Finding, Findings


def _change(given: Fit, suspected: Fit) -> str:
    """The typical disagreement of arm and camera, before and after."""
    return f"arm and camera disagree by {given.says()} as given, by {suspected.says()} as suspected"


def millimetres(sides: list[str], evidence: str, given: Fit, suspected: Fit) -> Finding:
    """Translations of one side or both in another unit."""
    whose = " and ".join(f"the {side}'s" for side in sides)
    return Finding(
        "millimetres",
        f"{_first_upper(whose)} translations are off by a factor of 1,000: metres are wanted, and "
        "millimetres were given (or metres divided once too often).",
        f"{evidence}. {_sentence(_change(given, suspected))}",
        f"Convert {whose} translations where they come in (for the board: give square_m in "
        "metres), and keep metres inside the program.",
    )


def degrees(evidence: str, given: Fit, suspected: Fit, reading: str = "") -> Finding:
    """Degrees taken as radians, or the other way round."""
    how = f" (suspected: {reading})" if reading else ""
    return Finding(
        "degrees",
        "Angles are in one unit and were taken as the other: degrees and radians.",
        f"{evidence}. {_first_upper(_change(given, suspected))}{how}",
        "Look in the driver's manual which unit it gives and convert where the number comes in: "
        "np.radians(angle), or Rotation.from_euler(..., degrees=True).",
    )


def pure_translation(largest: float) -> Finding:
    """Poses that never turn; largest: the largest turn, deg."""
    return Finding(
        "pure_translation",
        "The gripper never turns: with R_A = 1 the mount's translation drops out of the equation.",
        f"the largest turn between two poses is {largest:.2f} deg; t_X is free in all directions, "
        "whatever the number of poses (the shifts do determine R_X)",
        "Turn the wrist by 30 deg or more to either side about two axes; 15 such poses are enough.",
    )


def small_rotations(turns: Floats, largest: float) -> Finding:
    """Poses that turn by a few degrees; turns (3,) rms, deg."""
    return Finding(
        "small_rotations",
        "The gripper turns so little that noise decides where the camera is.",
        f"turned by {turns[0]:.1f}, {turns[1]:.1f} and {turns[2]:.1f} deg (rms) about three axes, "
        f"at most {largest:.0f} deg between two poses",
        "Turn the wrist by 30 deg or more to either side about two axes: the error of t_X goes "
        "with one over the angle.",
    )


def single_axis(turns: Floats, axis: Floats) -> Finding:
    """Poses that turn about one axis (3,) in the base."""
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    text = "({:.2f}, {:.2f}, {:.2f})".format(*(axis + 0.0))
    return Finding(
        "single_axis",
        "All poses turn about one axis: translation along it is free, rotation about it nearly.",
        f"turned by {turns[0]:.1f} deg (rms) about {text} in the base, by {turns[1]:.1f} deg about "
        "any other axis",
        "Turn the wrist about a second axis across this one, by 30 deg or more to either side.",
    )


def off_by_one(best: Reading, given: Fit) -> Finding:
    """Images with the arm pose of another image."""
    return Finding(
        "off_by_one",
        f"Arm poses and images are paired wrongly: each image belongs to {best.says}.",
        _change(given, best.fit),
        "Store pose and image together when they are taken, under one number. In these data shift "
        "one list against the other, and drop what is left over at the ends; look for an image "
        "that was skipped.",
    )


def inconsistent(options: list[misread.Candidate], given: Fit, suspected: Fit) -> Finding:
    """Arm poses, board poses or the mount the other way round, with the candidates."""
    left = [option for option in options if not option.against]
    if len(left) == 1:
        choice = f"Only one is plausible: {left[0].name}."
    elif left:
        names = " or ".join(option.name for option in left)
        choice = f"The data do not decide between {names}"
        same = [option for option in left if option.mount == options[0].mount]
        speaks = "; the declared mount speaks for the former" if len(same) == 1 else ""
        choice += f"{speaks}."
    else:
        choice = "None of them looks plausible; look at the units and at the frames."
    return Finding(
        "inconsistent_convention",
        "Arm poses, board poses or the mount are the other way round: one of three mistakes that "
        "obey the same equation.",
        f"{_change(given, suspected)}. Candidates: "
        + "; ".join(f"({n}) {option.says()}" for n, option in enumerate(options, 1))
        + f". {choice}",
        "T_base_gripper takes gripper coordinates to base coordinates: its translation is where "
        "the gripper is in the base. T_camera_board's translation has a positive z, the distance. "
        "Check both on one pose, and the mount.",
    )


def rotations(side: str, places: misread.Places, given: Fit, reading: Reading) -> Finding:
    """Rotations of one side in another convention or unit."""
    evidence = (
        f"the {side}'s positions agree with the other side (within {1e3 * places.gap_m:.1f} mm), "
        "its rotations do not"
    )
    if reading.name == "degrees":
        return degrees(evidence, given, reading.fit, reading.says)
    return Finding(
        "inconsistent_convention",
        f"The {side}'s rotations follow another convention than they are read by.",
        f"{evidence}. {_sentence(_change(given, reading.fit))} Suspected: {reading.says}",
        "Look in the driver's manual for the order of the quaternion or of the Euler angles, and "
        "check one pose with your eyes: where does the gripper's x axis point?",
    )


def exchanged(asked: misread.Candidate, others: list[misread.Candidate]) -> Finding:
    """Two mistakes that cancel in the equation and put the camera where none can be."""
    listed = "; ".join(f"({n}) {option.says()}" for n, option in enumerate(others, 1))
    return Finding(
        "inconsistent_convention",
        "Arm and camera agree, but on a camera that cannot be where this says: two things are the "
        "other way round, and cancel in the equation.",
        f"{asked.says()}. Candidates: {listed}",
        "T_base_gripper takes gripper coordinates to base coordinates: its translation is where "
        "the gripper is in the base. T_camera_board's translation has a positive z, the distance. "
        "Check both on one pose, and the mount.",
    )


def nothing_fits(given: Fit) -> Finding:
    """Arm and camera that no reading brings together."""
    return Finding(
        "inconsistent_convention",
        "Arm and camera contradict each other, and no reading that was tried makes them agree.",
        f"with the best X they disagree by {given.says()} in a typical pose; tried: pairs shifted "
        "by one or two, either side inverted, degrees, orders of quaternions and of Euler angles",
        "Check that pose and image belong together (sorted by name or by number?), that the board "
        "and the camera are the right ones, and what frames and units the driver gives.",
    )


def _sentence(text: str) -> str:
    return _first_upper(text) + "."


def _first_upper(text: str) -> str:
    return text[0].upper() + text[1:]


def from_residuals(state: Search, session: HandEyeSession) -> list[Finding]:
    """The accepted causes as findings, outliers together in one."""
    write = {causes.SCALE: _scale, causes.LATE: _late, causes.SLIP: _slip, causes.OFFSET: _offset}
    found = []
    odd = [one for one in state.accepted if one.test.cause == causes.OUTLIER]
    for one in state.accepted:
        if one.test.cause in write:
            found.append(write[one.test.cause](one, state, session))
        elif one is odd[0]:
            found.append(_outliers(odd, session))
    return found


def _scale(one: Accepted, state: Search, session: HandEyeSession) -> Finding:
    half = 1.96 * one.test.sigma
    size = ""
    if session.board is not None:
        square = 1e3 * session.board.square_m
        size = f": squares of {state.scale * square:.2f} mm, not {square:.2f} mm"
    return Finding(
        causes.SCALE,
        "The board is not as large as it says, so the camera's distances are off by that factor.",
        f"with the size left free the board is {state.scale:.4f} ± {half:.4f} (95 %) times as "
        f"large{size}. {_sentence(_change(one.before, one.after))}",
        "Measure ten squares of the print with a caliper and give their size to the board; print "
        "at 100 %, not fitted to the page.",
        one.test.p_value,
    )


def _late(one: Accepted, state: Search, session: HandEyeSession) -> Finding:
    delay, half = 1e3 * state.delay_s, 1.96e3 * one.test.sigma
    when = "after" if delay > 0 else "before"
    return Finding(
        causes.LATE,
        f"The arm's poses were read {when} the images were taken, while the arm moved.",
        f"{abs(delay):.1f} ± {half:.1f} ms (95 %) {when} the image. "
        + _sentence(_change(one.before, one.after)),
        "Let the arm stop before each image (half a second), or give pose and image the time "
        "stamps of their own devices and interpolate the poses.",
        one.test.p_value,
    )


def _slip(one: Accepted, state: Search, session: HandEyeSession) -> Finding:
    turn, shift = np.linalg.norm(one.test.size[:3]), np.linalg.norm(one.test.size[3:])
    return Finding(
        causes.SLIP,
        "The board (or the camera's mount) moved once during the session: before and after it are "
        "two calibrations.",
        f"from {session.names[one.view]} on the board is {1e3 * shift:.1f} mm and "
        f"{np.degrees(turn):.2f} deg from where it was. "
        + _sentence(_change(one.before, one.after)),
        "Fasten board and camera and take the session again; or use only the longer part.",
        one.test.p_value,
    )


def _offset(one: Accepted, state: Search, session: HandEyeSession) -> Finding:
    joint = one.test.at
    size, half = np.degrees(state.offsets[joint]), np.degrees(1.96 * one.test.sigma)
    return Finding(
        causes.OFFSET,
        f"The zero of joint_{joint} is off, so the arm is not where its joint angles say.",
        f"{size:+.2f} ± {half:.2f} deg (95 %) to be added to joint_{joint}. "
        + _sentence(_change(one.before, one.after)),
        "Set the joint's zero with the maker's jig; or estimate the offsets together with X "
        "(`solve(free_offsets=True)`) and use them wherever the arm's pose is computed.",
        one.test.p_value,
    )


def _outliers(odd: list[Accepted], session: HandEyeSession) -> Finding:
    names = []
    for one in odd:
        turn, shift = np.linalg.norm(one.test.size[:3]), np.linalg.norm(one.test.size[3:])
        names.append(
            f"{session.names[one.view]} ({1e3 * shift:.0f} mm, {np.degrees(turn):.1f} deg)"
        )
    return Finding(
        causes.OUTLIER,
        "One pair of arm pose and image or a few do not fit the others.",
        f"{', '.join(names)} off where the other pairs put the board; those disagree by "
        f"{odd[-1].after.says()}",
        "Look at the image (blurred, board cut off, still swinging?) and at the row of the table "
        "(two rows exchanged?); leave the pair out, or take it again after the arm has stopped.",
        odd[0].test.p_value,
    )


FAR = 10.0  # no arm reaches 10 m and no board is seen at 10 m: such a number is in millimetres
NEAR = 2e-3  # nor do either stay within 2 mm: metres had been divided by 1,000
# The typical (rms) turn about each principal axis. A wrist that turns +-30 deg makes 15 to 20.
STILL_DEG, SMALL_DEG, SINGLE_DEG = 0.5, 6.0, 4.0
AS_COMPUTED_M = 1e-3  # a pose is that of the joint angles given with it, within rounding
POOR_RAD, POOR_M = np.radians(2.0), 0.02  # residuals that no working arm has
HOPELESS_RAD = np.radians(10.0)  # beyond any slip, delay or wrong zero
STEP_M, STEP_RAD = 0.1, np.radians(20.0)  # between images, for velocities from positions

LOOKED_FOR = (
    "millimetres for metres", "degrees for radians",
    "poses that do not turn, or about one axis, or by a few degrees",
    "images with the arm pose of another image",
    "inverted arm poses, inverted detections or another mount", "late time stamps",
    "a board that slipped", "single poses that are off", "a wrong square size",
    "a joint whose zero is off",
)  # fmt: skip
MOTION_UNSEEN = (
    "late time stamps; that takes an arm that moves, with joint velocities (dq) or the times of "
    "images taken in short steps."
)
JOINTS_UNSEEN = (
    "the zeros of the joints, which takes joint angles (q). The arm's errors are taken as "
    "independent from pose to pose, so a scale under 2 % is not told from them."
)
DESIGN_UNSEEN = "everything else; poses like these leave X free, and with it the residuals."
RESIDUALS_UNSEEN = (
    "late time stamps, slips, single poses, squares and joints; they are judged by small residuals."
)
FEW_UNSEEN = f"causes in the residuals; that takes {causes.FEWEST} pairs or more."


def diagnose(
    session: HandEyeSession | ArrayLike,
    seen: Sequence[Detection] | ArrayLike | None = None,
    mount: Mount | None = None,
    *,
    board: Board | None = None,
    intrinsics: Intrinsics | None = None,
    arm: Arm | None = None,
    errors: ArmErrors | None = None,
) -> Findings:
    """What is wrong with a session, the gravest first; empty when nothing is.

    session: a `HandEyeSession`, or T_base_gripper (n, 4, 4) with `seen` (detections or
    T_camera_board), the mount, and for detections the board and the intrinsics. arm: whose joint
    angles the session has, the WidowX unless given; errors: what is normal for it, the sizes of
    `ArmErrors` unless given.
    A healthy session gets a finding in at most 2 of 100 cases. Raises ValueError as `solve` for
    input that no solver takes.
    """
    if not isinstance(session, HandEyeSession):
        session = _session(session, seen, mount, board, intrinsics)
    if len(session) < FEWEST_POSES:
        raise ValueError(f"session: has {len(session)} pairs, want at least {FEWEST_POSES}")
    case = _Case(session, arm or widowx(), errors, Pairs.of(session))
    case.units()
    case.joints_in_degrees()
    if case.design():
        return case.findings(DESIGN_UNSEEN)
    case.readings()
    case.ambiguous_boards()
    if len(case.pairs) < causes.FEWEST:
        return case.findings(FEW_UNSEEN)
    if case.hopeless:
        return case.findings(RESIDUALS_UNSEEN)
    return case.residuals()


def _session(
    T_base_gripper: ArrayLike,
    seen: Sequence[Detection] | ArrayLike | None,
    mount: Mount | None,
    board: Board | None,
    intrinsics: Intrinsics | None,
) -> HandEyeSession:
    if seen is None or mount is None:
        raise ValueError("seen, mount: arm poses alone are no session; give both")
    if isinstance(seen, (list, tuple)) and seen and hasattr(seen[0], "pixels"):
        seen = Detections(seen)
    poses = np.asarray(T_base_gripper, float)
    return HandEyeSession(mount, poses, seen, board, intrinsics)  # type: ignore[arg-type]


@dataclass(eq=False)
class _Case:
    """A session under examination: its pairs with the mistakes found so far put right."""

    session: HandEyeSession
    arm: Arm
    errors: ArmErrors | None
    pairs: Pairs
    found: list[Finding] = field(default_factory=list)
    q: Floats | None = None
    hopeless: bool = False

    def __post_init__(self) -> None:
        self.q = self.session.q

    def findings(self, *unseen: str) -> Findings:
        """What was found, with what could not be tested."""
        return Findings(self.found, LOOKED_FOR, unseen)

    # --- units ---

    def units(self) -> None:
        """Millimetres, by size alone: neither an arm nor a camera reaches 10 m."""
        given, sides, evidence = robust_fit(self.pairs), [], []
        for side, what, name in (
            ("arm", "the gripper is", "T_base_gripper"),
            ("camera", "the board is seen", "T_camera_board"),
        ):
            far = float(np.median(np.linalg.norm(getattr(self.pairs, name)[:, :3, 3], axis=1)))
            factor = 1e-3 if far > FAR else 1e3 if far < NEAR else 1.0
            if factor != 1.0:
                arm = side == "arm"
                self.pairs = self.pairs.arm_scaled(factor) if arm else self.pairs.scaled(factor)
                sides.append(side)
                evidence.append(f"typically {what} {far:.4g} m away")
        if sides:
            after = robust_fit(self.pairs)
            self.found.append(millimetres(sides, "; ".join(evidence), given, after))

    def joints_in_degrees(self) -> None:
        """Degrees in q, by size alone; and the arm poses that were computed from them."""
        if self.q is None or np.abs(self.q).max() <= 2 * np.pi:
            return
        given = robust_fit(self.pairs)
        largest, computed = float(np.abs(self.q).max()), self.arm.forward(self.q)
        self.q = np.radians(self.q)
        suspected = given
        if np.abs(computed - self.pairs.T_base_gripper).max() < AS_COMPUTED_M:
            self.pairs = replace(self.pairs, T_base_gripper=self.arm.forward(self.q))
            suspected = robust_fit(self.pairs)
        self.found.append(degrees(
            f"joint angles up to {largest:.0f}, where no joint turns by more than {2 * np.pi:.1f}",
            given, suspected,
        ))  # fmt: skip

    # --- poses ---

    def design(self) -> bool:
        """Whether the poses leave X free, which is then a finding."""
        turns, axis, largest = _turns(self.pairs.T_base_gripper)
        seen = _turns(self.pairs.T_camera_board)[0]
        if seen[0] > SMALL_DEG and seen[0] > 5 * turns[0]:
            return False  # the camera saw larger turns than the arm tells of: a matter of units
        if turns[0] < STILL_DEG:
            self.found.append(pure_translation(largest))
        elif turns[0] < SMALL_DEG:
            self.found.append(small_rotations(turns, largest))
        elif turns[1] < SINGLE_DEG:
            self.found.append(single_axis(turns, axis))
        else:
            return False
        return True

    # --- readings ---

    def readings(self) -> None:
        """Another pairing, convention or unit of angles with which arm and camera agree."""
        given = robust_fit(self.pairs)
        other = misread.other_pairing(self.pairs)
        better = misread.better_readings(given, other, misread.MENDED)
        if better and better[0].name.startswith("off_by_one"):
            self.found.append(off_by_one(better[0], given))
            self.pairs = better[0].fit.pairs
        elif better:
            options = misread.candidates(better[0].fit, *self._view())
            self.pairs = better[0].fit.pairs
            if self._computed_from_joints():
                against = (*options[0].against, "the arm poses are those of the joint angles")
                options[0] = replace(options[0], against=against)
                # The same equation, with arm poses that still belong to their joint angles.
                self.pairs = replace(
                    self.pairs, T_base_gripper=given.pairs.T_base_gripper, mount=_other(given)
                )
            self.found.append(inconsistent(options, given, better[0].fit))
        elif given.turn_rad > POOR_RAD:
            self._rotations(given)
        elif given.shift_m < POOR_M:
            asked, *others = misread.declared(given, *self._view())
            others = [other for other in others if not other.against]
            if asked.against and others:
                self.found.append(exchanged(asked, others))

    def _view(self) -> tuple[Floats, Floats | None, bool]:
        """The board's middle, half the field of view as tangents, whether images were given."""
        board, lens = self.session.board, self.session.intrinsics
        middle = np.zeros(3) if board is None else board.points.mean(axis=0)
        limit = None
        if lens is not None:
            limit = 1.1 * np.array([lens.width / lens.fx, lens.height / lens.fy]) / 2
        return middle, limit, self.session.detections is not None

    def _computed_from_joints(self) -> bool:
        """Whether the session's arm poses are those of its joint angles."""
        if self.q is None:
            return False
        off = self.arm.forward(self.q) - self.session.T_base_gripper
        return bool(np.abs(off).max() < AS_COMPUTED_M)

    def _rotations(self, given: Fit) -> None:
        """Rotations of one side that contradict the other although the positions agree."""
        sides = [("arm", self.pairs)]
        if self.session.detections is None:
            sides.append(("camera", self.pairs.exchanged()))
        for side, pairs in sides:
            places = misread.places(pairs)
            if not places.agree:
                continue
            fit = robust_fit(pairs)
            other = misread.other_rotations(pairs)
            better = misread.better_readings(fit, other, misread.KEPT)
            reading = better[0] if better else misread.undo_degrees(fit, places.expected)
            if reading is None:
                continue
            self.found.append(rotations(side, places, fit, reading))
            mended = reading.fit.pairs.T_base_gripper
            if side == "arm":
                self.pairs = replace(self.pairs, T_base_gripper=mended)
            else:
                self.pairs = replace(self.pairs, T_camera_board=mended)
            return
        if given.turn_rad > HOPELESS_RAD:
            self.hopeless = True
            self.found.append(nothing_fits(given))

    # --- residuals ---

    def ambiguous_boards(self) -> None:
        """Of the two poses that an image may allow, the one that the arm expects."""
        boards = self.session.board_poses
        if not any(pose.ambiguous for pose in boards):
            return
        fit = robust_fit(self.pairs)
        expected = camera_board(self.pairs.T_base_gripper, fit.X, fit.Y[0], self.pairs.mount)
        chosen = self.pairs.T_camera_board.copy()
        for row, view in enumerate(self.pairs.view):
            other = boards[view].other
            if other is None or not np.allclose(chosen[row], boards[view].T_camera_board):
                continue
            both = np.stack([chosen[row], other])
            match = np.einsum("kij,ij->k", both[:, :3, :3], expected[row, :3, :3])
            chosen[row] = both[match.argmax()]
        self.pairs = replace(self.pairs, T_camera_board=chosen)

    def residuals(self) -> Findings:
        """Causes that the residuals speak for."""
        q = self.q if self._belongs() else None
        velocity = self._velocity(q)
        arms = Arms(self.arm, self.errors, q, velocity)
        state = causes.search(self.pairs, arms, robust_fit(self.pairs))
        self.found += from_residuals(state, self.session)
        unseen = [MOTION_UNSEEN] if velocity is None else []
        return self.findings(*unseen, *([JOINTS_UNSEEN] if q is None else []))

    def _belongs(self) -> bool:
        """Whether the joint angles explain the arm poses, so that they tell of the arm's errors."""
        if self.q is None:
            return False
        off = self.arm.forward(self.q[self.pairs.row]) - self.pairs.T_base_gripper
        return bool(np.abs(off).max() < 10 * AS_COMPUTED_M)

    def _velocity(self, q: Floats | None) -> Floats | None:
        """The gripper's twist rates (n, 6) of the session's views, None where unknown."""
        if q is not None and self.session.dq is not None:
            rates = self.arm.jacobian(q) @ self.session.dq[..., None]
            return np.asarray(rates[..., 0])
        if self.session.times is None:
            return None
        return _by_differences(self.session.T_base_gripper, self.session.times)


def _other(fit: Fit) -> Mount:
    return "eye_to_hand" if fit.pairs.mount == "eye_in_hand" else "eye_in_hand"


def _by_differences(T: Floats, times: Floats) -> Floats | None:
    """Twist rates (n, 6) of poses in short steps, by central differences; None for long steps."""

    step = pose_difference(T[:-1], T[1:])
    if not (np.diff(times) > 0).all():
        return None
    shift, turn = np.linalg.norm(step[:, 3:], axis=1), np.linalg.norm(step[:, :3], axis=1)
    if np.median(shift) > STEP_M or np.median(turn) > STEP_RAD:
        return None
    rates = step / np.diff(times)[:, None]
    return np.concatenate([rates[:1], (rates[1:] + rates[:-1]) / 2, rates[-1:]])


def _turns(T: Floats) -> tuple[Floats, Floats, float]:
    """Rms turns (3,) about the principal axes, deg; the first axis (3,); the largest turn, deg."""
    from scipy.spatial.transform import Rotation

    R = mean_pose(T)[:3, :3].T @ T[:, :3, :3]
    vectors = np.degrees(Rotation.from_matrix(R).as_rotvec())
    _, values, axes = np.linalg.svd(vectors, full_matrices=False)
    i, j = np.triu_indices(len(T), 1)
    cosine = (np.einsum("nij,nij->n", T[i, :3, :3], T[j, :3, :3]).min() - 1) / 2
    axis = mean_pose(T)[:3, :3] @ axes[0]
    return values / np.sqrt(len(T)), axis, float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
