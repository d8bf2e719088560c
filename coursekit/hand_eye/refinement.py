"""What views say about the poses of the board in them: corners in pixels, or poses measured.

The pose of a board in one image, with its covariance and the second pose that a plane allows.

The joint refinement: X, Y and what else is unknown, with the arm's errors weighed.

The camera should see the board of view i at C_i = X^-1 M_i Y, M_i = T_carrier_stand. What it does
see is compared either in pixels (detections) or as poses; both come down to a gradient and an
information matrix (7, 7) of (omega, v, log scale) of each C_i, and everything unknown acts through
those seven numbers. Gauss-Newton with halved steps does the rest.

An arm is not where it says. Its error (`arm.FkErrors`) is a twist of the gripper, shared_i s +
own_i: `s` are numbers that belong to the unit (joint offsets, links) and move all poses together;
`own_i` is drawn anew at each pose (gear play). Both are unknowns with Gaussian priors. Without the
first the intervals would shrink with the number of poses although the bias stays; without the
second a view of 54 corners would count as 54 witnesses of one pose. The own ones are six a pose,
and each touches one view only: they are eliminated view by view (Schur complement).

Source: Triggs et al., "Bundle adjustment: a modern synthesis" (2000), sections 4 and 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from coursekit.arm import Arm, FkErrors, pose_difference
from coursekit.arrays import Floats, NDArray
from coursekit.boards import Board, Detection
from coursekit.geometry import Intrinsics, cross_matrix, undistort
from coursekit.hand_eye.poses import Mount, camera_board, carrier_stand, turned
from coursekit.intrinsics.derivatives import project_with_derivatives, scaled_inverse, twist_columns


class Views(Protocol):
    """What n views say about the poses of the board in them."""

    @property
    def observations(self) -> int:
        """How many numbers were observed."""

    def linear(self, T_camera_board: Floats, scale: float) -> tuple[Floats, Floats, Floats]:
        """At poses (n, 4, 4): squares (n,), gradient (n, 7), information (n, 7, 7); whitened.

        The gradient is J'r and the information J'J of the twist (omega, v) of each pose and of
        the logarithm of the board's scale. Infinite squares for a board that reaches behind the
        camera.
        """


@dataclass(frozen=True, eq=False)
class PixelViews:
    """Corners: board points (N, 3) in m, pixels (N, 2), and where each view starts (n,).

    sigma_px: the standard deviation of one coordinate.
    """

    points: Floats
    pixels: Floats
    starts: NDArray[np.intp]
    intrinsics: Intrinsics
    sigma_px: float

    @classmethod
    def of(
        cls,
        detections: Sequence[Detection],
        board: Board,
        intrinsics: Intrinsics,
        sigma_px: float = 1.0,
    ) -> PixelViews:
        """The corners of detections in one row."""
        counts = [len(seen.ids) for seen in detections]
        ids = np.concatenate([seen.ids for seen in detections])
        pixels = np.concatenate([seen.pixels for seen in detections])
        starts = np.cumsum([0, *counts[:-1]])
        return cls(board.points[ids], pixels, starts, intrinsics, sigma_px)

    @property
    def observations(self) -> int:
        """Two a corner."""
        return self.pixels.size

    @cached_property
    def view(self) -> NDArray[np.intp]:
        """The view (N,) of each corner."""
        counts = np.diff([*self.starts, len(self.pixels)])
        return np.repeat(np.arange(len(self.starts)), counts)

    def pick(self, which: NDArray[np.intp]) -> PixelViews:
        """The views with these numbers, in this order."""
        ends = [*self.starts[1:], len(self.pixels)]
        rows = [np.arange(self.starts[i], ends[i]) for i in which]
        starts = np.cumsum([0, *(len(row) for row in rows[:-1])])
        chosen = np.concatenate(rows)
        return replace(self, points=self.points[chosen], pixels=self.pixels[chosen], starts=starts)

    def predicted(self, T_camera_board: Floats, scale: float = 1.0) -> tuple[Floats, Floats]:
        """Corners in the camera's frame and the same from the board's origin, (N, 3) each, m."""
        T = T_camera_board[self.view]
        arm = np.einsum("nij,nj->ni", T[:, :3, :3], scale * self.points)
        return arm + T[:, :3, 3], arm

    def residuals(self, T_camera_board: Floats, scale: float = 1.0) -> Floats:
        """Observed - predicted, (N, 2) px; infinite for a corner behind the camera."""
        at, _ = self.predicted(T_camera_board, scale)
        front = at[:, 2] > 0
        pixels = np.full((len(at), 2), np.inf)
        pixels[front] = project_with_derivatives(at[front], self.intrinsics)[0]
        return self.pixels - pixels

    def linear(self, T_camera_board: Floats, scale: float) -> tuple[Floats, Floats, Floats]:
        """See `Views`."""
        at, arm = self.predicted(T_camera_board, scale)
        behind = np.logical_or.reduceat(at[:, 2] <= 0, self.starts)
        at[behind[self.view], 2] = 1.0
        predicted, _, by_point = project_with_derivatives(at, self.intrinsics)
        residuals = (self.pixels - predicted) / self.sigma_px
        columns = np.empty((len(at), 2, 7))
        columns[..., :6] = twist_columns(arm, by_point)
        columns[..., 6] = np.einsum("nij,nj->ni", by_point, arm)
        columns /= self.sigma_px
        turned_columns = np.swapaxes(columns, 1, 2)
        gradient = (turned_columns @ residuals[..., None])[..., 0]
        squares = np.add.reduceat((residuals**2).sum(axis=1), self.starts)
        return (
            np.where(behind, np.inf, squares),
            np.add.reduceat(gradient, self.starts),
            np.add.reduceat(turned_columns @ columns, self.starts),
        )


@dataclass(frozen=True, eq=False)
class PoseViews:
    """Poses T_camera_board (n, 4, 4) that somebody measured, with their information (n, 6, 6)."""

    poses: Floats
    information: Floats

    @property
    def observations(self) -> int:
        """Six a pose."""
        return 6 * len(self.poses)

    def linear(self, T_camera_board: Floats, scale: float) -> tuple[Floats, Floats, Floats]:
        """See `Views`. A board `scale` times larger than said shrinks all distances by as much."""
        predicted = T_camera_board.copy()
        predicted[:, :3, 3] /= scale
        residuals = pose_difference(predicted, self.poses)
        columns = np.zeros((len(self.poses), 6, 7))
        # log(exp(r) exp(-w)) = r - (1 + [r]x / 2 + ..) w
        columns[:, :3, :3] = np.eye(3) + cross_matrix(residuals[:, :3]) / 2
        columns[:, 3:, 3:6] = np.eye(3) / scale
        columns[:, 3:, 6] = -predicted[:, :3, 3]
        weighted = np.swapaxes(columns, 1, 2) @ self.information
        return (
            np.einsum("ni,nij,nj->n", residuals, self.information, residuals),
            np.einsum("nij,nj->ni", weighted, residuals),
            weighted @ columns,
        )


MIN_CORNERS = 6
STEPS, DAMPING, ARRIVED = 50, 1e-4, 1e-8  # of Levenberg and Marquardt; the last in px^2
HOPELESS = 20.0  # times the best start's sum of squares
# The two poses of a flat board are told apart where the worse one's sum of squares, in units of
# the better one's variance, is larger by more than this: odds of 1 to 4,000.
AMBIGUOUS = 2 * np.log(4000.0)
SAME_RAD = np.radians(0.1)  # nearer than this two fits are one pose that was reached twice


@dataclass(frozen=True, eq=False)
class BoardPose:
    """Where the camera sees the board in one image.

    T_camera_board (4, 4). covariance (6, 6): of its twist (omega, v) in the camera's axes, rad and
    m, from the residuals of this image. rms_px: of the residual vectors (2-D). other: the second
    pose of a flat board, its normal mirrored about the line of sight, where the image cannot tell
    the two apart (`ambiguous`); None where it can.
    """

    T_camera_board: Floats
    covariance: Floats
    rms_px: float
    other: Floats | None = None

    @property
    def ambiguous(self) -> bool:
        """Whether a second pose explains the image about as well."""
        return self.other is not None

    @property
    def sigma_mm(self) -> Floats:
        """Standard deviations (3,) of the position along the camera's axes, mm."""
        return 1e3 * np.sqrt(np.diag(self.covariance)[3:])

    @property
    def sigma_deg(self) -> Floats:
        """Standard deviations (3,) of the rotation about the camera's axes, deg."""
        return np.degrees(np.sqrt(np.diag(self.covariance)[:3]))


