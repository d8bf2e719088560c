"""Closed forms of A X = X B: our own, rotation first and then translation, and OpenCV's.

An experiment: how X gets better with more poses and with more rotation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import numpy as np

from coursekit.arm import pose_difference
from coursekit.arrays import ArrayLike, Floats
from coursekit.geometry import invert_transform
from coursekit.hand_eye.poses import (
    Mount,
    carrier_stand,
    check_mount,
    check_poses,
    mean_pose,
    nearest_rotation,
    same_number,
    turned,
)

Pairs = Literal["all", "consecutive"]

HAND_EYE = {"tsai": "TSAI", "park": "PARK", "horaud": "HORAUD", "andreff": "ANDREFF",
            "daniilidis": "DANIILIDIS"}  # fmt: skip
ROBOT_WORLD = {"shah": "SHAH", "li": "LI"}
CLOSED_FORMS = ("closed_form", *HAND_EYE, *ROBOT_WORLD)
FEWEST = 3
HALF_TURN_DEG = 170.0  # beyond it noise can turn an axis round
LEAST_TURN_RAD = np.radians(0.1)  # less than any arm's own wobble
FAR_M = 1e5  # farther away is no camera, not even in millimetres that pass for metres
ROTATION_OFF = 1e-2  # R R^T - 1 of a solver's output: below it rounding, above it nonsense


class SolverFailed(ValueError):
    """A solver returned something that is no rigid transform, or none at all."""


class NotDetermined(ValueError):
    """The poses do not determine X, whatever the solver; the message says which way it is free."""


def motions(T_base_gripper: Floats, T_camera_board: Floats, mount: Mount) -> tuple[Floats, Floats]:
    """A and B (p, 4, 4) of A X = X B for all pairs of poses i < j."""
    M = carrier_stand(T_base_gripper, mount)
    i, j = np.triu_indices(len(M), 1)
    return M[j] @ invert_transform(M[i]), T_camera_board[j] @ invert_transform(T_camera_board[i])


def half_angle_vectors(R: Floats) -> Floats:
    """2 sin(angle / 2) axis of rotations (..., 3, 3): (..., 3). Source: Tsai and Lenz (1989)."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat(canonical=True)[:, :3]
    return 2.0 * turns.reshape(*R.shape[:-2], 3)


def rotation_half(A: Floats, B: Floats) -> Floats:
    """R_X (3, 3) of R_A R_X = R_X R_B: the axis of A is that of B, seen from the other frame.

    A, B (p, 4, 4). So R_X is the rotation that best takes one set of vectors to the other. Their
    lengths 2 sin(angle / 2) weigh a pair by what it knows. Raises NotDetermined where the rotations
    have fewer than two axes. Source: Kabsch (1976); Park and Martin (1994) for the idea.
    """
    a = half_angle_vectors(A[:, :3, :3])
    spread = _turns(a)
    if spread[1] < LEAST_TURN_RAD:
        raise NotDetermined(_too_few_axes(a, spread))
    return rotation_by_axes(A, B)


def rotation_by_axes(A: Floats, B: Floats) -> Floats:
    """`rotation_half` of many sessions, A and B (..., p, 4, 4), whether it is determined or not."""
    a, b = half_angle_vectors(A[..., :3, :3]), half_angle_vectors(B[..., :3, :3])
    longest = np.maximum(np.linalg.norm(a, axis=-1), np.linalg.norm(b, axis=-1))
    use = longest < 2.0 * math.sin(math.radians(HALF_TURN_DEG) / 2)
    return nearest_rotation(np.swapaxes(a * use[..., None], -1, -2) @ b)


def translation_half(A: Floats, B: Floats, R_X: Floats) -> Floats:
    """t_X (..., 3) in m of (R_A - 1) t_X = R_X t_B - t_A, by least squares over p pairs."""
    rows = A[..., :3, :3] - np.eye(3)
    right = B[..., :3, 3] @ np.swapaxes(R_X, -1, -2) - A[..., :3, 3]
    normal = np.einsum("...pki,...pkj->...ij", rows, rows)
    return np.linalg.solve(normal, np.einsum("...pki,...pk->...i", rows, right)[..., None])[..., 0]


def rotation_from_shifts(
    T_base_gripper: ArrayLike, T_camera_board: ArrayLike, mount: Mount
) -> Floats:
    """R_X (3, 3) from poses that do not turn: then R_A = 1 and t_A = R_X t_B.

    What a grid at fixed orientation still determines; of t_X it says nothing. Raises NotDetermined
    for shifts along one line.
    """
    arm = check_poses("T_base_gripper", T_base_gripper, FEWEST)
    seen = check_poses("T_camera_board", T_camera_board, FEWEST)
    same_number(len(arm), len(seen))
    A, B = motions(arm, seen, check_mount(mount))
    a, b = A[:, :3, 3], B[:, :3, 3]
    lengths = np.linalg.svd(a, compute_uv=False)
    if lengths[1] < 1e-3 * lengths[0] or lengths[0] == 0:
        raise NotDetermined("T_base_gripper: the shifts lie on one line; R_X is free about it")
    return nearest_rotation(a.T @ b)


