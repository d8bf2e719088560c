"""Which directions of X a set of arm poses determines, and which it leaves free.

What `solve` is given, checked.

What `solve` returns: where the camera is, how well that is known, and what is left over.

Whether a hand-eye result is good: poses that were held out, a verdict in words, the printout.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from coursekit.arm import Arm, FkErrors, pose_difference
from coursekit.arrays import ArrayLike, Floats, NDArray
from coursekit.boards import Board, Detection, Detections
from coursekit.geometry import Intrinsics, cross_matrix, invert_transform
from coursekit.hand_eye.closed_form import FEWEST, closed_form, stand_board
from coursekit.hand_eye.poses import (
    FRAMES,
    Mount,
    camera_board,
    carrier_stand,
    check_mount,
    check_one,
    check_poses,
    mean_pose,
    same_number,
)
from coursekit.hand_eye.refinement import (
    TWIST,
    BoardPose,
    PixelViews,
    PoseViews,
    Problem,
    Refined,
    arm_poses_with,
    board_poses,
    by_X_and_Y,
)

ROTATION_RAD, POSITION_M = np.radians(0.1), 0.5e-3  # what a pair of pose and image scatters by
LEVER_M = 0.3  # a rotation of X counts by what it does this far in front of the camera
FREE_M = 0.03  # a direction known no better than this is free: nobody would mount a camera so
TURN_DEG = 10.0  # rms about an axis from which that axis counts as turned about


@dataclass(frozen=True, eq=False, repr=False)
class Observability:
    """What the poses determine of X.

    singular_values (6,): of the linearised problem, descending, 1/m: one over the standard
    deviation with which X comes out along each direction. directions (6, 6): rows (omega, v), the
    directions in the frame that X is given in, rotations measured by what they do at `LEVER_M`.
    free: the undetermined ones, in words. turns_deg (3,): rms rotation between poses about the
    principal axes (rows of axes (3, 3), same frame). largest_turn_deg: between any two poses.
    """

    singular_values: Floats
    directions: Floats
    free: tuple[str, ...]
    turns_deg: Floats
    axes: Floats
    largest_turn_deg: float
    poses: int

    @property
    def sigma_mm(self) -> Floats:
        """Standard deviation along each direction, mm, ascending; infinite if nothing is known."""
        with np.errstate(divide="ignore"):
            return 1e3 / self.singular_values

    @property
    def determined(self) -> bool:
        """Whether all six directions are."""
        return not self.free

    @property
    def axes_turned(self) -> int:
        """About how many axes the poses turn."""
        return int(np.sum(self.turns_deg > TURN_DEG))

    def __repr__(self) -> str:
        turns = ", ".join(f"{turn:.1f}" for turn in self.turns_deg)
        sigmas = ", ".join(_size(sigma) for sigma in self.sigma_mm)
        lines = [
            f"{self.poses} poses, turned by {turns} deg (rms) about three axes, at most "
            f"{self.largest_turn_deg:.0f} deg between two",
            f"X would be known to {sigmas} mm (1 sigma, its six directions)",
            "All of X is determined." if self.determined else "NOT determined: "
            + "; ".join(self.free) + ".",
        ]  # fmt: skip
        return "\n".join(textwrap.fill(line, 88, subsequent_indent="  ") for line in lines)


def observability(
    T_base_gripper: ArrayLike,
    mount: Mount,
    X: ArrayLike | None = None,
    Y: ArrayLike | None = None,
    rotation_rad: float = ROTATION_RAD,
    position_m: float = POSITION_M,
) -> Observability:
    """What arm poses (n, 4, 4) determine of X, before any solver runs.

    rotation_rad, position_m: by how much one pair of arm pose and image scatters. X, Y (4, 4):
    where camera and board roughly are; without them the camera is taken to sit at its carrier's
    origin, and the board where it is nearest to it. They change how well X is determined and where
    an axis lies, not which directions are free. Raises ValueError for poses that are none.
    """
    poses = check_poses("T_base_gripper", T_base_gripper, 2)
    check_mount(mount)
    for name, size in (("rotation_rad", rotation_rad), ("position_m", position_m)):
        if not size > 0:
            raise ValueError(f"{name}: got {size!r}, want a positive standard deviation")
    X = np.eye(4) if X is None else check_one("X", X)
    Y = _nearest_stand(poses, mount, X) if Y is None else check_one("Y", Y)
    root = known_of_X(poses, mount, X, Y, rotation_rad, position_m)
    _, values, directions = np.linalg.svd(root / units())
    values = np.where(values < 1e-9 * values[0], 0.0, values)
    weak = directions[values * FREE_M < 1.0] / units()
    turns, axes = _diversity(poses, mount)
    return Observability(
        values, directions / units(), tuple(_in_words(weak)), turns, axes,
        _largest_turn(poses), len(poses),
    )  # fmt: skip


def units() -> Floats:
    """What turns (omega, v) into metres, (6,): omega acts at `LEVER_M`."""
    return np.array([LEVER_M, LEVER_M, LEVER_M, 1.0, 1.0, 1.0])


def known_of_X(
    poses: Floats, mount: Mount, X: Floats, Y: Floats, rotation_rad: float, position_m: float
) -> Floats:
    """The Jacobian (6n, 6) of the scaled residuals by X, what Y can imitate taken out."""
    rows = by_X_and_Y(poses, X, Y, mount) / np.repeat([rotation_rad, position_m], 3)[:, None]
    rows = rows.reshape(-1, 12)
    by_X, by_Y = rows[:, :6], rows[:, 6:]
    q, _ = np.linalg.qr(by_Y)
    return by_X - q @ (q.T @ by_X)


def _nearest_stand(poses: Floats, mount: Mount, X: Floats) -> Floats:
    """Y with the board where, over all poses, it is nearest to the camera."""
    M = carrier_stand(poses, mount)
    Y = np.eye(4)
    rows, right = M[:, :3, :3].reshape(-1, 3), (X[:3, 3] - M[:, :3, 3]).ravel()
    Y[:3, 3] = np.linalg.lstsq(rows, right, rcond=None)[0]
    return Y


def _diversity(poses: Floats, mount: Mount) -> tuple[Floats, Floats]:
    """Rms rotation about the principal axes, deg, in the carrier's frame, and those axes.

    Each pose against the mean pose; about the carrier's axes, because X is given there.
    """
    from scipy.spatial.transform import Rotation

    M = carrier_stand(poses, mount)
    turns = Rotation.from_matrix(M[:, :3, :3] @ mean_pose(M)[:3, :3].T).as_rotvec()
    _, values, axes = np.linalg.svd(turns, full_matrices=True)
    full = np.zeros(3)
    full[: len(values)] = values
    return np.degrees(full) / np.sqrt(len(poses)), axes


def _largest_turn(poses: Floats) -> float:
    i, j = np.triu_indices(len(poses), 1)
    cosines = (np.einsum("nij,nij->n", poses[i, :3, :3], poses[j, :3, :3]) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosines.min(), -1.0, 1.0))))


# --- words ---


def _in_words(weak: Floats) -> list[str]:
    """Free directions, rows (omega, v) (k, 6), as phrases."""
    if not len(weak):
        return []
    scaled = weak * units()
    # Turns: the span of the omegas. Pure shifts: combinations of the rows whose omega vanishes.
    u, turns, axes = np.linalg.svd(scaled[:, :3])
    turning = int(np.sum(turns > 0.05))
    shifts = (u.T @ scaled)[turning:, 3:]
    rank = 0
    if len(shifts):
        _, sizes, along = np.linalg.svd(shifts)
        rank = int(np.sum(sizes > 0.05))
    words = []
    if turning:
        words.append(f"rotation about {_named(axes[:turning], 'axis', 'axes')} is free")
    if rank:
        words.append(f"translation along {_named(along[:rank], 'axis', 'axes')} is free")
    return words


def _named(axes: Floats, one: str, many: str) -> str:
    if len(axes) == 3:
        return f"all {many}"
    if len(axes) == 2:
        normal = np.cross(axes[0], axes[1])
        return f"all {many} across {_vector(normal)}"
    return f"the common {one} {_vector(axes[0])}"


def _vector(axis: Floats) -> str:
    axis = axis / np.linalg.norm(axis) * np.sign(axis[np.argmax(np.abs(axis))])
    parts = [0.0 if abs(part) < 0.005 else part for part in axis]
    return "(" + ", ".join(f"{part:.2f}".rstrip("0").rstrip(".") for part in parts) + ")"


def _size(sigma_mm: float) -> str:
    return "unknown" if not np.isfinite(sigma_mm) or sigma_mm > 1e4 else f"{sigma_mm:.2g}"


@dataclass(frozen=True, eq=False)
class HandEyeData:
    """Checked input. T_camera_board (n, 4, 4): measured, from the images where there are any."""

    T_base_gripper: Floats
    T_camera_board: Floats
    mount: Mount
    poses: tuple[BoardPose, ...] = ()
    detections: Sequence[Detection] | None = None
    board: Board | None = None
    intrinsics: Intrinsics | None = None
    arm: Arm | None = None
    q: Floats | None = None
    fk: FkErrors | None = None

    @classmethod
    def of(
        cls,
        T_base_gripper: ArrayLike,
        seen: Sequence[Detection] | ArrayLike,
        mount: Mount,
        board: Board | None,
        intrinsics: Intrinsics | None,
        arm: Arm | None = None,
        q: ArrayLike | None = None,
        fk: FkErrors | None = None,
        at_least: int = FEWEST,
    ) -> HandEyeData:
        """The input, or the ValueError that says what is wrong with it."""
        arm_poses = check_poses("T_base_gripper", T_base_gripper, at_least)
        n = len(arm_poses)
        joints = _joints(arm, q, n)
        if fk is not None and fk.each.shape != (n, 6, 6):
            raise ValueError(f"fk: has {fk.each.shape}, want ({n}, 6, 6), one for each arm pose")
        if not _are_detections(seen):
            measured = check_poses("seen", seen, at_least)  # type: ignore[arg-type]
            same_number(n, len(measured))
            return cls(arm_poses, measured, mount, arm=arm, q=joints, fk=fk)
        if board is None or intrinsics is None:
            missing = "board" if board is None else "intrinsics"
            raise ValueError(f"{missing}: got None; detections need the board and the intrinsics")
        same_number(n, len(seen))  # type: ignore[arg-type]
        poses = board_poses(seen, board, intrinsics)  # type: ignore[arg-type]
        measured = np.stack([pose.T_camera_board for pose in poses])
        return cls(
            arm_poses, measured, mount, tuple(poses), seen, board, intrinsics, arm, joints, fk,  # type: ignore[arg-type]
        )  # fmt: skip

    def by_closed_form(
        self, method: str, guess: ArrayLike | None
    ) -> tuple[Floats, Floats, HandEyeData]:
        """X and Y; where an image allows two poses of the board the data keep the one that fits."""
        measured = self.T_camera_board
        for _ in range(2):
            if guess is not None:
                X = check_one("guess", guess)
                Y = mean_pose(stand_board(self.T_base_gripper, measured, X, self.mount))
            else:
                X, Y = closed_form(self.T_base_gripper, measured, self.mount, method)
            chosen = self._that_fit(X, Y)
            if chosen is measured or np.array_equal(chosen, measured):
                break
            measured = chosen
        return X, Y, replace(self, T_camera_board=measured)

    def _that_fit(self, X: Floats, Y: Floats) -> Floats:
        expected = camera_board(self.T_base_gripper, X, Y, self.mount)
        chosen = self.T_camera_board.copy()
        for index, pose in enumerate(self.poses):
            if pose.other is None:
                continue
            both = np.stack([pose.T_camera_board, pose.other])
            turns = np.linalg.norm(pose_difference(expected[index], both)[:, :3], axis=1)
            chosen[index] = both[np.argmin(turns)]
        return chosen

    def problem(self, free_scale: bool) -> Problem:
        """What the refinement works on."""
        if self.detections is None:
            views: PixelViews | PoseViews = PoseViews(self.T_camera_board, np.zeros((0, 6, 6)))
        else:
            assert self.board is not None
            assert self.intrinsics is not None
            views = PixelViews.of(
                self.detections, self.board, self.intrinsics, self.corner_sigma_px
            )
        return Problem(
            self.T_base_gripper, self.mount, views, free_scale, self.arm, self.q, self.fk
        )

    @property
    def corner_sigma_px(self) -> float:
        """Std of one corner coordinate, px, each image with a pose of its own: no arm is in it."""
        counts = np.array([len(seen.ids) for seen in self.detections or ()])
        squares = sum(c * p.rms_px**2 for c, p in zip(counts, self.poses, strict=True))
        return max(math.sqrt(squares / max(1, 2 * counts.sum() - 6 * len(counts))), 1e-6)


def _are_detections(seen: object) -> bool:

    if isinstance(seen, Detections):
        return True
    return isinstance(seen, (list, tuple)) and any(isinstance(one, Detection) for one in seen)


def _joints(arm: Arm | None, q: ArrayLike | None, n: int) -> Floats | None:
    if (arm is None) != (q is None):
        raise ValueError("arm, q: joint offsets need both, or give neither")
    if q is None:
        return None
    joints = np.asarray(q, float)
    if joints.shape != (n, 6) or not np.isfinite(joints).all():
        raise ValueError(f"q: got shape {joints.shape}, want finite ({n}, 6) in rad")
    return joints


NAMES = TWIST


@dataclass(frozen=True, eq=False, repr=False)
class HandEyeResult:
    """Where the camera is, and how far the data speak for it.

    X (4, 4): T_gripper_camera (eye-in-hand) or T_base_camera (eye-to-hand). Y (4, 4): T_base_board
    or T_gripper_board. data: what was given. refined: the refinement, None after a closed form,
    which says nothing about its own uncertainty.
    """

    X: Floats
    Y: Floats
    method: str
    data: HandEyeData
    refined: Refined | None = None

    @property
    def mount(self) -> Mount:
        """ "eye_in_hand" or "eye_to_hand"."""
        return self.data.mount

    # --- how well X is known ---

    @property
    def covariance(self) -> Floats:
        """(12, 12) of the twists of X, then Y; ValueError after a closed form.

        A twist is (omega, v), rad and m, along the axes of the frame that X is given in (gripper
        or base): omega turns the camera about its own origin, v shifts it.
        """
        return self._fit.covariance[:12, :12]

    @property
    def sigma_deg(self) -> Floats:
        """Standard deviations (3,) of X's rotation about the axes of the frame it is given in."""
        return np.degrees(np.sqrt(np.diag(self.covariance)[:3]))

    @property
    def sigma_mm(self) -> Floats:
        """Standard deviations (3,) of X's translation."""
        return 1e3 * np.sqrt(np.diag(self.covariance)[3:6])

    def sigma(self, name: str) -> float:
        """Standard deviation of "rx", "ry", "rz" (rad), "tx", "ty", "tz" (m) of X; or of another
        of `names`, such as "Y.tx", "scale" or "offset_1"."""
        fit = self._fit
        full = f"X.{name}" if name in NAMES else name
        if full not in self.names:
            raise ValueError(f"name: got {name!r}, want one of {', '.join((*NAMES, *self.names))}")
        return float(np.sqrt(fit.covariance[self.names.index(full), self.names.index(full)]))

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """The interval that holds a part of X with probability `level`: m for "tx", "ty", "tz".

        For "rx", "ry", "rz": how far the true camera may be turned from this one, rad, about 0.
        """
        half = self.quantile(level) * self.sigma(name)
        middle = float(self.X[NAMES.index(name) - 3, 3]) if name in NAMES[3:] else 0.0
        if name not in NAMES:
            raise ValueError(f"name: got {name!r}, want one of {', '.join(NAMES)}")
        return middle - half, middle + half

    def holds(self, X_true: ArrayLike, level: float = 0.95) -> NDArray[np.bool_]:
        """Whether the interval of each of rx, ry, rz, tx, ty, tz holds the truth, (6,)."""
        off = pose_difference(self.X, check_one("X_true", X_true))
        return np.abs(off) < self.quantile(level) * np.sqrt(np.diag(self.covariance)[:6])

    def quantile(self, level: float = 0.95) -> float:
        """How many sigmas an interval of probability `level` reaches to either side."""
        from scipy.stats import norm, t

        if not 0 < level < 1:
            raise ValueError(f"level: got {level!r}, want a probability between 0 and 1")
        fixed = self._fit.problem.fk is not None  # priors fix the scale of the noise
        return float((norm if fixed else t(self._fit.dof)).ppf((1 + level) / 2))

    @property
    def names(self) -> tuple[str, ...]:
        """What was estimated, in the order of `refined.covariance`."""
        return self._fit.problem.names

    @property
    def _fit(self) -> Refined:
        if self.refined is None:
            raise ValueError(f"method: {self.method} gives no covariance; solve with 'refine'")
        return self.refined

    @property
    def scale(self) -> float:
        """Real size of the board over the size it claims; 1 unless it was estimated."""
        return self.refined.state.scale if self.refined else 1.0

    @property
    def joint_offsets_rad(self) -> Floats:
        """The estimated joint offsets (6,), to be added to the reported angles; 0 if not asked."""
        return self.refined.state.offsets if self.refined else np.zeros(6)

    @cached_property
    def free(self) -> tuple[str, ...]:
        """What the arm poses leave undetermined, in words; solvers return something anyway."""

        return observability(self.data.T_base_gripper, self.mount).free

    # --- what is left over ---

    @cached_property
    def T_base_gripper(self) -> Floats:
        """The arm poses (n, 4, 4) as the result takes them to be.

        As reported, but for the errors that belong to the arm (joint offsets and what `fk`
        shares) where those were estimated.
        """
        if self.refined is None:
            return self.data.T_base_gripper
        return arm_poses_with(self.refined, self.data.T_base_gripper, self.data.q, self.data.fk)

    @cached_property
    def T_camera_board(self) -> Floats:
        """Where the camera should see the board, (n, 4, 4)."""
        return camera_board(self.T_base_gripper, self.X, self.Y, self.mount)

    @cached_property
    def residuals(self) -> tuple[Floats, ...]:
        """Observed - predicted of each view, (N_i, 2) px; ValueError without detections."""
        data = self.data
        if data.detections is None:
            raise ValueError("seen: poses have no residuals in px; solve with detections")
        assert data.board is not None
        assert data.intrinsics is not None
        return pixel_residuals(data.detections, data.board, data.intrinsics, self)

    @property
    def rms_px(self) -> float:
        """Root mean square length of the residual vectors, px."""
        rows = np.concatenate(self.residuals)
        return float(np.sqrt(np.mean((rows**2).sum(axis=1))))

    @cached_property
    def gap_m(self) -> Floats:
        """How far the board is from where it should be, (n,), m.

        Between the pose that the image alone gives and the one that arm, X and Y give: root mean
        square over the corners, or at the origin where no board is known. Along the line of sight
        an image knows least, so this is larger than the residuals in px would say.
        """
        return board_gap(self.data.T_camera_board, self.T_camera_board, self.data.board, self.scale)

    @property
    def rms_mm(self) -> float:
        """Root mean square of `gap_m`, mm."""
        return 1e3 * float(np.sqrt(np.mean(self.gap_m**2)))

    @property
    def spread_board_mm(self) -> float:
        """Root mean square distance of the board's origin from its mean over the poses, mm.

        Each pose puts the board somewhere on its stand (base or gripper): T X T_camera_board.
        """
        seen = _scaled(self.data.T_camera_board, self.scale)
        places = stand_board(self.T_base_gripper, seen, self.X, self.mount)[:, :3, 3]
        return 1e3 * float(np.sqrt(np.mean(np.sum((places - places.mean(axis=0)) ** 2, axis=1))))

    @property
    def gripper_twists(self) -> Floats:
        """From where the arm says the gripper is to where the camera implies, (n, 6), rad and m."""
        seen = _scaled(self.data.T_camera_board, self.scale)
        M = self.X @ seen @ invert_transform(self.Y)
        implied = M if self.mount == "eye_to_hand" else invert_transform(M)
        return pose_difference(self.T_base_gripper, implied)

    @property
    def spread_gripper_mm(self) -> float:
        """Root mean square distance at the gripper between what arm and camera say, mm."""
        return 1e3 * float(np.sqrt(np.mean(np.sum(self.gripper_twists[:, 3:] ** 2, axis=1))))

    @property
    def spread_gripper_deg(self) -> float:
        """Root mean square angle at the gripper between what arm and camera say, deg."""
        squares = np.sum(self.gripper_twists[:, :3] ** 2, axis=1)
        return float(np.degrees(np.sqrt(np.mean(squares))))

    @property
    def excess(self) -> float:
        """How far arm and images disagree: variance over what noise and stated errors explain.

        About 1 where all is as stated. The corners' noise is measured with a pose for each image
        alone, no arm in it; ValueError where there are no corners.
        """
        fit, n = self._fit, len(self.data.T_base_gripper)
        if self.data.detections is None:
            raise ValueError("seen: poses say nothing about their own noise; solve with detections")
        return max(0.0, fit.squares - (fit.problem.views.observations - 6 * n)) / self._added

    @property
    def _added(self) -> int:
        """Six numbers a pose tie the images to the arm, less those that X, Y and scale took."""
        return max(1, 6 * len(self.data.T_base_gripper) - 12 - self._fit.problem.free_scale)

    @property
    def consistency_p_value(self) -> float:
        """How often chance alone gives such an `excess`; small where something errs unstated.

        With `fk` it is rough: how much play a unit has differs from unit to unit.
        """
        from scipy.stats import f

        n = len(self.data.T_base_gripper)
        inner = max(1, self._fit.problem.views.observations - 6 * n)
        return float(f.sf(self.excess, self._added, inner))

    def verdict(self) -> str:
        """In words: how good this is, and what it lacks."""

        return verdict(self)

    def __repr__(self) -> str:

        return describe(self)


