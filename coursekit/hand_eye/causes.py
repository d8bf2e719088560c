"""What the residuals of a hand-eye fit speak for: likelihood-ratio tests between causes.

Residuals are taken as normal with the covariance of what careful people have: the board pose's, as
the image says, and the arm's (`arm.fk_covariance`), most of which all poses share. Since arms
differ the latter is multiplied by a factor that is fitted anew under each suspicion, so that no
cause passes for a bad arm or the other way round. Each suspected cause adds columns: a scale, a
delay, a board that moved between two poses, one pose that is off, the zero of a joint. The one that
explains most is taken in, the fit repeated, and the others are tested once more.

Where the joint angles are not known, the arm's error is taken as independent from pose to pose, of
the size that the residuals have.

Source: Seber and Lee, "Linear Regression Analysis" (2003), chapters 3 and 4.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from coursekit.arm import Arm, ArmErrors, fk_covariance
from coursekit.arrays import Floats, NDArray
from coursekit.geometry import turned
from coursekit.hand_eye.pairs import LEAST_M, LEAST_RAD, MEDIAN_3D, Fit, Pairs, robust_fit
from coursekit.hand_eye.poses import by_arm_twist

SCALE, LATE, SLIP, OUTLIER, OFFSET = (
    "wrong_square_size", "late_time_stamps", "slipping_board", "outlier_pose", "arm_error",
)  # fmt: skip
SMOOTH = (SCALE, LATE, OFFSET)  # one number that acts on all pairs
# At most 2 % of healthy sessions may get a finding, and five kinds of test at this level make
# 0.05 %; the rest is for arms whose errors are not quite normal.
LEVEL = 1e-4
# What careful people have, and no finding: squares measured with a ruler, a driver's own delay, a
# board that settles, a pose in which the arm still swings, a zero that a jig sets.
NORMAL = {SCALE: 0.01, LATE: 5e-3, SLIP: 2e-3, OUTLIER: 5e-3, OFFSET: np.radians(0.6)}
NORMAL_TURN_RAD = {SLIP: np.radians(0.5), OUTLIER: np.radians(1.0)}
# Times as much, where no image says how well it knows its board pose, or no joint angles what the
# arm may be wrong by: some pose of a healthy one is off by four times the typical error.
ROUGH = 3.0
# Times the typical residual, where no joint angles say which errors poses share: those of the arm
# then look like a slip of their own size.
SLIP_OVER_USUAL, OUTLIER_OVER_USUAL = 2.5, 4.0
SCALE_WITHOUT_JOINTS = 0.02  # the arm's own shared errors can imitate that much of a scale
CAMERA_RAD, CAMERA_M = np.radians(0.02), 1e-4  # what imperfect intrinsics do to a board's pose
# Of the arm's stated errors; one that is worse than the last is itself a mistake. A larger factor
# also drowns two bad poses, and lets a nonsensical scale explain what is left.
FACTORS = (1.0, 1.5, 2.0, 3.0, 5.0)
FACTORS_WITHOUT_JOINTS = (0.1, 0.2, 0.35, 0.6, 1.0, 1.5)  # of the residuals as they are
SHORTEST = 3  # pairs on either side of a slip
FEWEST = 6  # pairs below which one odd pose cannot be told from 24 odd numbers
MOST_ROUNDS = 8


@dataclass(frozen=True, eq=False)
class Arms:
    """What is known of the arm besides its poses: for all pairs of the session.

    velocity (n, 6): the gripper's twist rate when the image was taken, rad/s and m/s, None where
    unknown. q (n, 6): joint angles, rad, None where unknown.
    """

    arm: Arm | None = None
    errors: ArmErrors | None = None
    q: Floats | None = None
    velocity: Floats | None = None


@dataclass(frozen=True, eq=False)
class Tested:
    """A cause: twice the log-likelihood that it gains, log p, its coefficients, their covariance.

    at: the first pair after a slip, the odd pair, or the joint.
    """

    cause: str
    gain: float
    log_p: float
    size: Floats
    covariance: Floats
    at: int = 0

    @property
    def p_value(self) -> float:
        """How often chance alone would explain as much."""
        return float(np.exp(self.log_p))

    @property
    def sigma(self) -> float:
        """Of the first coefficient."""
        return float(np.sqrt(self.covariance[0, 0]))


@dataclass(eq=False)
class Accepted:
    """A cause that was taken in, with the fits before and after."""

    test: Tested
    view: int  # the pair's number in the session, where `at` is a pair
    before: Fit
    after: Fit


@dataclass(eq=False)
class Search:
    """Where the search is: the pairs with the causes found so far put right, and their fit."""

    arms: Arms
    fit: Fit
    scale: float = 1.0
    delay_s: float = 0.0
    offsets: Floats = field(default_factory=lambda: np.zeros(6))
    accepted: list[Accepted] = field(default_factory=list)
    refused: set[tuple[str, int]] = field(default_factory=set)


def search(pairs: Pairs, arms: Arms, fit: Fit) -> Search:
    """The causes that the residuals of pairs speak for, the strongest first."""
    state = Search(arms, fit)
    for _ in range(MOST_ROUNDS):
        if len(state.fit.pairs) < FEWEST:
            break
        best = min(_significant(state), key=lambda test: test.log_p, default=None)
        if best is None:
            break
        after = _with(state, best)
        if best.cause in SMOOTH and after.fit.better_than(state.fit) <= 1.0:
            state.refused.add((best.cause, best.at))  # linear, it fitted; in full it does not
        else:
            state = after
    return state


def _significant(state: Search) -> Iterator[Tested]:
    done = {(one.test.cause, one.test.at) for one in state.accepted if one.test.cause in SMOOTH}
    odd = sum(one.test.cause == OUTLIER for one in state.accepted)
    for test in _tests(state, without=done | state.refused):
        if test.log_p > np.log(LEVEL) or not _matters(state, test):
            continue
        if test.cause == OUTLIER and odd >= (len(state.fit.pairs) + odd) // 4:
            continue
        yield test


def _matters(state: Search, test: Tested) -> bool:
    """Whether the effect is larger than what careful people have."""
    normal = NORMAL[test.cause]
    if test.cause == SCALE and state.arms.q is None:
        normal = SCALE_WITHOUT_JOINTS
    if test.cause in (SLIP, OUTLIER):
        turn, shift = np.linalg.norm(test.size[:3]), np.linalg.norm(test.size[3:])
        least_turn, least_shift = _least(state, test.cause)
        return bool(shift > least_shift or turn > least_turn)
    return bool(abs(test.size[0]) > normal)


def _least(state: Search, cause: str) -> tuple[float, float]:
    """The smallest turn (rad) and shift (m) of a slip or an odd pose that matters."""
    known = state.fit.pairs.image.any() and state.arms.q is not None
    rough = 1.0 if known else ROUGH
    turn, shift = rough * NORMAL_TURN_RAD[cause], rough * NORMAL[cause]
    if state.arms.q is None:
        usual = SLIP_OVER_USUAL if cause == SLIP else OUTLIER_OVER_USUAL
        turn = max(turn, usual * state.fit.turn_rad)
        shift = max(shift, usual * state.fit.shift_m)
    return turn, shift


# --- the tests ---


def _tests(state: Search, without: set[tuple[str, int]]) -> list[Tested]:
    """All suspected causes, each with its most likely size of the arm's errors.

    without: those that were accepted or refused. Smooth ones that were accepted are fitted along.
    """
    fit = state.fit
    every = list(_suspects(state))
    accepted = {(one.test.cause, one.test.at) for one in state.accepted}
    along = [block for cause, at, _, block in every if cause in SMOOTH and (cause, at) in accepted]
    suspects = [suspect for suspect in every if suspect[:2] not in without]
    best = np.full(len(suspects), np.inf)
    found: list[tuple[Floats, Floats]] = [(np.zeros(0), np.zeros(0))] * len(suspects)
    plain = np.inf
    residuals = fit.twists.ravel()
    columns = np.hstack([fit.columns.reshape(len(residuals), -1), *along])
    for covariance in _covariances(state):
        information, log_det = _inverse(covariance)
        weighted = information @ columns
        normal = np.linalg.pinv(columns.T @ weighted, rcond=1e-12, hermitian=True)
        P = information - weighted @ normal @ weighted.T
        seen = P @ residuals
        deviance = log_det + float(residuals @ seen)
        plain = min(plain, deviance)
        for number, (_, _, rows, block) in enumerate(suspects):
            inner = block.T @ P[np.ix_(rows, rows)] @ block
            right = block.T @ seen[rows]
            inverse: Floats = np.asarray(
                np.linalg.pinv(inner, rcond=1e-9, hermitian=True), np.float64
            )
            size: Floats = np.asarray(inverse @ right, np.float64)
            now = deviance - float(right @ size)
            if now < best[number]:
                best[number], found[number] = now, (size, inverse)
    counts = {c: sum(s[0] == c for s in suspects) for c in NORMAL}
    return [
        _tested(cause, at, plain - best[i], *found[i], counts[cause])
        for i, (cause, at, _, _) in enumerate(suspects)
    ]


def _tested(
    cause: str, at: int, gain: float, size: Floats, covariance: Floats, tried: int
) -> Tested:
    log_p = _log_chi2_tail(max(gain, 0.0), len(size)) + float(np.log(tried))
    return Tested(cause, gain, min(log_p, 0.0), size, covariance, at)


def _log_chi2_tail(x: float, dof: int) -> float:
    """log P(chi2 > x), beyond what a float holds by its asymptote: causes compete out there."""
    from scipy.special import chdtrc, gammaln

    tail = float(chdtrc(dof, x))
    if tail > 1e-290:
        return float(np.log(tail))
    return float((dof / 2 - 1) * np.log(x / 2) - x / 2 - gammaln(dof / 2))


def _inverse(covariance: Floats) -> tuple[Floats, float]:
    root = np.linalg.cholesky(covariance)
    inverse = np.linalg.inv(root)
    return inverse.T @ inverse, 2.0 * float(np.log(np.diag(root)).sum())


def _covariances(state: Search) -> Iterator[Floats]:
    """Of all residuals, (6 n, 6 n), for each factor of the arm's errors."""
    pairs, n = state.fit.pairs, len(state.fit.pairs)
    camera = pairs.image + np.diag(np.repeat([CAMERA_RAD**2, CAMERA_M**2], 3))
    by_arm = _by_arm(state.fit)
    if state.arms.q is not None and state.arms.arm is not None:
        q = state.arms.q[pairs.row] + state.offsets
        errors = fk_covariance(q, state.arms.errors, state.arms.arm)
        shared = by_arm @ errors.shared * errors.sigma
        shared = shared.reshape(6 * n, -1)
        arm = shared @ shared.T + _diagonal(by_arm @ errors.each @ np.swapaxes(by_arm, 1, 2))
        factors: tuple[float, ...] = FACTORS
    else:
        turn = max(state.fit.turn_rad / MEDIAN_3D, LEAST_RAD)
        shift = max(state.fit.shift_m / MEDIAN_3D, LEAST_M)
        arm = np.diag(np.tile(np.repeat([turn**2, shift**2], 3), n))
        factors = FACTORS_WITHOUT_JOINTS
    image = _diagonal(camera)
    for factor in factors:
        yield image + factor**2 * arm