def board_pose(detection: Detection, board: Board, intrinsics: Intrinsics) -> BoardPose:
    """The pose of a board by least squares on its corners, from both starts that a plane allows.

    Raises ValueError for fewer than 6 corners, corners on a line or that the board does not have,
    an image of another size than the intrinsics', and pixels that belong to no ray.
    Source of the two starts: Collins and Bartoli, "Infinitesimal plane-based pose estimation"
    (2014), OpenCV's SOLVEPNP_IPPE.
    """
    return board_poses([detection], board, intrinsics, name="detection")[0]


def board_poses(
    detections: Sequence[Detection],
    board: Board,
    intrinsics: Intrinsics,
    name: str = "detections",
) -> list[BoardPose]:
    """`board_pose` of each image, all at once; errors name the image."""
    check_detections(detections, board, intrinsics, name)
    starts = [
        _starts(seen, board, intrinsics, f"{name}[{index}]")
        for index, seen in enumerate(detections)
    ]
    owners = np.repeat(np.arange(len(starts)), [len(both) for both in starts])
    views = PixelViews.of([detections[int(owner)] for owner in owners], board, intrinsics)
    poses, squares, information = _refined(views, np.concatenate(starts), owners)
    found = []
    for index, seen in enumerate(detections):
        mine = np.flatnonzero(owners == index)
        mine = mine[np.argsort(squares[mine], kind="stable")]
        best, variance = mine[0], squares[mine[0]] / max(1, 2 * len(seen.ids) - 6)
        other = None
        if len(mine) > 1 and squares[mine[1]] - squares[best] < AMBIGUOUS * variance:
            other = poses[mine[1]] if _apart(poses[best], poses[mine[1]]) else None
        rms = float(np.sqrt(squares[best] / len(seen.ids)))
        covariance = variance * scaled_inverse(information[best])
        found.append(BoardPose(poses[best], covariance, rms, other))
    return found