def _scaled(T: Floats, scale: float) -> Floats:
    """Poses of a board whose real size is `scale` times what they were measured with."""
    T = T.copy()
    T[:, :3, 3] *= scale
    return T


def pixel_residuals(
    detections: Sequence[Detection],
    board: Board,
    intrinsics: Intrinsics,
    result: HandEyeResult,
    T_camera_board: Floats | None = None,
) -> tuple[Floats, ...]:
    """Observed - predicted of each view, (N_i, 2) px, at poses (n, 4, 4) or the result's own."""
    poses = result.T_camera_board if T_camera_board is None else T_camera_board
    views = PixelViews.of(detections, board, intrinsics)
    rows = views.residuals(poses, result.scale)
    return tuple(np.split(rows, views.starts[1:]))


def board_gap(seen: Floats, expected: Floats, board: Board | None, scale: float) -> Floats:
    """Root mean square distance over the corners between two poses of a board, (n,), m."""
    points = np.zeros((1, 3)) if board is None else scale * board.points
    seen = _scaled(seen, scale)
    apart = points @ np.swapaxes(seen[:, :3, :3] - expected[:, :3, :3], 1, 2)
    apart += (seen - expected)[:, None, :3, 3]
    return np.sqrt(np.mean(np.sum(apart**2, axis=2), axis=1))