def _turns(a: Floats) -> Floats:
    """Root mean square rotation (3,), rad, about the pairs' principal axes, descending."""
    return np.asarray(np.linalg.svd(a, compute_uv=False) / math.sqrt(max(1, len(a))))


def _too_few_axes(a: Floats, spread: Floats) -> str:
    if spread[0] < LEAST_TURN_RAD:
        return (
            "T_base_gripper: the poses do not turn against each other (R_A = 1), so t_X drops out "
            "of (R_A - 1) t_X = R_X t_B - t_A: translation is free in all directions"
        )
    axis = np.linalg.svd(a)[2][0]
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    text = "({:.2f}, {:.2f}, {:.2f})".format(*(axis + 0.0))
    return (
        f"T_base_gripper: all poses turn about one axis, {text} in the frame that carries the "
        "camera: rotation about it and translation along it are free; turn about a second axis"
    )


def closed_form(
    T_base_gripper: Floats, T_camera_board: Floats, mount: Mount, method: str
) -> tuple[Floats, Floats]:
    if method == "closed_form":
        A, B = motions(T_base_gripper, T_camera_board, mount)
        X = np.eye(4)
        X[:3, :3] = rotation_half(A, B)
        X[:3, 3] = translation_half(A, B, X[:3, :3])
    elif method in HAND_EYE:
        X = _opencv_hand_eye(T_base_gripper, T_camera_board, mount, method)
    else:
        return _opencv_robot_world(T_base_gripper, T_camera_board, mount, method)
    return X, mean_pose(stand_board(T_base_gripper, T_camera_board, X, mount))


@contextmanager
def _quiet() -> Iterator[None]:
    """OpenCV without its log: what goes wrong is raised here, not printed there."""
    import cv2

    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def _opencv_hand_eye(
    T_base_gripper: Floats, T_camera_board: Floats, mount: Mount, method: str
) -> Floats:
    import cv2

    stand_carrier = invert_transform(carrier_stand(T_base_gripper, mount))
    try:
        with _quiet():
            R, t = cv2.calibrateHandEye(
                list(stand_carrier[:, :3, :3]), list(stand_carrier[:, :3, 3]),
                list(T_camera_board[:, :3, :3]), list(T_camera_board[:, :3, 3]),
                method=getattr(cv2, f"CALIB_HAND_EYE_{HAND_EYE[method]}"),
            )  # fmt: skip
    except cv2.error as error:
        raise SolverFailed(f"{method}: OpenCV gave up ({error.err})") from error
    if np.array_equal(R, np.eye(3)):
        raise SolverFailed(
            f"{method}: OpenCV returned the identity, which is what it does when it finds no pair "
            "of poses with enough rotation between them; turn the wrist more"
        )
    return _rigid(method, R, t)


def _opencv_robot_world(
    T_base_gripper: Floats, T_camera_board: Floats, mount: Mount, method: str
) -> tuple[Floats, Floats]:
    """OpenCV's world is the board, its base the stand and its gripper the carrier."""
    import cv2

    M = carrier_stand(T_base_gripper, mount)
    try:
        R_board_stand, t_board_stand, R_camera_carrier, t_camera_carrier = (
            cv2.calibrateRobotWorldHandEye(
                list(T_camera_board[:, :3, :3]), list(T_camera_board[:, :3, 3]),
                list(M[:, :3, :3]), list(M[:, :3, 3]),
                method=getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{ROBOT_WORLD[method]}"),
            )
        )  # fmt: skip
    except cv2.error as error:
        raise SolverFailed(f"{method}: OpenCV gave up ({error.err})") from error
    return (
        invert_transform(_rigid(method, R_camera_carrier, t_camera_carrier)),
        invert_transform(_rigid(method, R_board_stand, t_board_stand)),
    )


def _rigid(method: str, R: Floats, t: Floats) -> Floats:
    """A solver's output as (4, 4), or SolverFailed where it is no rotation."""
    R, t = np.asarray(R, float), np.asarray(t, float).ravel()
    if not (np.isfinite(R).all() and np.isfinite(t).all()):
        raise SolverFailed(f"{method}: returned NaN or infinity; do the poses turn about two axes?")
    if np.linalg.norm(t) > FAR_M:
        raise SolverFailed(
            f"{method}: returned a place {np.linalg.norm(t):.0g} m away; do the poses turn "
            "about two axes?"
        )
    if np.linalg.det(R) < 0:
        raise SolverFailed(f"{method}: returned a reflection (determinant -1), which is no pose")
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    if off > ROTATION_OFF:
        raise SolverFailed(f"{method}: returned a matrix that is no rotation (off by {off:.1g})")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = nearest_rotation(R), t
    return T


def stand_board(T_base_gripper: Floats, T_camera_board: Floats, X: Floats, mount: Mount) -> Floats:
    """Where each view puts the board on its stand, (n, 4, 4); all the same if all were right."""
    return invert_transform(carrier_stand(T_base_gripper, mount)) @ X @ T_camera_board