def check_detections(
    detections: Sequence[Detection], board: Board, intrinsics: Intrinsics, name: str = "detections"
) -> None:
    """A ValueError that names the first image whose corners fix no pose."""
    count = len(board.points)
    for index, seen in enumerate(detections):
        where = f"{name}[{index}]" + (f" ({seen.name})" if seen.name else "")
        if tuple(seen.size) != intrinsics.size:
            raise ValueError(f"{where}: is {seen.size} px, the intrinsics {intrinsics.size}")
        if len(seen.ids) < MIN_CORNERS:
            raise ValueError(f"{where}: has {len(seen.ids)} corners, want at least {MIN_CORNERS}")
        if not np.isfinite(seen.pixels).all():
            raise ValueError(f"{where}: has NaN or infinite pixels")
        if seen.ids.min() < 0 or seen.ids.max() >= count:
            raise ValueError(
                f"{where}: has corner {seen.ids.max()}, the board has 0 to {count - 1}; another "
                "board?"
            )
        flat = board.points[seen.ids, :2]
        spread = np.linalg.svd(flat - flat.mean(axis=0), compute_uv=False)
        if spread[1] < 1e-6 * spread[0]:
            raise ValueError(f"{where}: has all its corners on one line, which fixes no pose")


def _starts(seen: Detection, board: Board, intrinsics: Intrinsics, name: str) -> Floats:
    """The one or two poses (k, 4, 4) of IPPE."""
    import cv2

    rays = (seen.pixels - [intrinsics.cx, intrinsics.cy]) / [intrinsics.fx, intrinsics.fy]
    if intrinsics.dist is not None:
        rays, found = undistort(rays, intrinsics.dist)
        if not found.all():
            raise ValueError(f"{name}: has pixels where the distortion has no inverse")
    points = board.points[seen.ids]
    centre = points.mean(axis=0)  # without it IPPE loses digits on boards far from their origin
    count, rotations, translations, _ = cv2.solvePnPGeneric(
        points - centre, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    starts = np.tile(np.eye(4), (count, 1, 1))
    for T, rotation, translation in zip(starts, rotations, translations, strict=False):
        T[:3, :3] = cv2.Rodrigues(rotation)[0]
        T[:3, 3] = translation.ravel() - T[:3, :3] @ centre
    usable = np.isfinite(starts).all(axis=(1, 2))
    if not usable.any():
        raise ValueError(f"{name}: no pose of the board explains these corners")
    return starts[usable]


def _refined(
    views: PixelViews, T: Floats, owners: NDArray[np.intp]
) -> tuple[Floats, Floats, Floats]:
    """Levenberg-Marquardt on each view by itself: poses, sums of squares (px^2), J'J (n, 6, 6).

    Of the starts of one owner, those that are hopelessly worse than the best stay where they are.
    """
    damping = np.full(len(T), DAMPING)
    squares, gradient, information = views.linear(T, 1.0)
    best = np.full(owners[-1] + 1, np.inf)
    np.minimum.at(best, owners, squares)
    active = squares <= HOPELESS * best[owners]
    for _ in range(STEPS):
        at = np.flatnonzero(active)
        N, g = information[at, :6, :6], gradient[at, :6]
        damped = N * (1.0 + damping[at, None, None] * np.eye(6))
        step = np.linalg.solve(damped, g[..., None])[..., 0]
        moving = np.sum(step * g, axis=1) > ARRIVED
        active[at[~moving]] = False
        at = at[moving]
        if not at.size:
            break
        trial = turned(T[at], step[moving])
        now, new_gradient, new_information = views.pick(at).linear(trial, 1.0)
        better = now <= squares[at]
        damping[at] *= np.where(better, 0.1, 10.0)
        at, new = at[better], np.flatnonzero(better)
        T[at], squares[at] = trial[new], now[new]
        gradient[at], information[at] = new_gradient[new], new_information[new]
    return T, squares, information[:, :6, :6]


def _apart(T: Floats, other: Floats) -> bool:
    return bool(np.linalg.norm(pose_difference(T, other)[:3]) > SAME_RAD)


STEPS, HALVINGS = 50, 10
ARRIVED = 1e-8  # the step would take off less of the sum of squares: 1e-4 standard deviations
UNDETERMINED = 1e-13  # of the largest eigenvalue of the scaled information: nobody moves along it
ROUNDS = 10  # of estimating how much poses scatter
TWIST = ("rx", "ry", "rz", "tx", "ty", "tz")
OFFSET = "offset of "  # how `arm.fk_covariance` names joint offsets
OFFSET_SIGMA_RAD = 0.05  # prior of joint offsets that are asked for: 3 deg, far above any unit's


# --- what is unknown ---


@dataclass(frozen=True, eq=False)
class State:
    """X, Y, the board's scale, joint offsets (6,) in rad, and the arm's errors in sigmas.

    shared (k,): of the unit. own (n, 6): of each pose, u_i with own_i = L_i u_i.
    """

    X: Floats
    Y: Floats
    scale: float
    offsets: Floats
    shared: Floats
    own: Floats


@dataclass(frozen=True, eq=False)
class Problem:
    """What is estimated, from what.

    T_base_gripper (n, 4, 4): reported. free_scale: whether the board's scale is unknown. arm and
    q (n, 6): where joint offsets are asked for. fk: the arm's errors, None for an arm that has
    none.
    """

    T_base_gripper: Floats
    mount: Mount
    views: Views
    free_scale: bool = False
    arm: Arm | None = None
    q: Floats | None = None
    fk: FkErrors | None = None

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of the shared unknowns, in the order of the covariance."""
        names = [f"{which}.{part}" for which in "XY" for part in TWIST]
        names += ["scale"] if self.free_scale else []
        names += [f"offset_{joint}" for joint in range(6)] if self.arm is not None else []
        if self.fk is not None:
            names += [self.fk.names[column] for column in self._columns]
        return tuple(names)

    @cached_property
    def _columns(self) -> list[int]:
        """The shared errors of the arm that are unknowns; joint offsets are not counted twice."""
        assert self.fk is not None
        return [
            column for column, name in enumerate(self.fk.names)
            if self.arm is None or not name.startswith(OFFSET)
        ]  # fmt: skip

    @cached_property
    def _offset_sigma(self) -> Floats:
        """The priors (6,) of joint offsets, rad; none where they are not asked for."""
        if self.arm is None:
            return np.zeros(0)
        if self.fk is None:
            return np.full(6, OFFSET_SIGMA_RAD)
        known = dict(zip(self.fk.names, self.fk.sigma, strict=True))
        return np.array([known.get(OFFSET + joint, OFFSET_SIGMA_RAD) for joint in self.arm.joints])

    @cached_property
    def _shared(self) -> Floats:
        """(n, 6, k): what one standard deviation of each shared error does at each pose."""
        if self.fk is None:
            return np.zeros((len(self.T_base_gripper), 6, 0))
        return self.fk.shared[..., self._columns] * self.fk.sigma[self._columns]

    @cached_property
    def _own_root(self) -> Floats:
        """L_i (n, 6, 6) with L_i L_i' the covariance of each pose's own error.

        To it comes what the errors do in second order, about half the product of two of them. It
        is some 0.01 mm, no less than what 54 corners tell of a pose.
        """
        assert self.fk is not None
        variances = np.einsum("nii->ni", self.fk.covariance)
        turn, shift = np.sqrt(variances.reshape(-1, 2, 3).mean(axis=2)).T
        second = np.stack([turn * turn / 2, turn * shift / 2], axis=1)
        curved = np.repeat(second**2, 3, axis=1)[:, None, :] * np.eye(6)
        values, vectors = np.linalg.eigh(self.fk.each + curved)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])

    @cached_property
    def prior(self) -> Floats:
        """The information (g,) of the priors on the shared unknowns."""
        free, k = np.zeros(12 + self.free_scale), self._shared.shape[2]
        return np.concatenate([free, self._offset_sigma**-2.0, np.ones(k)])

    def start(self, X: Floats, Y: Floats) -> State:
        """Where the iteration starts: no offsets, no errors, the board as it says it is."""
        n, _, k = self._shared.shape
        return State(X, Y, 1.0, np.zeros(6), np.zeros(k), np.zeros((n, 6)))

    def arm_twists(self, state: State) -> Floats:
        """The estimated errors of the arm's poses, (n, 6)."""
        shared = self._shared @ state.shared
        if self.fk is None:
            return shared
        return shared + np.einsum("nij,nj->ni", self._own_root, state.own)

    def reported(self, state: State) -> Floats:
        """T_base_gripper (n, 4, 4) of the reported joints with the offsets put right."""
        if self.arm is None or self.q is None:
            return self.T_base_gripper
        return self.arm.forward(self.q + state.offsets)

    def camera_board(self, state: State) -> Floats:
        """Where the camera should see the board, (n, 4, 4)."""
        return camera_board(self._arm_poses(state), state.X, state.Y, self.mount)

    def _arm_poses(self, state: State) -> Floats:
        return turned(self.reported(state), self.arm_twists(state))

    def prior_squares(self, state: State) -> float:
        """The sum of squares of the unknowns that have priors."""
        return float(self.prior @ self._with_prior(state) ** 2 + (state.own**2).sum())

    def _with_prior(self, state: State) -> Floats:
        offsets = state.offsets[: len(self._offset_sigma)]
        return np.concatenate([np.zeros(12 + self.free_scale), offsets, state.shared])

    def step(self, state: State, change: Floats, own: Floats) -> State:
        """The state after a change (g,) of the shared unknowns and (n, 6) of the own ones."""
        ends = np.cumsum([6, 6, int(self.free_scale), len(self._offset_sigma)])
        X, Y, scale, offsets, shared = np.split(change, ends)
        return State(
            turned(state.X, X),
            turned(state.Y, Y),
            state.scale * float(np.exp(scale.sum())),
            state.offsets + (offsets if len(offsets) else 0.0),
            state.shared + shared,
            state.own + own,
        )

    def squares(self, state: State) -> float:
        """What is minimised."""
        seen = self.views.linear(self.camera_board(state), state.scale)[0]
        return float(seen.sum()) + self.prior_squares(state)

    def equations(self, state: State) -> Equations:
        """The normal equations at a state."""
        arm_poses = self._arm_poses(state)
        C = camera_board(arm_poses, state.X, state.Y, self.mount)
        squares, gradient, information = self.views.linear(C, state.scale)
        shared, own = self._derivatives(state, arm_poses)
        return Equations(
            shared, own, gradient, information, self.prior, self.prior * self._with_prior(state),
            state.own, float(squares.sum()) + self.prior_squares(state),
        )  # fmt: skip

    def _derivatives(self, state: State, arm_poses: Floats) -> tuple[Floats, Floats | None]:
        """d the seven numbers of each view / d shared unknowns (n, 7, g), and / d own (n, 6, 6)."""
        n = len(arm_poses)
        by_arm = by_arm_twist(arm_poses, state.X, state.Y, self.mount)
        columns = [by_X_and_Y(arm_poses, state.X, state.Y, self.mount)]
        columns.append(np.zeros((n, 6, int(self.free_scale))))
        if self.arm is not None and self.q is not None:
            columns.append(by_arm @ self.arm.jacobian(self.q + state.offsets))
        if self.fk is not None:
            # The estimated turn is a vector that grows: exp(a + b) = exp((1 + [a]x / 2) b) exp(a)
            twists = self.arm_twists(state)
            by_arm[..., :3] = by_arm[..., :3] @ (np.eye(3) + cross_matrix(twists[:, :3]) / 2)
            columns.append(by_arm @ self._shared)
        by_pose = np.concatenate(columns, axis=2)
        by_scale = np.zeros((n, 1, by_pose.shape[2]))
        by_scale[..., 12 : 12 + self.free_scale] = 1.0
        own = None if self.fk is None else by_arm @ self._own_root
        return np.concatenate([by_pose, by_scale], axis=1), own


@dataclass(frozen=True, eq=False)
class Equations:
    """The normal equations of the shared unknowns (g) and each pose's own (6).

    shared (n, 7, g) and own (n, 6, 6) or None: derivatives of each view's seven numbers. gradient
    (n, 7) and information (n, 7, 7): of those. prior (g,), pull (g,): information and gradient of
    the priors. u (n, 6): the own unknowns now, of unit variance. squares: the sum now.
    """

    shared: Floats
    own: Floats | None
    gradient: Floats
    information: Floats
    prior: Floats
    pull: Floats
    u: Floats
    squares: float

    @cached_property
    def _cross(self) -> Floats:
        """(n, 6, g): N_i between own and shared unknowns."""
        assert self.own is not None
        return np.swapaxes(self.own, 1, 2) @ (self.information[:, :6] @ self.shared)

    @cached_property
    def _own_inverse(self) -> Floats:
        assert self.own is not None
        inner = np.swapaxes(self.own, 1, 2) @ self.information[:, :6, :6] @ self.own
        return np.asarray(np.linalg.inv(inner + np.eye(6)))

    @cached_property
    def reduced(self) -> Floats:
        """What is known of the shared unknowns, the own ones unknown, (g, g)."""
        total = np.einsum("nki,nkj->ij", self.shared, self.information @ self.shared)
        total += np.diag(self.prior)
        if self.own is not None:
            total -= np.einsum("nki,nkj->ij", self._cross, self._own_inverse @ self._cross)
        return (total + total.T) / 2

    def step(self) -> tuple[Floats, Floats, float]:
        """The Gauss-Newton step, (g,) and (n, 6), and what it should take off the squares."""
        gradient = np.einsum("nki,nk->i", self.shared, self.gradient) - self.pull
        if self.own is None:
            change = _determined_inverse(self.reduced) @ gradient
            return change, np.zeros_like(self.u), float(change @ gradient)
        own_gradient = np.einsum("nki,nk->ni", self.own, self.gradient[:, :6]) - self.u
        inner = np.einsum("nij,nj->ni", self._own_inverse, own_gradient)
        reduced = gradient - np.einsum("nki,nk->i", self._cross, inner)
        change = _determined_inverse(self.reduced) @ reduced
        own = inner - self._own_inverse @ self._cross @ change
        return change, own, float(change @ gradient + np.sum(own * own_gradient))


def _determined_inverse(matrix: Floats) -> Floats:
    """The pseudo-inverse that leaves alone what the data say nothing about."""
    scale = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    keep = values > UNDETERMINED * values[-1]
    kept = vectors[:, keep]
    return (kept / values[keep]) @ kept.T / np.outer(scale, scale)


def by_X_and_Y(T_base_gripper: Floats, X: Floats, Y: Floats, mount: Mount) -> Floats:
    """d twist of T_camera_board / d twists of X, then Y: (n, 6, 12)."""
    M = carrier_stand(T_base_gripper, mount)
    to_camera = X[:3, :3].T
    board = np.einsum("nij,j->ni", M[:, :3, :3], Y[:3, 3]) + M[:, :3, 3]  # in the carrier's frame
    columns = np.zeros((len(M), 6, 12))
    columns[:, :3, 0:3] = columns[:, 3:, 3:6] = -to_camera
    columns[:, 3:, 0:3] = to_camera @ cross_matrix(board - X[:3, 3])
    columns[:, :3, 6:9] = columns[:, 3:, 9:12] = to_camera @ M[:, :3, :3]
    return columns


def by_arm_twist(T_base_gripper: Floats, X: Floats, Y: Floats, mount: Mount) -> Floats:
    """d twist of T_camera_board / d twist of the gripper in the base's axes: (n, 6, 6)."""
    M = carrier_stand(T_base_gripper, mount)
    arm = np.einsum("nij,j->ni", M[:, :3, :3], Y[:3, 3])
    by_carrier = np.zeros((len(M), 6, 6))
    by_carrier[:, :3, :3] = by_carrier[:, 3:, 3:] = X[:3, :3].T
    by_carrier[:, 3:, :3] = -X[:3, :3].T @ cross_matrix(arm)
    if mount == "eye_to_hand":
        return by_carrier
    # M = T^-1: R' exp(-w), and -R' exp(-w) (t + v) = -R' t - R' v + R' (w x t)
    inverse = np.zeros_like(by_carrier)
    inverse[:, :3, :3] = inverse[:, 3:, 3:] = -M[:, :3, :3]
    inverse[:, 3:, :3] = -M[:, :3, :3] @ cross_matrix(T_base_gripper[:, :3, 3])
    return by_carrier @ inverse


# --- the fit ---


@dataclass(frozen=True, eq=False)
class Refined:
    """Where the refinement ended.

    covariance (g, g): of the shared unknowns `problem.names`. squares: the sum in sigmas that were
    assumed. noise: by what factor the assumed sigmas were too small, as the residuals say (1 where
    priors fix the scale). converged: whether another step would change anything.
    """

    problem: Problem
    state: State
    covariance: Floats
    squares: float
    noise: float
    converged: bool
    levels: dict[str, float] = field(default_factory=dict)

    @property
    def dof(self) -> int:
        """Numbers observed less unknowns; an unknown with a prior costs nothing."""
        return degrees_of_freedom(self.problem)


def degrees_of_freedom(problem: Problem) -> int:
    """Numbers observed less unknowns without a prior, at least 1."""
    return max(1, problem.views.observations - 12 - problem.free_scale)


def refine(problem: Problem, X: Floats, Y: Floats) -> Refined:
    """The most probable state of a problem, from a start X, Y that is roughly right."""
    state, equations, converged = _minimise(problem, problem.start(X, Y))
    noise = 1.0
    if problem.fk is None:  # an error of the arm would count as noise: let the residuals say
        noise = np.sqrt(equations.squares / degrees_of_freedom(problem))
    reduced = equations.reduced
    if problem.arm is not None:  # priors are absolute, the rest is in units of the noise
        reduced = reduced + (noise**2 - 1) * np.diag(problem.prior)
    covariance = noise**2 * scaled_inverse(reduced)
    return Refined(problem, state, covariance, equations.squares, float(noise), converged)


def _minimise(problem: Problem, state: State) -> tuple[State, Equations, bool]:
    equations = problem.equations(state)
    for _ in range(STEPS):
        change, own, decrease = equations.step()
        if decrease < ARRIVED:
            return state, equations, True
        for halving in range(HALVINGS):
            trial = problem.step(state, change / 2**halving, own / 2**halving)
            now = problem.squares(trial)
            if now <= equations.squares * (1 + 1e-14):
                break
        else:
            return state, equations, decrease < 1e-3
        state, equations = trial, problem.equations(trial)
    return state, equations, False


def refine_poses(problem: Problem, X: Floats, Y: Floats) -> Refined:
    """`refine` on poses, estimating how much their rotations and positions scatter.

    Radians and metres must be weighed against each other. The weights are the scatter itself, one
    standard deviation for the rotations and one for the positions, repeated until they stay.
    Source: variance components, Förstner (1979).
    """
    poses = problem.views.poses  # type: ignore[attr-defined]
    n = len(poses)
    levels = np.array([np.radians(0.1), 0.5e-3])
    half_dof = max(1.0, 3 * n - 6 - problem.free_scale / 2)
    for _ in range(ROUNDS):
        weights = np.diag(np.repeat(levels**-2.0, 3))
        views = PoseViews(poses, np.broadcast_to(weights, (n, 6, 6)))
        refined = refine(replace(problem, views=views), X, Y)
        X, Y = refined.state.X, refined.state.Y
        predicted = refined.problem.camera_board(refined.state)
        predicted[:, :3, 3] /= refined.state.scale
        squares = (pose_difference(predicted, poses) ** 2).sum(axis=0).reshape(2, 3).sum(axis=1)
        before, levels = levels, np.maximum(np.sqrt(squares / half_dof), [1e-9, 1e-9])
        if np.allclose(before, levels, rtol=1e-3):
            break
    return replace(
        refined, levels={"rotation_rad": float(levels[0]), "position_m": float(levels[1])}
    )


def arm_poses_with(
    refined: Refined, T_base_gripper: Floats, q: Floats | None, fk: FkErrors | None
) -> Floats:
    """Poses of the same arm (m, 4, 4), put right by what was learnt of its shared errors."""
    other = replace(refined.problem, T_base_gripper=T_base_gripper, q=q, fk=fk)
    reported = other.reported(refined.state)
    if fk is None:
        return reported
    state = replace(refined.state, own=np.zeros((len(reported), 6)))
    return turned(reported, other.arm_twists(state))
