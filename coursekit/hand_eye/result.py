"""What `solve` returns: where the camera is, how well that is known, and what is left over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from coursekit.arm import pose_difference
from coursekit.geometry import invert_transform
from coursekit.hand_eye.closed_form import stand_board
from coursekit.hand_eye.data import HandEyeData
from coursekit.hand_eye.poses import Mount, camera_board, check_one
from coursekit.hand_eye.refine import TWIST, Refined, arm_poses_with
from coursekit.hand_eye.views import PixelViews

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from coursekit.boards import Board, Detection
    from coursekit.geometry import Intrinsics

    Floats = NDArray[np.float64]


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
        from coursekit.hand_eye.observability import observability

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
        from coursekit.hand_eye import judge

        return judge.verdict(self)

    def __repr__(self) -> str:
        from coursekit.hand_eye import judge

        return judge.describe(self)


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