WORKPLACE = np.array([0.3, 0.0, 0.3])  # m, where the gripper is on average
SHIFT_M = 0.1  # and how far from there it goes along each axis
BOARD_M = 0.3  # from the camera
FEWEST_POSES = 3


@dataclass(frozen=True)
class StudyPoint:
    """The median error of X over many sessions of one kind.

    poses: in a session. range_deg: the wrist turns up to this to either side. axes: about how many.
    rotation_deg, translation_mm: medians of the length of the errors.
    """

    poses: int
    range_deg: float
    axes: int
    rotation_deg: float
    translation_mm: float

    def __repr__(self) -> str:
        return (
            f"{self.poses} poses, +-{self.range_deg:g} deg about {self.axes} axes: "
            f"{self.rotation_deg:.2f} deg, {self.translation_mm:.2f} mm"
        )


def error_study(
    poses: Sequence[int] = (15,),
    ranges_deg: Sequence[float] = (10.0, 20.0, 30.0, 40.0),
    axes: Sequence[int] = (2, 3),
    *,
    rotation_deg: float = 0.1,
    position_mm: float = 0.5,
    trials: int = 200,
    seed: int = 0,
    pairs: Pairs = "all",
) -> tuple[StudyPoint, ...]:
    """Errors of the closed form, eye-in-hand, for each number of poses, range and axes.

    Every arm pose and every board pose is off by normal noise of rotation_deg about and
    position_mm along each axis. pairs: "consecutive" builds A and B from each pose and the next,
    as many scripts do; "all" takes every pair, which costs nothing and is a fifth better.
    Raises ValueError for fewer than three poses and anything that is not positive.
    """
    if min(poses) < FEWEST_POSES:
        raise ValueError(f"poses: got {min(poses)}, want at least {FEWEST_POSES}")
    if not set(axes) <= {2, 3}:
        raise ValueError(f"axes: got {tuple(axes)}, want 2 or 3")
    if pairs not in ("all", "consecutive"):
        raise ValueError(f"pairs: got {pairs!r}, want 'all' or 'consecutive'")
    if trials < 1 or min(ranges_deg) <= 0:
        raise ValueError("trials, ranges_deg: want positive numbers")
    noise = np.repeat([math.radians(rotation_deg), 1e-3 * position_mm], 3)
    points = []
    for n in poses:
        for about in axes:
            for range_deg in ranges_deg:
                rng = np.random.default_rng([seed, n, about])
                turn, shift = np.median(_errors(rng, trials, n, range_deg, about, noise, pairs), 1)
                points.append(
                    StudyPoint(n, range_deg, about, math.degrees(turn), 1e3 * float(shift))
                )
    return tuple(points)


def _errors(
    rng: np.random.Generator,
    trials: int,
    n: int,
    range_deg: float,
    axes: int,
    noise: Floats,
    pairs: Pairs,
) -> tuple[Floats, Floats]:
    """Lengths of the errors of X in sessions of n poses: rad and m, (trials,) each."""
    T, X, Y = _rigs(rng, trials, n, range_deg, axes)
    seen = invert_transform(X)[:, None] @ invert_transform(T) @ Y[:, None]
    seen, T = (turned(poses, noise * rng.normal(size=(trials, n, 6))) for poses in (seen, T))
    M = invert_transform(T)
    i, j = np.triu_indices(n, 1) if pairs == "all" else (np.arange(n - 1), np.arange(1, n))
    A, B = M[:, j] @ invert_transform(M[:, i]), seen[:, j] @ invert_transform(seen[:, i])
    found = np.empty((trials, 4, 4))
    found[:] = np.eye(4)
    found[:, :3, :3] = rotation_by_axes(A, B)
    found[:, :3, 3] = translation_half(A, B, found[:, :3, :3])
    off = pose_difference(X, found)
    return np.linalg.norm(off[:, :3], axis=1), np.linalg.norm(off[:, 3:], axis=1)


def _rigs(
    rng: np.random.Generator, trials: int, n: int, range_deg: float, axes: int
) -> tuple[Floats, Floats, Floats]:
    """T_base_gripper (trials, n, 4, 4), and X and Y (trials, 4, 4) of as many eye-in-hand rigs."""
    from scipy.spatial.transform import Rotation

    turns = math.radians(range_deg) * rng.uniform(-1.0, 1.0, (trials * n, 3))
    turns[:, axes:] = 0.0
    T = np.tile(np.eye(4), (trials, n, 1, 1))
    T[..., :3, :3] = Rotation.from_euler("xyz", turns).as_matrix().reshape(trials, n, 3, 3)
    T[..., :3, 3] = WORKPLACE + SHIFT_M * rng.uniform(-1.0, 1.0, (trials, n, 3))
    X, Y = np.tile(np.eye(4), (2, trials, 1, 1))
    X[:, :3, :3] = Y[:, :3, :3] = Rotation.random(trials, rng=rng).as_matrix()
    X[:, :3, 3] = SHIFT_M * rng.uniform(-1.0, 1.0, (trials, 3))
    Y[:, :3, 3] = WORKPLACE + BOARD_M * X[:, :3, 2]
    return T, X, Y