def _diagonal(blocks: Floats) -> Floats:
    """(n, 6, 6) along the diagonal of (6 n, 6 n)."""
    n = len(blocks)
    full = np.zeros((n, 6, n, 6))
    full[np.arange(n), :, np.arange(n)] = blocks
    return full.reshape(6 * n, 6 * n)


def _by_arm(fit: Fit) -> Floats:
    """d predicted twist / d the gripper's twist in the base's axes, (n, 6, 6)."""
    by_arm = np.empty((len(fit.pairs), 6, 6))
    for number, Y in enumerate(fit.Y):
        mine = fit.pairs.segment == number
        poses = fit.pairs.T_base_gripper[mine]
        by_arm[mine] = by_arm_twist(poses, fit.X, Y, fit.pairs.mount)
    return by_arm


def _suspects(state: Search) -> Iterator[tuple[str, int, NDArray[np.intp], Floats]]:
    """Cause, place, rows of the residuals (r,) and columns (r, k) of each suspicion."""
    fit, n = state.fit, len(state.fit.pairs)
    every = np.arange(6 * n)
    scale = np.zeros((n, 6))
    scale[:, 3:] = -fit.pairs.T_camera_board[:, :3, 3]
    yield SCALE, 0, every, scale.reshape(-1, 1)
    by_arm = _by_arm(fit)
    if state.arms.velocity is not None:
        moved = np.einsum("nij,nj->ni", by_arm, state.arms.velocity[fit.pairs.row])
        yield LATE, 0, every, -moved.reshape(-1, 1)
    if state.arms.q is not None and state.arms.arm is not None:
        q = state.arms.q[fit.pairs.row] + state.offsets
        turned_joint = (by_arm @ state.arms.arm.jacobian(q)).reshape(6 * n, 6)
        for joint in range(1, 5):  # the first turns the base and the last the gripper: so do X, Y
            yield OFFSET, joint, every, turned_joint[:, joint : joint + 1]
    for view in range(n):
        yield OUTLIER, view, np.arange(6 * view, 6 * view + 6), np.eye(6)
    by_Y = fit.columns[:, :, 6:].reshape(n, 6, -1, 6).sum(axis=2)
    for at in range(1, n):
        mine = np.flatnonzero(fit.pairs.segment == fit.pairs.segment[at])
        before, after = mine[mine < at], mine[mine >= at]
        if len(before) >= SHORTEST and len(after) >= SHORTEST:
            rows = (6 * after[:, None] + np.arange(6)).ravel()
            yield SLIP, at, rows, by_Y[after].reshape(-1, 6)


