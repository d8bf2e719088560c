"""The joint refinement: X, Y and what else is unknown, with the arm's errors weighed.

The camera should see the board of view i at C_i = X^-1 M_i Y, M_i = T_carrier_stand. What it does
see is compared either in pixels or as poses (`views`); both come down to a gradient and an
information matrix (7, 7) of (omega, v, log scale) of each C_i, and everything unknown acts through
those seven numbers. Gauss-Newton with halved steps does the rest.

An arm is not where it says. What belongs to the unit (`arm.FkErrors`: joint offsets, links) moves
all poses together; where it is stated it is unknown, with Gaussian priors. What is drawn anew at
each pose (repeatability, gear play, an arm that still swings, a board that is not flat) is there in
every session, stated or not: a turn and a shift of the gripper, and of the camera an error like
that of its corners' noise, or a turn of the board where only its poses are known. A view of 54
corners is one witness of one pose, so the size of these own errors decides how much is known.
`_Scatter` estimates it. They are six numbers a pose, and each touches one view only: they
are eliminated view by view (Schur complement).

Sources: Triggs et al., "Bundle adjustment: a modern synthesis" (2000), sections 4 and 6. The sizes,
by restricted maximum likelihood: Patterson and Thompson (1971). What their uncertainty does to the
covariance and to the degrees of freedom: Kenward and Roger, "Small sample inference for fixed
effects from restricted maximum likelihood" (1997).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit

from coursekit.arm import Arm, FkErrors
from coursekit.arrays import Floats
from coursekit.geometry import cross_matrix, pose_difference, turned
from coursekit.hand_eye.poses import Mount, by_arm_twist, by_X_and_Y, camera_board
from coursekit.hand_eye.views import PoseViews, Views
from coursekit.intrinsics.derivatives import scaled_inverse, scaled_root

GAUSS_NEWTON_STEPS, STEP_HALVINGS = 50, 10
NEGLIGIBLE_DECREASE = 1e-8  # of the sum of squares by a step: 1e-4 standard deviations
UNDETERMINED = 1e-13  # of the largest eigenvalue of the scaled information: nobody moves along it
SCATTER_ROUNDS, SCORING_STEPS = 6, 40  # of estimating how much poses scatter, and within a round
SETTLED = 1e-2  # of a variance: it is estimated
LEAST_OWN = 1e-14 * np.eye(6)  # rad^2, m^2: a pose's own error of which nothing is known
LEAST_FACTOR, MOST_FACTOR = 1e-4, 4.0  # of guessed variances: no unit is twice as bad as most
BEYOND_CHANCE = 3.3  # sigmas of a correlation: 1 in 2,000 sessions
FEWEST_TOLD = 5  # poses: with fewer nothing tells how far arm and images disagree
TWIST = ("rx", "ry", "rz", "tx", "ty", "tz")
JOINT_OFFSET = "offset of "  # how `arm.fk_covariance` names joint offsets
OFFSET_SIGMA_RAD = 0.05  # prior of joint offsets that are asked for: 3 deg, far above any unit's


# --- what is unknown ---


@dataclass(frozen=True, eq=False)
class State:
    """X, Y, the board's scale, joint offsets (6,) in rad, and the arm's errors in sigmas.

    shared (k,): of the unit. own (n, 6): of each pose, u_i, which moves what the camera sees of the
    board by the twist own_root_i u_i.
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
    q (n, 6): where joint offsets are asked for. fk: the arm's errors that are stated, or None.
    guessed: whether the sizes of what fk shares are a guess up to a common factor, which is then
    estimated too. own_root (n, 6, 6): of the covariance of each pose's own error, and factor: of
    the variances that fk shares; 0, as where only poses are known, and 1 before the estimate.
    """

    T_base_gripper: Floats
    mount: Mount
    views: Views
    free_scale: bool = False
    arm: Arm | None = None
    q: Floats | None = None
    fk: FkErrors | None = None
    guessed: bool = False
    own_root: Floats = field(default_factory=lambda: np.zeros((1, 6, 6)))
    factor: float = 1.0

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of the shared unknowns, in the order of the covariance: X's twist, Y's, and the rest."""
        names = [*TWIST, *(f"Y.{part}" for part in TWIST)]
        names += ["scale"] if self.free_scale else []
        names += [f"offset_{joint}" for joint in range(6)] if self.arm is not None else []
        return (*names, *(self._fk.names[column] for column in self._columns))

    @cached_property
    def _fk(self) -> FkErrors:
        """The arm's errors that are stated; without any, none that poses share and none of each."""
        n = len(self.T_base_gripper)
        return self.fk or FkErrors(np.zeros((n, 6, 0)), np.zeros(0), (), np.zeros((n, 6, 6)))

    @cached_property
    def _columns(self) -> list[int]:
        """The shared errors of the arm that are unknowns; joint offsets are not counted twice."""
        names = enumerate(self._fk.names)
        return [k for k, name in names if self.arm is None or not name.startswith(JOINT_OFFSET)]

    @cached_property
    def _offset_sigma(self) -> Floats:
        """The priors (6,) of joint offsets, rad; none where they are not asked for."""
        if self.arm is None:
            return np.zeros(0)
        known = dict(zip(self._fk.names, self._fk.sigma, strict=True))
        names = (JOINT_OFFSET + joint for joint in self.arm.joints)
        return np.array([known.get(name, OFFSET_SIGMA_RAD) for name in names])

    @cached_property
    def shared(self) -> Floats:
        """(n, 6, k): what one standard deviation of each shared error does at each pose."""
        return self._fk.shared[..., self._columns] * self._fk.sigma[self._columns]

    @cached_property
    def prior(self) -> Floats:
        """The information (g,) of the priors on the shared unknowns."""
        free, k = np.zeros(12 + self.free_scale), self.shared.shape[2]
        return np.concatenate([free, self._offset_sigma**-2.0, np.full(k, 1 / self.factor)])

    def values(self, state: State) -> Floats:
        """The unknowns `names` (g,): rad, m, and 0 for a rotation, which is counted from X or Y."""
        X, Y = ([0.0, 0.0, 0.0, *T[:3, 3]] for T in (state.X, state.Y))
        scale, offsets = [state.scale] * self.free_scale, state.offsets[: len(self._offset_sigma)]
        return np.concatenate([X, Y, scale, offsets, state.shared])

    def arm_twists(self, state: State) -> Floats:
        """The errors of the arm's poses that all of them share, as estimated, (n, 6)."""
        return self.shared @ state.shared

    def own_twists(self, state: State) -> Floats:
        """What each pose's own error does to where the camera sees the board, (n, 6)."""
        return np.einsum("nij,nj->ni", self.own_root, state.own)

    def weighed(self, own: Floats) -> Problem:
        """With each pose's own error of this covariance (n, 6, 6): beside pixels six unknowns more,
        and where only poses are known what they are weighed with."""
        if isinstance(self.views, PoseViews):
            views = replace(self.views, information=np.asarray(np.linalg.inv(own)))
            return replace(self, views=views)
        return replace(self, own_root=np.asarray(np.linalg.cholesky(own)))

    def with_own(self, state: State, twists: Floats) -> State:
        """The state with each pose's own error such that it does what twists (n, 6) say."""
        if isinstance(self.views, PoseViews):
            return state
        u = np.linalg.solve(self.own_root, twists[..., None])
        return replace(state, own=np.asarray(u[..., 0]))

    def reported(self, state: State) -> Floats:
        """T_base_gripper (n, 4, 4) of the reported joints with the offsets put right."""
        if self.arm is None or self.q is None:
            return self.T_base_gripper
        return self.arm.forward(self.q + state.offsets)

    def camera_board(self, state: State) -> Floats:
        """Where the camera should see the board, each pose's own error included, (n, 4, 4)."""
        expected = camera_board(self._arm_poses(state), state.X, state.Y, self.mount)
        return turned(expected, self.own_twists(state))

    def _arm_poses(self, state: State) -> Floats:
        return turned(self.reported(state), self.arm_twists(state))

    def own_parts(self, state: State) -> tuple[Floats, Floats]:
        """Of what the own errors may be: the stated covariance (n, 6, 6), and that of each size.

        The latter (k, n, 6, 6) is for a size of 1 rad or m about and along each axis: a turn and a
        shift of the gripper, and where only poses are known a turn of the board.
        """
        by_arm = by_arm_twist(self._arm_poses(state), state.X, state.Y, self.mount)
        halves = [by_arm[..., :3], by_arm[..., 3:]]
        if isinstance(self.views, PoseViews):  # a shift of the board is one of the gripper
            halves.append(np.broadcast_to(np.eye(6, 3), by_arm[..., :3].shape))
        stated = by_arm @ self._fk.each @ np.swapaxes(by_arm, 1, 2)
        return stated, np.stack([half @ np.swapaxes(half, 1, 2) for half in halves])

    def with_prior(self, state: State) -> Floats:
        """The unknowns (g,) that have priors, which are about 0; 0 for the others."""
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

    def equations(self, state: State) -> Equations:
        """The normal equations at a state."""
        squares, gradient, information = self.views.linear(self.camera_board(state), state.scale)
        shared, own = self._derivatives(state)
        pull = self.prior * self.with_prior(state)
        total = float(squares.sum() + pull @ self.with_prior(state) + (state.own**2).sum())
        return Equations(shared, own, gradient, information, self.prior, pull, state.own, total)

    def _derivatives(self, state: State) -> tuple[Floats, Floats]:
        """d the seven numbers of each view / d shared unknowns (n, 7, g), and / d own (n, 6, 6)."""
        arm_poses = self._arm_poses(state)
        given = arm_poses, state.X, state.Y, self.mount
        by_arm, n = by_arm_twist(*given), len(arm_poses)
        columns = [by_X_and_Y(*given), np.zeros((n, 6, int(self.free_scale)))]
        if self.arm is not None and self.q is not None:
            columns.append(by_arm @ self.arm.jacobian(self.q + state.offsets))
        columns.append(by_arm @ _growing(self.arm_twists(state)) @ self.shared)
        own = self.own_twists(state)
        by_pose = np.concatenate(columns, axis=2)
        by_pose[:, :3] = Rotation.from_rotvec(own[:, :3]).as_matrix() @ by_pose[:, :3]
        by_scale = np.zeros((n, 1, by_pose.shape[2]))
        by_scale[..., 12 : 12 + self.free_scale] = 1.0
        return np.concatenate([by_pose, by_scale], axis=1), _growing(own) @ self.own_root