LINE = 88
GOOD_MM, USABLE_MM = 2.0, 5.0  # 95 %, worst direction, lever arm included
CONSISTENT = 0.001
TWICE = 4.0  # a unit of an arm may have twice the gear play of most: that is still as stated
UNKNOWN_DEG, UNKNOWN_MM = 90.0, 1e3  # what is known no better is not known
GOOD_POSES = 15
GOOD_TURN_DEG = 15.0  # rms about the second axis: +-25 deg or so


@dataclass(frozen=True, eq=False, repr=False)
class HeldOut:
    """What a result predicts of poses that it has not seen.

    residuals: observed - predicted of each view, (N_i, 2) px, None without detections. gap_m (m,):
    between the board as the image alone places it and as predicted, root mean square over the
    corners. along_m, across_m (m,): the same along the line of sight, where an image knows least,
    and across it.
    """

    residuals: tuple[Floats, ...] | None
    gap_m: Floats
    along_m: Floats
    across_m: Floats

    @cached_property
    def rms_px(self) -> float:
        """Root mean square length of the residual vectors, px."""
        if self.residuals is None:
            raise ValueError("seen: poses have no residuals in px; give detections")
        rows = np.concatenate(self.residuals)
        return float(np.sqrt(np.mean((rows**2).sum(axis=1))))

    @property
    def rms_mm(self) -> float:
        """Root mean square of `gap_m`, mm."""
        return 1e3 * _rms(self.gap_m)

    def __repr__(self) -> str:
        pixels = "" if self.residuals is None else f"{self.rms_px:.2f} px, "
        return (
            f"{len(self.gap_m)} poses held out: {pixels}{self.rms_mm:.2f} mm at the board "
            f"({1e3 * _rms(self.across_m):.2f} across the line of sight, "
            f"{1e3 * _rms(self.along_m):.2f} along it), worst {1e3 * self.gap_m.max():.2f} mm"
        )


