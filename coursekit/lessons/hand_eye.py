"""Notebook 04: its two exercises and the mistakes that people make in them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arrays import Floats
from coursekit.geometry import make_transform
from coursekit.lessons.exercises import Exercise, Step, Steps, in_digits

Pair = tuple[Floats, Floats]


def _pose(rng: np.random.Generator, reach_m: float = 0.5) -> Floats:
    turn = Rotation.from_rotvec(rng.uniform(-1.2, 1.2, 3))
    return make_transform(turn, rng.uniform(-reach_m, reach_m, 3))


# --- motion_pair ---


def _motion_pair(
    steps: Steps, gripper_i: Floats, gripper_j: Floats, board_i: Floats, board_j: Floats
) -> Floats:
    i, j, seen_i, seen_j = steps["read"](gripper_i, gripper_j, board_i, board_j)
    A = steps["A"](*steps["A pair"](i, j), steps["inverse"])
    B = steps["B"](*steps["B pair"](seen_i, seen_j), steps["inverse"])
    return steps["order"](A, B)


def _session_pair(seed: int, plain: bool = False) -> tuple[Floats, ...]:
    """Two arm poses and the board as the camera saw it at each, of one and the same X."""
    rng = np.random.default_rng(seed)
    X, board = _pose(rng, 0.1), _pose(rng)
    i, j = _pose(rng), _pose(rng)
    if plain:  # turns by quarter of a circle and whole centimetres, to work by hand
        X = make_transform(np.eye(3), (0.0, 0.0, 0.1))
        board = make_transform(np.eye(3), (0.3, 0.0, 0.9))
        i = make_transform(np.eye(3), (0.3, 0.0, 0.4))
        j = make_transform(Rotation.from_euler("z", 90, degrees=True), (0.4, 0.1, 0.5))
    seen = (np.linalg.inv(pose @ X) @ board for pose in (i, j))
    return i, j, *seen


def _describe_pair(args: tuple[Floats, ...]) -> str:
    places = [T[:3, 3].round(3).tolist() for T in args]
    text = "the gripper at {} and {} m in the base, the board at {} and {} m before the camera"
    turned = args[1][0, 0] == args[1][1, 1] and abs(args[1][0, 0]) < 1e-9
    end = ", the second arm pose turned by 90 degrees about z" if turned else ""
    return text.format(*places) + end


def _pair_by_halves(gripper_i: Floats, gripper_j: Floats, board_i: Floats, board_j: Floats) -> Any:
    A, B = np.eye(4), np.eye(4)
    A[:3, :3] = gripper_j[:3, :3].T @ gripper_i[:3, :3]
    A[:3, 3] = gripper_j[:3, :3].T @ (gripper_i[:3, 3] - gripper_j[:3, 3])
    B[:3, :3] = board_j[:3, :3] @ board_i[:3, :3].T
    B[:3, 3] = board_j[:3, 3] - B[:3, :3] @ board_i[:3, 3]
    return A, B


MOTION_PAIR = Exercise.told(
    "hand_eye.motion_pair",
    build=_motion_pair,
    steps={
        "read": lambda *poses: poses,
        "inverse": np.linalg.inv,
        "A pair": lambda i, j: (i, j),
        "A": lambda gripper_i, gripper_j, inverse: inverse(gripper_j) @ gripper_i,
        "B pair": lambda i, j: (i, j),
        "B": lambda board_i, board_j, inverse: board_j @ inverse(board_i),
        "order": lambda A, B: np.stack([A, B]),
    },
    cases=[_session_pair(0, plain=True), *(_session_pair(seed) for seed in range(1, 5))],
    describe=_describe_pair,
    show=lambda row: "translations of A and B {} and {}".format(
        *(in_digits("(.3f)", T[:3, 3]) for T in row)
    ),
    styles=[_pair_by_halves],
)


def _places_subtracted(motion: Step, sign: int) -> Step:
    """The rotation of a motion, and the difference of the two places."""

    def wrong(i: Floats, j: Floats, inverse: Step) -> Floats:
        return make_transform(motion(i, j, inverse)[:3, :3], sign * (i - j)[:3, 3])

    return wrong


for _step in ("A", "B"):
    _motion = MOTION_PAIR.steps[_step]
    MOTION_PAIR.add_mistakes(
        (_step, "one_not_inverted", lambda i, j, inverse: j @ i),
        (_step, "one_pose_only", lambda i, j, inverse: np.eye(4)),
        (_step, "product_inverted", lambda i, j, inverse: inverse(j @ i)),
        (_step, "product_inverted", lambda i, j, inverse: inverse(i @ j)),
        (_step, "elementwise", lambda i, j, inverse: inverse(j) * i),
        (_step, "elementwise", lambda i, j, inverse: j * inverse(i), lambda i, j, _: j * i),
        (_step, "subtracted", lambda i, j, inverse: j - i, lambda i, j, inverse: i - j),
        (_step, "places_subtracted", *(_places_subtracted(_motion, sign) for sign in (1, -1))),
    )
MOTION_PAIR.add_mistakes(
    ("read", "gripper_twice", lambda gi, gj, bi, bj: (gi, gj, gi, gj)),
    ("read", "arm_and_board", lambda gi, gj, bi, bj: (bi, bj, gi, gj)),
    ("read", "board_twice", lambda gi, gj, bi, bj: (bi, bj, bi, bj)),
    ("inverse", "transposed_pose", lambda T: T.T),
    ("inverse", "translation_not_turned", lambda T: make_transform(T[:3, :3].T, -T[:3, 3])),
    ("inverse", "turned_back", lambda T: make_transform(T[:3, :3].T, -T[:3, :3] @ T[:3, 3])),
    ("read", "mixed", lambda i, j, k, m: (k, i, np.linalg.inv(m), np.linalg.inv(j))),
    ("inverse", "not_inverted", lambda T: T),
    ("A", "motion_in_base", lambda i, j, inverse: j @ inverse(i)),
    ("A pair", "a_exchanged", lambda i, j: (j, i)),
    ("B pair", "b_exchanged", lambda i, j: (j, i)),
    ("B", "motion_in_board", lambda i, j, inverse: inverse(j) @ i),
    ("order", "both_exchanged", lambda A, B: np.stack([np.linalg.inv(A), np.linalg.inv(B)])),
    ("A", "other_order", lambda i, j, inverse: i @ inverse(j)),
    ("B", "other_order", lambda i, j, inverse: inverse(i) @ j),
)


# --- rotation_half ---


def _turn(a: Floats, b: Floats) -> Floats:
    """The rotation that takes each b to its a: Kabsch's; the smallest one for a single pair."""
    if len(a) == 1:
        return np.asarray(Rotation.align_vectors(a, b)[0].as_matrix())
    U, _, Vt = np.linalg.svd(a.T @ b)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt


def _rotation_half(steps: Steps, R_A: Floats, R_B: Floats) -> Floats:
    return steps["result"](steps["turn"](*steps["used"](*steps["axes"](R_A, R_B))))


def _motions(seed: int, n: int, parallel: bool = False) -> Pair:
    """n motions and what the camera saw of them, without noise; parallel: the first two are."""
    rng = np.random.default_rng(seed)
    X = Rotation.from_rotvec(rng.uniform(-1.5, 1.5, 3))
    turns = rng.uniform(-1.2, 1.2, (n, 3))
    turns[0] = turns[1] / 2 if parallel else turns[0]
    A = Rotation.from_rotvec(turns)
    return A.as_matrix(), (X.inv() * A * X).as_matrix()


def _parallel(R: Floats) -> bool:
    first, second = Rotation.from_matrix(R[:2]).as_rotvec()
    return bool(np.linalg.norm(np.cross(first, second)) < 1e-9)


def _quarter_turns() -> Pair:
    """X turns by 90 degrees about z; the arm about x and then about y."""
    X = Rotation.from_euler("z", 90, degrees=True)
    A = Rotation.from_euler("xy", [[60, 0], [0, 40]], degrees=True)
    return A.as_matrix(), (X.inv() * A * X).as_matrix()


def _half_by_null_space(R_A: Floats, R_B: Floats, row: int = -1) -> Any:
    eye = np.eye(3)
    M = np.vstack([np.kron(A, eye) - np.kron(eye, B.T) for A, B in zip(R_A, R_B, strict=True)])
    X = np.linalg.svd(M)[2][row].reshape(3, 3)
    X = X * np.sign(np.linalg.det(X))
    U, _, Vt = np.linalg.svd(X)
    return U @ Vt