def _growing(twists: Floats) -> Floats:
    """d turned pose / d twist where the turn is a vector that grows, (n, 6, 6).

    exp(a + b) = exp((1 + [a]x / 2) b) exp(a).
    """
    columns = np.tile(np.eye(6), (len(twists), 1, 1))
    columns[:, :3, :3] += cross_matrix(twists[:, :3]) / 2
    return columns


@dataclass(frozen=True, eq=False)
class Equations:
    """The normal equations of the shared unknowns (g) and each pose's own (6).

    shared (n, 7, g) and own (n, 6, 6): derivatives of each view's seven numbers. gradient
    (n, 7) and information (n, 7, 7): of those. prior (g,), pull (g,): information and gradient of
    the priors. u (n, 6): the own unknowns now, of unit variance. squares: the sum now.
    """

    shared: Floats
    own: Floats
    gradient: Floats
    information: Floats
    prior: Floats
    pull: Floats
    u: Floats
    squares: float

    @cached_property
    def _cross(self) -> Floats:
        """(n, 6, g): N_i between own and shared unknowns."""
        return np.swapaxes(self.own, 1, 2) @ (self.information[:, :6] @ self.shared)

    @cached_property
    def _own_inverse(self) -> Floats:
        inner = np.swapaxes(self.own, 1, 2) @ self.information[:, :6, :6] @ self.own
        return np.asarray(np.linalg.inv(inner + np.eye(6)))

    @cached_property
    def reduced(self) -> Floats:
        """What is known of the shared unknowns, the own ones unknown, (g, g)."""
        total = np.einsum("nki,nkj->ij", self.shared, self.information @ self.shared)
        total += np.diag(self.prior)
        total -= np.einsum("nki,nkj->ij", self._cross, self._own_inverse @ self._cross)
        return (total + total.T) / 2

    def step(self) -> tuple[Floats, Floats, float]:
        """The Gauss-Newton step, (g,) and (n, 6), and what it should take off the squares."""
        gradient = np.einsum("nki,nk->i", self.shared, self.gradient) - self.pull
        own_gradient = np.einsum("nki,nk->ni", self.own, self.gradient[:, :6]) - self.u
        inner = np.einsum("nij,nj->ni", self._own_inverse, own_gradient)
        reduced = gradient - np.einsum("nki,nk->i", self._cross, inner)
        change = determined_inverse(self.reduced) @ reduced
        own = inner - self._own_inverse @ self._cross @ change
        return change, own, float(change @ gradient + np.sum(own * own_gradient))


