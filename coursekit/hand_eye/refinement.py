"""The joint refinement: X, Y and what else is unknown, with the arm's errors weighed.

The camera should see the board of view i at C_i = X^-1 M_i Y, M_i = T_carrier_stand. What it does
see is compared either in pixels or as poses (`views`); both come down to a gradient and an
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

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from coursekit.arm import Arm, FkErrors
from coursekit.arrays import Floats
from coursekit.geometry import cross_matrix, pose_difference, turned
from coursekit.hand_eye.poses import Mount, by_arm_twist, by_X_and_Y, camera_board
from coursekit.hand_eye.views import PoseViews, Views
from coursekit.intrinsics.derivatives import scaled_inverse

GAUSS_NEWTON_STEPS, STEP_HALVINGS = 50, 10
NEGLIGIBLE_DECREASE = 1e-8  # of the sum of squares by a step: 1e-4 standard deviations
UNDETERMINED = 1e-13  # of the largest eigenvalue of the scaled information: nobody moves along it
LEVEL_ROUNDS = 10  # of estimating how much poses scatter
TWIST = ("rx", "ry", "rz", "tx", "ty", "tz")
JOINT_OFFSET = "offset of "  # how `arm.fk_covariance` names joint offsets
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
        """Of the shared unknowns, in the order of the covariance: X's twist, Y's, and the rest."""
        names = [*TWIST, *(f"Y.{part}" for part in TWIST)]
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
            column
            for column, name in enumerate(self.fk.names)
            if self.arm is None or not name.startswith(JOINT_OFFSET)
        ]

    @cached_property
    def _offset_sigma(self) -> Floats:
        """The priors (6,) of joint offsets, rad; none where they are not asked for."""
        if self.arm is None:
            return np.zeros(0)
        if self.fk is None:
            return np.full(6, OFFSET_SIGMA_RAD)
        known = dict(zip(self.fk.names, self.fk.sigma, strict=True))
        return np.array(
            [known.get(JOINT_OFFSET + joint, OFFSET_SIGMA_RAD) for joint in self.arm.joints]
        )

    @cached_property
    def shared(self) -> Floats:
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
        free, k = np.zeros(12 + self.free_scale), self.shared.shape[2]
        return np.concatenate([free, self._offset_sigma**-2.0, np.ones(k)])

    def values(self, state: State) -> Floats:
        """The unknowns `names` (g,): rad, m, and 0 for a rotation, which is counted from X or Y."""
        X, Y = ([0.0, 0.0, 0.0, *T[:3, 3]] for T in (state.X, state.Y))
        scale, offsets = [state.scale] * self.free_scale, state.offsets[: len(self._offset_sigma)]
        return np.concatenate([X, Y, scale, offsets, state.shared])

    @property
    def dof(self) -> int:
        """Numbers observed less unknowns, at least 1; an unknown with a prior costs nothing."""
        return max(1, self.views.observations - 12 - self.free_scale)

    def arm_twists(self, state: State) -> Floats:
        """The estimated errors of the arm's poses, (n, 6)."""
        shared = self.shared @ state.shared
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
        pull = self.prior * self._with_prior(state)
        total = float(squares.sum()) + self.prior_squares(state)
        return Equations(shared, own, gradient, information, self.prior, pull, state.own, total)

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
            columns.append(by_arm @ self.shared)
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
    units = np.outer(scale, scale)
    return np.linalg.pinv(matrix / units, rcond=UNDETERMINED, hermitian=True) / units


# --- the fit ---


@dataclass(frozen=True, eq=False)
class Refined:
    """Where the refinement ended.

    covariance (g, g): of the shared unknowns `problem.names`. squares: the sum in sigmas that were
    assumed; where no priors fix their scale the covariance is larger by what the residuals say.
    converged: whether another step would change anything. levels (2,): how much measured
    poses scatter about and along each axis, rad and m; None for pixels.
    """

    problem: Problem
    state: State
    covariance: Floats
    squares: float
    converged: bool
    levels: Floats | None = None


def refine_pixels(problem: Problem, X: Floats, Y: Floats) -> Refined:
    """The most probable state of a problem, from a start X, Y that is roughly right."""
    n, _, k = problem.shared.shape
    start = State(X, Y, 1.0, np.zeros(6), np.zeros(k), np.zeros((n, 6)))
    state, equations, converged = _minimise(problem, start)
    noise = 1.0
    if problem.fk is None:  # an error of the arm would count as noise: let the residuals say
        noise = np.sqrt(equations.squares / problem.dof)
    reduced = equations.reduced
    if problem.arm is not None:  # priors are absolute, the rest is in units of the noise
        reduced = reduced + (noise**2 - 1) * np.diag(problem.prior)
    covariance = noise**2 * scaled_inverse(reduced)
    return Refined(problem, state, covariance, equations.squares, converged)


def _minimise(problem: Problem, state: State) -> tuple[State, Equations, bool]:
    equations = problem.equations(state)
    for _ in range(GAUSS_NEWTON_STEPS):
        change, own, decrease = equations.step()
        if decrease < NEGLIGIBLE_DECREASE:
            return state, equations, True
        for halving in range(STEP_HALVINGS):
            trial = problem.step(state, change / 2**halving, own / 2**halving)
            now = problem.squares(trial)
            if now <= equations.squares * (1 + 1e-14):
                break
        else:
            return state, equations, decrease < 1e-3
        state, equations = trial, problem.equations(trial)
    return state, equations, False


def refine_poses(problem: Problem, X: Floats, Y: Floats) -> Refined:
    """`refine_pixels` on poses, estimating how much their rotations and positions scatter.

    Radians and metres must be weighed against each other. The weights are the scatter itself, one
    standard deviation for the rotations and one for the positions, repeated until they stay.
    Source: variance components, Förstner (1979).
    """
    poses = problem.views.poses  # type: ignore[union-attr]
    n = len(poses)
    levels = np.array([np.radians(0.1), 0.5e-3])
    half_dof = max(1.0, 3 * n - 6 - problem.free_scale / 2)
    for _ in range(LEVEL_ROUNDS):
        weights = np.diag(np.repeat(levels**-2.0, 3))
        views = PoseViews(poses, np.broadcast_to(weights, (n, 6, 6)))
        refined = refine_pixels(replace(problem, views=views), X, Y)
        X, Y = refined.state.X, refined.state.Y
        predicted = refined.problem.camera_board(refined.state)
        predicted[:, :3, 3] /= refined.state.scale
        squares = (pose_difference(predicted, poses) ** 2).sum(axis=0).reshape(2, 3).sum(axis=1)
        before, levels = levels, np.maximum(np.sqrt(squares / half_dof), [1e-9, 1e-9])
        if np.allclose(before, levels, rtol=1e-3):
            break
    return replace(refined, levels=levels)


def arm_poses_with(refined: Refined, other: Problem) -> Floats:
    """The arm poses (m, 4, 4) of another problem, put right by what was learnt of the arm.

    other: with poses of the same arm; its q where joint offsets were estimated, and its fk where
    the arm's shared errors were. What a pose has for itself (gear play) is not known there.
    """
    reported = other.reported(refined.state)
    if other.fk is None:
        return reported
    state = replace(refined.state, own=np.zeros((len(reported), 6)))
    return turned(reported, other.arm_twists(state))