def held_out(
    result: HandEyeResult,
    T_base_gripper: ArrayLike,
    seen: Sequence[Detection] | ArrayLike,
    *,
    board: Board | None = None,
    intrinsics: Intrinsics | None = None,
    q: ArrayLike | None = None,
    fk: FkErrors | None = None,
) -> HeldOut:
    """The gap between prediction and sight at poses that were not used for the fit.

    T_base_gripper (m, 4, 4) and seen as in `solve`; board and intrinsics are the result's unless
    given. q (m, 6) or fk for these poses apply what the fit has learnt of the arm's own errors;
    without them the arm is taken at its word. Raises ValueError as `solve` does.
    """
    data = result.data
    arm = data.arm if q is not None else None
    other = HandEyeData.of(
        T_base_gripper, seen, result.mount, board or data.board, intrinsics or data.intrinsics,
        arm, q if arm is not None else None, fk, at_least=1,
    )  # fmt: skip
    poses = other.T_base_gripper
    if result.refined is not None and (fk is not None or arm is not None):
        poses = arm_poses_with(result.refined, poses, other.q, fk)
    expected = camera_board(poses, result.X, result.Y, result.mount)
    residuals = None
    if other.detections is not None:
        residuals = pixel_residuals(
            other.detections, other.board, other.intrinsics, result, expected  # type: ignore[arg-type]
        )  # fmt: skip
    gap = board_gap(other.T_camera_board, expected, other.board, result.scale)
    along = _along_sight(other.T_camera_board, expected, other.board, result.scale)
    return HeldOut(residuals, gap, along, np.sqrt(np.maximum(gap**2 - along**2, 0.0)))