def determined_inverse(matrix: Floats) -> Floats:
    """The pseudo-inverse that leaves alone what the data say nothing about."""
    scale = np.sqrt(np.where(np.diag(matrix) > 0, np.diag(matrix), 1.0))
    units = np.outer(scale, scale)
    return np.linalg.pinv(matrix / units, rcond=UNDETERMINED, hermitian=True) / units


# --- how much poses scatter ---


@dataclass(frozen=True, eq=False)
class _Scatter:
    """The equations with each pose's own error in the noise, for any sizes of that error.

    rows (m, 6): how far each view is from where it is expected without an own error. columns
    (m, 6, g): by the shared unknowns. image (m, 6, 6): covariance of the rows but for the parts
    (k, m, 6, 6), each times one of `sizes` (k,), variances in rad^2 or m^2; none is below least
    (k,). prior (g,): information of the unknowns, at `values` (g,). m is the number of views n, and
    beyond it of the shared errors whose sizes are guessed, in sixes: as if each had been seen to be
    0, with a variance that is one more size.
    """

    rows: Floats
    columns: Floats
    image: Floats
    parts: Floats
    least: Floats
    prior: Floats
    values: Floats
    sizes: Floats

    @classmethod
    def of(cls, problem: Problem, state: State, sizes: Floats) -> _Scatter:
        """The equations of a problem at a state."""
        at = problem.equations(state)
        image = np.asarray(np.linalg.inv(at.information[:, :6, :6]))
        rows = np.einsum("nij,nj->ni", image, at.gradient[:, :6]) + problem.own_twists(state)
        columns = image @ (at.information[:, :6] @ at.shared)
        stated, parts = problem.own_parts(state)
        if isinstance(problem.views, PoseViews):
            image = np.zeros_like(image)
        else:
            parts = np.concatenate([parts, image[None]])
        image, values, prior = image + stated + LEAST_OWN, problem.with_prior(state), at.prior
        least = np.full(len(parts), LEAST_OWN[0, 0])
        if problem.guessed:
            (n, _, g), k, m = columns.shape, len(parts), problem.shared.shape[2]
            sixes = np.eye(g + -m % 6)[g - m :, :g].reshape(-1, 6, g)
            filled = np.eye(6) * (1.0 - sixes.sum(axis=2))[..., None]
            rows = np.concatenate([rows, -sixes @ values])
            columns, image = np.concatenate([columns, sixes]), np.concatenate([image, filled])
            beside = np.zeros((k + 1, len(rows), 6, 6))
            beside[:k, :n], beside[k, n:] = parts, np.eye(6) - filled
            prior = np.append(prior[:-m], np.zeros(m))
            parts, least = beside, np.append(least, LEAST_FACTOR)
        return cls(rows, columns, image, parts, least, prior, values, sizes)

    @cached_property
    def own(self) -> Floats:
        """The covariance (m, 6, 6) of the own errors that are estimated."""
        return np.einsum("k,knij->nij", self.sizes, self.parts)

    @cached_property
    def _inverse(self) -> Floats:
        return np.asarray(np.linalg.inv(self.image + self.own))

    @cached_property
    def _weighted(self) -> Floats:
        return self._inverse @ self.columns

    @cached_property
    def _known(self) -> Floats:
        """The covariance (g, g) if the sizes were known."""
        information = np.tensordot(self.columns, self._weighted, ([0, 1], [0, 1]))
        return scaled_inverse(information + np.diag(self.prior))

    @cached_property
    def _by_size(self) -> Floats:
        """(k, g, g): what the information loses as a size grows."""
        spread = self.parts @ self._weighted
        return np.stack([np.tensordot(self._weighted, one, ([0, 1], [0, 1])) for one in spread])

    @cached_property
    def _by_two(self) -> Floats:
        """(k, k, g, g): the same for two of them."""
        spread = self.parts @ self._weighted
        return np.array([
            [np.tensordot(one, other, ([0, 1], [0, 1])) for other in self._inverse @ spread]
            for one in spread
        ])  # fmt: skip

    @cached_property
    def _of_sizes(self) -> Floats:
        """The expected information (k, k) of the sizes."""
        each = self._inverse @ self.parts
        trace = np.einsum("knij,lnji->kl", each, each)
        moved = self._known @ self._by_size
        trace -= 2 * np.einsum("ab,klba->kl", self._known, self._by_two)
        return (trace + np.einsum("kab,lba->kl", moved, moved)) / 2

    def _slope(self) -> Floats:
        """d restricted log likelihood / d sizes, (k,)."""
        pull = np.einsum("nia,ni->a", self._weighted, self.rows) - self.prior * self.values
        left = self.rows - self.columns @ (self._known @ pull)
        left = np.einsum("nij,nj->ni", self._inverse, left)
        squares = np.einsum("ni,knij,nj->k", left, self.parts, left)
        trace = np.einsum("nij,knji->k", self._inverse, self.parts)
        trace -= np.einsum("ab,kba->k", self._known, self._by_size)
        return (squares - trace) / 2

    def estimated(self) -> _Scatter:
        """With the most likely sizes: Fisher scoring; a size that wants to be negative is least."""
        now, least = self, self.least
        for _ in range(SCORING_STEPS):
            slope, step = now._slope(), np.zeros(len(least))
            free = (now.sizes > least) | (slope > 0)
            step[free] = determined_inverse(now._of_sizes[np.ix_(free, free)]) @ slope[free]
            sizes = np.clip(now.sizes + step, np.maximum(now.sizes / 10, least), 10 * now.sizes)
            sizes = np.where(least == LEAST_FACTOR, np.minimum(sizes, MOST_FACTOR), sizes)
            settled = np.allclose(sizes, now.sizes, rtol=SETTLED, atol=0)
            now = replace(now, sizes=sizes)
            if settled:
                break
        return now

    @property
    def whitened(self) -> Floats:
        """The rows (m, 6) in units of their sigmas."""
        return np.einsum("nji,nj->ni", np.linalg.cholesky(self._inverse), self.rows)

    @cached_property
    def _unsure(self) -> Floats:
        """The covariance (k, k) of the sizes; one that is nothing is known to be."""
        some = self.sizes > 2 * self.least
        unsure = np.zeros_like(self._of_sizes)
        unsure[np.ix_(some, some)] = determined_inverse(self._of_sizes[np.ix_(some, some)])
        return unsure

    @cached_property
    def covariance(self) -> Floats:
        """Of the shared unknowns, (g, g), wider for what is not known of the sizes.

        Wider, never narrower: where the data say nothing, rounding has either sign.
        """
        lost = np.tensordot(self._unsure, self._by_two, 2)
        moved = np.tensordot(self._unsure, self._by_size, 1)
        lost -= np.einsum("kab,kbc->ac", self._by_size, self._known @ moved)
        added = self._known @ scaled_root(lost)
        return self._known + 2 * added @ added.T

    @cached_property
    def dof(self) -> Floats:
        """Degrees of freedom (g,) that the variance of each of the shared unknowns rests on."""
        grows = np.einsum("ab,kbc,ca->ka", self._known, self._by_size, self._known, optimize=True)
        spread = np.einsum("ka,kl,la->a", grows, self._unsure, grows)
        known = np.diag(self._known) ** 2
        return np.maximum(2 * known / np.maximum(spread, 1e-12 * known), 1.0)


