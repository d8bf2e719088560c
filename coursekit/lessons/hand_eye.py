"""Notebook 04: its two exercises and the mistakes that people make in them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arrays import Floats
from coursekit.geometry import make_transform
from coursekit.lessons.exercises import Exercise, Model, Step

Pair = tuple[Floats, Floats]


def _pose(rng: np.random.Generator, reach_m: float = 0.5) -> Floats:
    turn = Rotation.from_rotvec(rng.uniform(-1.2, 1.2, 3))
    return make_transform(turn, rng.uniform(-reach_m, reach_m, 3))


# --- motion_pair ---


def _inverse(T: Floats) -> Any:
    return np.linalg.inv(T)


def _gripper_motion(first: Floats, second: Floats, inverse: Step) -> Floats:
    """The gripper at pose i, as the gripper at pose j sees it."""
    return inverse(second) @ first


def _camera_motion(first: Floats, second: Floats, inverse: Step) -> Floats:
    """The camera at pose i, as the camera at pose j sees it, by way of the board."""
    return second @ inverse(first)


def _stacked(A: Floats, B: Floats) -> Floats:
    return np.stack([A, B])


def _in_order(i: Floats, j: Floats) -> Pair:
    return i, j


def _build_pair(steps: Mapping[str, Step]) -> Model:
    def motion_pair(
        gripper_i: Floats, gripper_j: Floats, board_i: Floats, board_j: Floats
    ) -> Floats:
        invert = steps["inverse"]
        A = steps["A"](*steps["A pair"](gripper_i, gripper_j), invert)
        B = steps["B"](*steps["B pair"](board_i, board_j), invert)
        return steps["order"](A, B)

    return motion_pair


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


MOTION_PAIR = Exercise(
    name="hand_eye.motion_pair",
    build=_build_pair,
    steps={
        "inverse": _inverse,
        "A pair": _in_order,
        "A": _gripper_motion,
        "B pair": _in_order,
        "B": _camera_motion,
        "order": _stacked,
    },
    cases=[_session_pair(0, plain=True), *(_session_pair(seed) for seed in range(1, 5))],
    per_row=0,
    unit="m",
    tolerance=1e-9,
    describe=lambda args: (
        "the gripper at "
        + " and ".join(str(T[:3, 3].round(3).tolist()) for T in args[:2])
        + " m in the base, the board at "
        + " and ".join(str(T[:3, 3].round(3).tolist()) for T in args[2:])
        + " m before the camera"
        + ", the second arm pose turned by 90 degrees about z"
        * bool(args[1][0, 0] == args[1][1, 1] and abs(args[1][0, 0]) < 1e-9)
    ),
    show=lambda row: (
        "translations of A and B "
        + " and ".join("(" + ", ".join(f"{v:.3f}" for v in T[:3, 3]) + ")" for T in row)
    ),
)


@MOTION_PAIR.mistake("inverse")
def transposed_pose(T: Floats) -> Floats:
    """the inverse of a pose is not its transpose

    A rotation's inverse is its transpose. A pose also has a translation: what becomes of it?
    """
    return T.T


@MOTION_PAIR.mistake("inverse")
def translation_not_turned(T: Floats) -> Floats:
    """in your inverse the translation only changes its sign

    R^T undoes the rotation. In which frame is -t, and in which one is it wanted?
    """
    return make_transform(T[:3, :3].T, -T[:3, 3])


@MOTION_PAIR.mistake("inverse")
def not_inverted(T: Floats) -> Floats:
    """nothing is inverted

    Which of the two poses must be undone so that the base frame cancels?
    """
    return T


@MOTION_PAIR.mistake("A")
def motion_in_base(first: Floats, second: Floats, inverse: Step) -> Floats:
    """A is the motion seen from the base: that is the A of a camera that does not ride on the arm

    X stands to the right of A, and takes camera coordinates to gripper coordinates. In which frame
    must A begin and end?
    """
    return second @ inverse(first)


@MOTION_PAIR.mistake("A pair")
def a_exchanged(i: Floats, j: Floats) -> Pair:
    """in A the poses i and j are exchanged, in B they are not

    The board is in the same place: T_i X B_i = T_j X B_j. Bring all arm poses to the left.
    """
    return j, i


@MOTION_PAIR.mistake("B pair")
def b_exchanged(i: Floats, j: Floats) -> Pair:
    """in B the poses i and j are exchanged, in A they are not

    The board is in the same place: T_i X B_i = T_j X B_j. Bring all detections to the right.
    """
    return j, i


@MOTION_PAIR.mistake("B")
def motion_in_board(first: Floats, second: Floats, inverse: Step) -> Floats:
    """B is the motion of the camera seen from the board

    X stands to the left of B, and takes camera coordinates in. In which frame must B begin and end?
    """
    return inverse(second) @ first


@MOTION_PAIR.mistake("order")
def both_exchanged(A: Floats, B: Floats) -> Floats:
    """both motions go from j to i: a right equation, but not the one that was asked for

    A = inverse(T_j) T_i. And yours?
    """
    return np.stack([np.linalg.inv(A), np.linalg.inv(B)])


@MOTION_PAIR.mistake("order")
def b_first(A: Floats, B: Floats) -> Floats:
    """A and B are exchanged

    Which one comes from the arm?
    """
    return np.stack([B, A])


# --- rotation_half ---


def _axes(R_A: Floats, R_B: Floats) -> Pair:
    return Rotation.from_matrix(R_A).as_rotvec(), Rotation.from_matrix(R_B).as_rotvec()


def _used(a: Floats, b: Floats) -> Pair:
    return a, b


def _turn(a: Floats, b: Floats) -> Floats:
    """The rotation that takes each b to its a: Kabsch's; the smallest one for a single pair."""
    if len(a) == 1:
        return np.asarray(Rotation.align_vectors(a, b)[0].as_matrix())
    U, _, Vt = np.linalg.svd(a.T @ b)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt


def _build_half(steps: Mapping[str, Step]) -> Model:
    def rotation_half(R_A: Floats, R_B: Floats) -> Floats:
        return steps["result"](steps["turn"](*steps["used"](*steps["axes"](R_A, R_B))))

    return rotation_half


def _motions(seed: int, n: int) -> Pair:
    """n motions and what the camera saw of them, without noise."""
    rng = np.random.default_rng(seed)
    X = Rotation.from_rotvec(rng.uniform(-1.5, 1.5, 3))
    A = Rotation.from_rotvec(rng.uniform(-1.2, 1.2, (n, 3)))
    return A.as_matrix(), (X.inv() * A * X).as_matrix()


def _quarter_turns() -> Pair:
    """X turns by 90 degrees about z; the arm about x and then about y."""
    X = Rotation.from_euler("z", 90, degrees=True)
    A = Rotation.from_euler("xy", [[60, 0], [0, 40]], degrees=True)
    return A.as_matrix(), (X.inv() * A * X).as_matrix()


ROTATION_HALF = Exercise(
    name="hand_eye.rotation_half",
    build=_build_half,
    steps={"axes": _axes, "used": _used, "turn": _turn, "result": lambda R: R},
    cases=[_quarter_turns(), _motions(1, 2), _motions(2, 3), _motions(3, 6), _motions(4, 20)],
    per_row=0,
    unit="(rotation matrix)",
    tolerance=1e-6,
    describe=lambda args: (
        "the arm turns by 60 degrees about x, then by 40 about y; X is a quarter turn about z"
        if np.array_equal(args[0], _quarter_turns()[0])
        else f"{len(args[0])} motions"
    ),
    show=lambda R: "; ".join(" ".join(f"{v:.3f}" for v in row) for row in np.atleast_2d(R)),
)


@ROTATION_HALF.mistake("result")
def inverse_of_x(R: Floats) -> Floats:
    """that is the inverse of R_X

    R_X takes camera coordinates to gripper coordinates. Which axes did you turn into which?
    """
    return R.T


@ROTATION_HALF.mistake("turn")
def mirror_image(a: Floats, b: Floats) -> Floats:
    """with two motions your result is a mirror image: its determinant is -1

    Two axes lie in a plane, and a plane looks the same in a mirror. Print the determinant. What
    does Kabsch's method do about it?
    """
    U, _, Vt = np.linalg.svd(a.T @ b)
    mirror = U @ Vt
    if len(a) == 2:  # the third singular direction has no sign: take the one that mirrors
        mirror = U @ np.diag([1.0, 1.0, -np.linalg.det(mirror)]) @ Vt
    return mirror


@ROTATION_HALF.mistake("turn")
def not_a_rotation(a: Floats, b: Floats) -> Any:
    """that is the least-squares matrix for the axes, and it is not made a rotation

    Multiply your result by its transpose. With two motions, what can a matrix not know?
    """
    return np.linalg.lstsq(b, a, rcond=None)[0].T


@ROTATION_HALF.mistake("used")
def first_motion_only(a: Floats, b: Floats) -> Pair:
    """only the first motion is used

    One axis leaves the turn about it free. How many motions fix it?
    """
    return a[:1], b[:1]


@ROTATION_HALF.mistake("result")
def negative(R: Floats) -> Floats:
    """its sign is wrong: -R solves the equation as well, and is no rotation

    Print the determinant. A null vector has no sign of its own: how do you choose it?
    """
    return -R


@ROTATION_HALF.mistake("result")
def not_scaled(R: Floats) -> Floats:
    """it is a rotation but for a factor

    A null vector of length 1 has nine entries, and a rotation matrix has three rows of length 1.
    What is missing?
    """
    return R / np.sqrt(3)


@ROTATION_HALF.mistake("result")
def not_scaled_and_negative(R: Floats) -> Floats:
    """it is a rotation but for a factor and the sign

    A null vector of length 1 has no sign of its own, and nine entries. Print the determinant of
    your result, and that of a rotation.
    """
    return -R / np.sqrt(3)