def _along_sight(seen: Floats, expected: Floats, board: Board | None, scale: float) -> Floats:
    """Root mean square over the corners of the gap along each corner's line of sight, (n,), m."""
    points = np.zeros((1, 3)) if board is None else scale * board.points
    at, there = (
        points @ np.swapaxes(T[:, :3, :3], 1, 2) + factor * T[:, None, :3, 3]
        for T, factor in ((seen, scale), (expected, 1.0))
    )
    sight = there / np.linalg.norm(there, axis=2, keepdims=True)
    return np.sqrt(np.mean(np.sum((at - there) * sight, axis=2) ** 2, axis=1))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


# --- in words ---


def describe(result: HandEyeResult) -> str:
    """The printout of a result."""
    name_X, name_Y = FRAMES[result.mount]
    data = result.data
    n = len(data.T_base_gripper)
    corners = (
        "" if data.detections is None else f", {sum(len(d.ids) for d in data.detections)} corners"
    )
    unsure = result.refined is not None and not result.refined.converged
    lines = [
        f"{result.mount}, {result.method}, {n} poses{corners}" + ("; NOT CONVERGED" * unsure),
        _pose_line(name_X, result.X, result, 0),
        _pose_line(name_Y, result.Y, result, 6),
    ]
    if result.refined is not None:
        lines += [
            f"{name} = {_value(result, name)}" for name in result.names[12:] if _own_name(name)
        ]
    if result.free:
        lines.append(textwrap.fill(f"NOT DETERMINED: {'; '.join(result.free)}", LINE))
    pixels = "" if data.detections is None else f"{result.rms_px:.2f} px, "
    lines.append(f"residuals: {pixels}{result.rms_mm:.2f} mm at the board (rms)")
    lines.append(
        f"spread: {result.spread_board_mm:.2f} mm of the board on its stand, "
        f"{result.spread_gripper_mm:.2f} mm and {result.spread_gripper_deg:.3f} deg of the gripper"
    )
    return "\n".join(lines)