# --- the fit ---


@dataclass(frozen=True, eq=False)
class Refined:
    """Where the refinement ended.

    covariance (g, g): of the shared unknowns `problem.names`, widened for what so few poses leave
    unknown of their own errors: 1.96 of its sigmas are Student's 95 % interval, infinite below
    `FEWEST_TOLD` poses. sizes (k,): how much poses scatter about and along each axis: the gripper's
    turn and shift, rad and m; of images the error beyond their corners' noise in units of that
    noise, or of poses the board's turn, rad; and, where they were guessed, the factor on the sigmas
    of what fk shares. alike: correlation of successive
    poses' own errors, 0 unless it is beyond chance; the covariance is wider for it. far (n,): the
    size of each pose's own error, in sigmas of an axis. converged: whether another step would
    change anything.
    """

    problem: Problem
    state: State
    covariance: Floats
    sizes: Floats
    alike: float
    far: Floats
    converged: bool


def refine(problem: Problem, X: Floats, Y: Floats, measured: Floats) -> Refined:
    """The most probable state of a problem, from a start X, Y that is roughly right.

    measured (n, 4, 4): T_camera_board as each view by itself says, where the own errors start from.
    """
    n, _, k = problem.shared.shape
    state = State(X, Y, 1.0, np.zeros(6), np.zeros(k), np.zeros((n, 6)))
    off = pose_difference(problem.camera_board(state), measured)
    problem = problem.weighed(np.tile(np.eye(6), (n, 1, 1)))
    scatter = _Scatter.of(problem, problem.with_own(state, off), np.zeros(0))
    turn_shift = np.mean(off.reshape(n, 2, 3) ** 2, axis=(0, 2)) / 2 + LEAST_OWN[0, 0]
    sizes = [*turn_shift, turn_shift[0] if isinstance(problem.views, PoseViews) else 1.0]
    scatter = replace(scatter, sizes=np.array(sizes + [1.0] * problem.guessed))
    for _ in range(SCATTER_ROUNDS):
        before, scatter = scatter.sizes, scatter.estimated()
        own = scatter.own[:n] + problem.own_parts(state)[0] + LEAST_OWN
        factor = float(scatter.sizes[-1]) if problem.guessed else 1.0
        problem = replace(problem.weighed(own), factor=factor)
        state, converged = _minimise(problem, problem.with_own(state, off))
        off, scatter = problem.own_twists(state), _Scatter.of(problem, state, scatter.sizes)
        if np.allclose(before, scatter.sizes, rtol=2 * SETTLED, atol=0):
            break
    far, turns = scatter.whitened[:n], problem.camera_board(state)[:, :3, :3]
    in_board = np.einsum("nji,nkj->nki", turns, far.reshape(n, 2, 3)).reshape(n, 6)
    alike = max(map(_alike, (far, in_board)))  # a camera that sinks, or a board that slides
    student = stdtrit(scatter.dof, 0.975) / stdtrit(np.inf, 0.975)
    wider = student * np.sqrt((1 + alike) / (1 - alike))
    covariance = scatter.covariance * np.outer(wider, wider)
    if n < FEWEST_TOLD:
        covariance = np.diag(np.full(len(wider), np.inf))
    each = np.sqrt(np.mean(far**2, axis=1))
    return Refined(problem, state, covariance, np.sqrt(scatter.sizes), alike, each, converged)