# --- taking a cause in ---


def _with(state: Search, test: Tested) -> Search:
    """The search with the data put right for a cause, and fitted again."""
    before, pairs = state.fit, state.fit.pairs
    view = int(pairs.view[test.at]) if test.cause in (SLIP, OUTLIER) else test.at
    size = float(test.size[0])
    new, start = replace(state), None
    if test.cause == SCALE:
        new.scale = state.scale * (1.0 + size)
        pairs = pairs.scaled(1.0 + size)
    elif test.cause == OUTLIER:
        pairs = pairs.keep(np.arange(len(pairs)) != test.at)
    elif test.cause == SLIP:
        segment = pairs.segment.copy()
        moved = turned(before.Y[segment[test.at]], test.size)
        segment[(segment == segment[test.at]) & (np.arange(len(pairs)) >= test.at)] = len(before.Y)
        start = (before.X, np.concatenate([before.Y, moved[None]]))
        pairs = replace(pairs, segment=segment)
    elif test.cause == LATE:
        assert state.arms.velocity is not None
        new.delay_s = state.delay_s + size
        pairs = _moved(pairs, -size * state.arms.velocity[pairs.row])
    else:
        change = size * np.eye(6)[test.at]
        assert state.arms.arm is not None
        assert state.arms.q is not None
        q = state.arms.q[pairs.row] + state.offsets
        new.offsets = state.offsets + change
        pairs = _moved(pairs, state.arms.arm.jacobian(q) @ change)
    new.fit = robust_fit(pairs, start)
    new.accepted = [*state.accepted, Accepted(test, view, before, new.fit)]
    return new


def _moved(pairs: Pairs, twists: Floats) -> Pairs:
    """The pairs with their arm poses moved by twists (n, 6)."""
    return replace(pairs, T_base_gripper=turned(pairs.T_base_gripper, twists))