def _own_name(name: str) -> bool:
    return name == "scale" or name.startswith("offset_")


def _value(result: HandEyeResult, name: str) -> str:
    half = result.quantile() * result.sigma(name)
    if name == "scale":
        return f"{result.scale:.5f} ± {half:.5f} (95 %)"
    offset = result.joint_offsets_rad[int(name[-1])]
    return f"{math.degrees(offset):.3f} ± {math.degrees(half):.3f} deg (95 %)"


def _pose_line(name: str, T: Floats, result: HandEyeResult, first: int) -> str:
    from scipy.spatial.transform import Rotation

    turned = "({:.2f}, {:.2f}, {:.2f})".format(
        *(np.degrees(Rotation.from_matrix(T[:3, :3]).as_rotvec()) + 0.0)
    )
    place = 1e3 * T[:3, 3] + 0.0
    if result.refined is None:
        return f"{name}: " + "({:.2f}, {:.2f}, {:.2f}) mm".format(*place) + f", turned {turned} deg"
    sigma = result.quantile() * np.sqrt(np.diag(result.covariance)[first : first + 6])
    wide, far = np.degrees(sigma[:3].max()), 1e3 * sigma[3:]
    if wide > UNKNOWN_DEG or far.max() > UNKNOWN_MM:
        one = "({:.0f}, {:.0f}, {:.0f}) mm".format(*place)
        return f"{name}: unknown in part; one that fits: {one}"
    where = ", ".join(f"{p:.2f} ± {s:.2f}" for p, s in zip(place, far, strict=True))
    return f"{name}: ({where}) mm,\n  turned {turned} ± {wide:.3f} deg (95 %)"