ROTATION_HALF = Exercise.told(
    "hand_eye.rotation_half",
    build=_rotation_half,
    steps={
        "axes": lambda *motions: [Rotation.from_matrix(R).as_rotvec() for R in motions],
        "used": lambda a, b: (a, b),
        "turn": _turn,
        "result": lambda R: R,
    },
    cases=[
        _quarter_turns(),
        *(_motions(seed, 2) for seed in (1, 5, 6, 7, 8)),
        _motions(2, 3),
        _motions(9, 3, parallel=True),
        _motions(3, 6),
        _motions(4, 20),
    ],
    describe=lambda args: (
        "the arm turns by 60 degrees about x, then by 40 about y; X is a quarter turn about z"
        if np.array_equal(args[0], _quarter_turns()[0])
        else f"{len(args[0])} motions" + ", the first two about one axis" * _parallel(args[0])
    ),
    show=lambda R: "; ".join(" ".join(f"{v:.3f}" for v in row) for row in np.atleast_2d(R)),
    styles=[_half_by_null_space],
)


def _no_signs(*motions: Floats) -> list[Floats]:
    """The axes as eigenvectors have them."""
    eigen = [[np.linalg.eig(R) for R in motion] for motion in motions]
    return [np.array([V[:, np.argmin(abs(w - 1))].real for w, V in found]) for found in eigen]


def _flipped(signs: Floats) -> Step:
    return lambda *motions: [signs * Rotation.from_matrix(R).as_rotvec() for R in motions]


def _same_frame(A: Floats, B: Floats) -> Floats:
    return np.asarray((A @ np.swapaxes(B, 1, 2)).mean(axis=0))


def _mean_turn(R: Floats) -> Floats:
    return np.asarray(Rotation.from_matrix(R).mean().as_matrix())


def _kabsch(multiply: Callable[[Floats, Floats], Floats], exchanged: bool, unit: bool) -> Step:
    """Kabsch's method with another product of U and V^T, of b^T a or a^T b, of unit axes or not."""

    def turn(a: Floats, b: Floats) -> Floats:
        first, second = (b, a) if exchanged else (a, b)
        if unit:
            first, second = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (first, second))
        U, S, Vt = np.linalg.svd(first.T @ second)
        if S[2] < 1e-9:  # the third direction has the sign that rounding gives it
            return np.full((3, 3), np.nan)
        return multiply(U, Vt)  # without noise U V^T is no mirror image, so that is all

    return turn


_PRODUCTS: list[Callable[[Floats, Floats], Floats]] = [
    lambda U, Vt: U @ Vt.T,
    lambda U, Vt: U.T @ Vt,
    lambda U, Vt: U.T @ Vt.T,
    lambda U, Vt: Vt @ U,
    lambda U, Vt: Vt @ U.T,
    lambda U, Vt: Vt.T @ U,
]
ROTATION_HALF.add_mistakes(
    ("result", "inverse_of_x", lambda R: R.T),
    ("turn", "not_a_rotation", lambda a, b: np.linalg.lstsq(b, a, rcond=None)[0].T),
    ("turn", "not_a_rotation", lambda a, b: a.T @ b, lambda a, b: a.T @ b / len(a)),
    ("used", "first_motion_only", lambda a, b: (a[:1], b[:1])),
    ("result", "negative", lambda R: -R),
    ("used", "mean_taken_off", lambda a, b: (a - a.mean(axis=0), b - b.mean(axis=0))),
    ("used", "b_turned_round", lambda a, b: (a, -b)),
    ("used", "one_motion_twice", lambda a, b: (a, a)),
    ("axes", "euler_angles", lambda *R: [Rotation.from_matrix(r).as_euler("xyz") for r in R]),
    ("result", "not_scaled", lambda R: R / np.sqrt(3)),
    ("result", "not_scaled_and_negative", lambda R: -R / np.sqrt(3)),
    ("axes", "axis_without_sign", _no_signs),
    ("axes", "one_sign", *map(_flipped, 1 - 2 * np.eye(3))),
    ("", "same_frame", lambda _: lambda A, B: A[0] @ B[0].T),
    ("", "largest_singular", lambda _: lambda A, B: _half_by_null_space(A, B, 0)),
    ("", "same_frame", lambda _: _same_frame),
    ("", "same_frame", lambda _: lambda *AB: Rotation.from_matrix(_same_frame(*AB)).as_matrix()),
    ("", "same_frame", lambda _: lambda A, B: _same_frame(*np.swapaxes([A, B], 2, 3))),
    ("", "same_frame", lambda _: lambda A, B: _mean_turn(np.swapaxes(A, 1, 2) @ B)),
)
_FACTORS = (_kabsch(*how) for how in product(_PRODUCTS, (False, True), (False, True)))
ROTATION_HALF.add_mistakes(("turn", "transposed_factor", *_FACTORS), alone=True)