def _alike(errors: Floats) -> float:
    """The correlation of successive rows (n, 6), each of unit variance; 0 where chance does it."""
    along = float(np.sum(errors[1:] * errors[:-1]) / max(np.sum(errors**2), 1e-300))
    return along if along * np.sqrt(errors.size) > BEYOND_CHANCE else 0.0


def _minimise(problem: Problem, state: State) -> tuple[State, bool]:
    equations = problem.equations(state)
    for _ in range(GAUSS_NEWTON_STEPS):
        change, own, decrease = equations.step()
        if decrease < NEGLIGIBLE_DECREASE:
            return state, True
        for halving in range(STEP_HALVINGS):
            trial = problem.step(state, change / 2**halving, own / 2**halving)
            now = problem.equations(trial)
            if now.squares <= equations.squares * (1 + 1e-14):
                break
        else:
            return state, decrease < 1e-3
        state, equations = trial, now
    return state, False


def arm_poses_with(refined: Refined, other: Problem) -> Floats:
    """The arm poses (m, 4, 4) of another problem, put right by what was learnt of the arm.

    other: with poses of the same arm; its q where joint offsets were estimated, and its fk where
    the arm's shared errors were. What a pose has for itself (gear play) is not known there.
    """
    reported = other.reported(refined.state)
    return reported if other.fk is None else turned(reported, other.arm_twists(refined.state))