def verdict(result: HandEyeResult) -> str:
    """In words: how far to trust X, and what to do about what is weak."""
    weak = [reason for reason in _weaknesses(result) if reason]
    lines = [_head(result, bool(weak)), *(f"- {reason}" for reason in weak)]
    return "\n".join(
        textwrap.fill(line, LINE, subsequent_indent="  ", break_on_hyphens=False) for line in lines
    )


def _weaknesses(result: HandEyeResult) -> list[str]:
    """What could be better, with what to do; "" for what could not."""
    seen = observability(result.data.T_base_gripper, result.mount)
    n, turn = seen.poses, seen.turns_deg[1]
    converged = result.refined is None or result.refined.converged
    return [
        *(f"{direction}: the poses do not determine it." for direction in seen.free),
        f"{n} poses are few: take 15 to 30." if n < GOOD_POSES else "",
        f"about its second axis the wrist turned by {turn:.0f} deg (rms) only: turn it by 30 deg "
        "or more about two axes." if turn < GOOD_TURN_DEG else "",
        _inconsistent(result),
        "" if converged else "the refinement did not converge: are some pairs of pose and image "
        "wrong?",
    ]  # fmt: skip


def _head(result: HandEyeResult, weak: bool) -> str:
    """The finding in a sentence or two."""
    if result.refined is None:
        return (
            f"Uncertain: {result.method} says nothing about its own error. Solve with 'refine' for "
            "an interval."
        )
    worst = result.quantile() * reach_sigma_mm(result)
    if result.free or worst > USABLE_MM:
        grade = "Not good enough"
    elif _inconsistent(result):
        grade = "Not to be trusted"
    else:
        grade = "Usable with care" if weak or worst > GOOD_MM else "Good"
    at_its_word = result.data.fk is None
    return (
        f"{grade}: a point {1e3 * LEVER_M:.0f} mm in front of the camera is placed within "
        f"± {worst:.1f} mm (95 %, worst direction), as far as the mount goes."
        + " That takes the arm at its word: an arm's own error comes on top."
        * at_its_word
    )


def reach_sigma_mm(result: HandEyeResult, lever_m: float = LEVER_M) -> float:
    """Standard deviation, mm, worst direction, of where X puts a point `lever_m` ahead."""
    arm = result.X[:3, 2] * lever_m
    by_twist = np.concatenate([-cross_matrix(arm), np.eye(3)], axis=1)
    spread = by_twist @ result.covariance[:6, :6] @ by_twist.T
    return 1e3 * float(np.sqrt(np.linalg.eigvalsh(spread)[-1]))


def _inconsistent(result: HandEyeResult) -> str:
    if result.refined is None or result.data.detections is None:
        return ""
    stated = result.data.fk is not None
    if result.consistency_p_value > CONSISTENT or (stated and result.excess < TWICE):
        return ""
    said = "more than was stated (fk)" if stated else "which was taken as exact"
    return (
        f"arm and images disagree by {result.spread_gripper_mm:.1f} mm and "
        f"{result.spread_gripper_deg:.2f} deg at the gripper, more than the corners' noise "
        f"explains: the arm errs, {said}, or a pair is wrong. The intervals are too narrow then."
    )
