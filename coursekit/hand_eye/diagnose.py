"""What is wrong with a hand-eye session: causes with their evidence and their remedy.

First what makes any fit meaningless (units, poses that hardly turn), then what readings of the same
numbers would make arm and camera agree (`misread`), then what the residuals speak for (`causes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from coursekit.arm import widowx
from coursekit.boards import Detections
from coursekit.words import Finding, Findings
from coursekit.hand_eye import causes, misread, mistakes
from coursekit.hand_eye.causes import Arms
from coursekit.hand_eye.closed_form import FEWEST
from coursekit.hand_eye.pairs import Fit, Pairs, robust_fit
from coursekit.hand_eye.poses import camera_board, mean_pose
from coursekit.hand_eye.session import HandEyeSession

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from coursekit.arm import Arm, ArmErrors
    from coursekit.boards import Board, Detection
    from coursekit.geometry import Intrinsics
    from coursekit.hand_eye.poses import Mount

    Floats = NDArray[np.float64]

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
    if len(session) < FEWEST:
        raise ValueError(f"session: has {len(session)} pairs, want at least {FEWEST}")
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
            self.found.append(mistakes.millimetres(sides, "; ".join(evidence), given, after))

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
        self.found.append(mistakes.degrees(
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
            self.found.append(mistakes.pure_translation(largest))
        elif turns[0] < SMALL_DEG:
            self.found.append(mistakes.small_rotations(turns, largest))
        elif turns[1] < SINGLE_DEG:
            self.found.append(mistakes.single_axis(turns, axis))
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
            self.found.append(mistakes.off_by_one(better[0], given))
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
            self.found.append(mistakes.inconsistent(options, given, better[0].fit))
        elif given.turn_rad > POOR_RAD:
            self._rotations(given)
        elif given.shift_m < POOR_M:
            asked, *others = misread.declared(given, *self._view())
            others = [other for other in others if not other.against]
            if asked.against and others:
                self.found.append(mistakes.exchanged(asked, others))

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
            self.found.append(mistakes.rotations(side, places, fit, reading))
            mended = reading.fit.pairs.T_base_gripper
            if side == "arm":
                self.pairs = replace(self.pairs, T_base_gripper=mended)
            else:
                self.pairs = replace(self.pairs, T_camera_board=mended)
            return
        if given.turn_rad > HOPELESS_RAD:
            self.hopeless = True
            self.found.append(mistakes.nothing_fits(given))

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
        self.found += mistakes.from_residuals(state, self.session)
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
    from coursekit.arm import pose_difference

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
