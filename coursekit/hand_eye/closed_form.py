"""Closed forms of A X = X B: our own, rotation first and then translation, and OpenCV's.

    rotation      R_A R_X = R_X R_B:  the axis of A is that of B, seen from the other frame
    translation   (R_A - 1) t_X = R_X t_B - t_A

A and B are what carrier and board do between two poses (`hand_eye.poses`). At the end stands an
experiment: how X gets better with more poses and with more rotation (`error_study`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from typing import Literal

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arrays import ArrayLike, Floats, Integers
from coursekit.checks import choice, positive, want, whole
from coursekit.geometry import invert_transform, make_transform, pose_difference, turned
from coursekit.hand_eye.poses import (
    MOUNTS,
    SCATTER,
    Mount,
    axis_text,
    carrier_stand,
    check_poses,
    mean_pose,
    nearest_rotation,
    stand_board,
)
from coursekit.words import say

HAND_EYE = ("tsai", "park", "horaud", "andreff", "daniilidis")  # OpenCV's, of A X = X B
ROBOT_WORLD = ("shah", "li")  # OpenCV's, of X and Y together
CLOSED_FORMS = ("closed_form", *HAND_EYE, *ROBOT_WORLD)
FEWEST_POSES = 3
HALF_TURN_DEG = 170.0  # beyond it noise can turn an axis round,
NARROW_RAD = 0.01  # but is used where the others turn no more than that about a second axis
LEAST_TURN_RAD = np.radians(0.1)  # less than any arm's own wobble
NO_INVERSE = 1e-13  # of the normal matrix' largest eigenvalue: rounding errors are as large
NO_CAMERA_M = 1e5  # farther away is no camera, not even in millimetres that pass for metres
NONSENSE_ROTATION = 1e-2  # R R^T - 1 of a solver's output: below it rounding, above it nonsense


class SolverFailed(ValueError):
    """A solver returned something that is no rigid transform, or none at all."""


class NotDetermined(ValueError):
    """The poses do not determine X, whatever the solver; the message says which way it is free."""


def motions(T_base_gripper: Floats, T_camera_board: Floats, mount: Mount) -> tuple[Floats, Floats]:
    """A and B (p, 4, 4) of A X = X B for all pairs of poses i < j.

    T_base_gripper, T_camera_board (n, 4, 4): what arm and camera say, m; p = n (n - 1) / 2.

    >>> T = turned(np.eye(4), np.array([[0.0, 0, 0, 0, 0, 0.3], [0.0, 0, 0, 0, 0, 0.5]]))
    >>> A, B = motions(T, T, "eye_to_hand")
    >>> A[0, :3, 3].round(6).tolist()
    [0.0, 0.0, 0.2]
    """
    M = carrier_stand(T_base_gripper, mount)
    i, j = np.triu_indices(len(M), 1)
    return M[j] @ invert_transform(M[i]), T_camera_board[j] @ invert_transform(T_camera_board[i])


def half_angle_vectors(R: Floats) -> Floats:
    """2 sin(angle / 2) axis of rotations (..., 3, 3): (..., 3). Source: Tsai and Lenz (1989)."""
    turns = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat(canonical=True)[:, :3]
    return 2.0 * turns.reshape(*R.shape[:-2], 3)


def rotation_half(A: Floats, B: Floats) -> Floats:
    """R_X (3, 3) of R_A R_X = R_X R_B: the axis of A is that of B, seen from the other frame.

    A, B (p, 4, 4). So R_X is the rotation that best takes one set of vectors to the other. Their
    lengths 2 sin(angle / 2) weigh a pair by what it knows. Raises NotDetermined where the rotations
    have fewer than two axes. Source: Kabsch (1976); Park and Martin (1994) for the idea.
    """
    a = half_angle_vectors(A[:, :3, :3])
    spread = np.asarray(np.linalg.svd(a, compute_uv=False)) / math.sqrt(max(1, len(a)))  # rad
    if spread[1] < LEAST_TURN_RAD:
        if spread[0] < LEAST_TURN_RAD:
            raise NotDetermined(say("hand_eye.no_turns"))
        raise NotDetermined(say("hand_eye.one_axis", axis=axis_text(np.linalg.svd(a)[2][0])))
    return rotation_by_axes(A, B)


def rotation_by_axes(A: Floats, B: Floats) -> Floats:
    """`rotation_half` of many sessions, A and B (..., p, 4, 4), whether it is determined or not."""
    a, b = half_angle_vectors(A[..., :3, :3]), half_angle_vectors(B[..., :3, :3])
    longest = np.maximum(np.linalg.norm(a, axis=-1), np.linalg.norm(b, axis=-1))
    use = (longest < 2.0 * math.sin(math.radians(HALF_TURN_DEG) / 2))[..., None]
    spread = np.linalg.svd(a * use, compute_uv=False) / math.sqrt(a.shape[-2])
    use |= (spread[..., 1:2] < NARROW_RAD)[..., None]  # without half turns nothing is left
    return nearest_rotation(np.swapaxes(a * use, -1, -2) @ b)


def translation_half(A: Floats, B: Floats, R_X: Floats) -> Floats:
    """t_X (..., 3) in m of (R_A - 1) t_X = R_X t_B - t_A, by least squares over p pairs.

    A, B (..., p, 4, 4) and R_X (..., 3, 3), which comes first: an error of R_X acts on t_B, so the
    board's distance decides how much of it ends up in t_X. The shortest t_X where the rotations of
    A have fewer than two axes.
    """
    rows = A[..., :3, :3] - np.eye(3)
    right = B[..., :3, 3] @ np.swapaxes(R_X, -1, -2) - A[..., :3, 3]
    normal = np.einsum("...pki,...pkj->...ij", rows, rows)
    inverse = np.linalg.pinv(normal, rcond=NO_INVERSE, hermitian=True)
    return np.einsum("...ij,...pkj,...pk->...i", inverse, rows, right, optimize=True)


def rotation_from_shifts(
    T_base_gripper: ArrayLike, T_camera_board: ArrayLike, mount: Mount
) -> Floats:
    """R_X (3, 3) from poses (n, 4, 4) that do not turn: then R_A = 1 and t_A = R_X t_B.

    What a grid at fixed orientation still determines; of t_X it says nothing. Raises ValueError
    for poses that are none or of different number, and NotDetermined for shifts along one line.

    >>> T = turned(np.eye(4), np.array([[0, 0, 0, x, y, 0.0] for x, y in ((0, 0), (1, 0), (0, 1))]))
    >>> (rotation_from_shifts(T, T, "eye_to_hand").round(6) + 0.0).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    arm = check_poses("T_base_gripper", T_base_gripper, FEWEST_POSES)
    seen = check_poses("T_camera_board", T_camera_board, FEWEST_POSES)
    want(len(seen) == len(arm), "T_camera_board", len(seen), f"{len(arm)}, one an arm pose")
    A, B = motions(arm, seen, choice("mount", mount, MOUNTS))
    a, b = A[:, :3, 3], B[:, :3, 3]
    lengths = np.linalg.svd(a, compute_uv=False)
    if lengths[1] < 1e-3 * lengths[0] or lengths[0] == 0:
        raise NotDetermined("T_base_gripper: the shifts lie on one line; R_X is free about it")
    return nearest_rotation(a.T @ b)


# --- the solvers ---


def closed_form(
    T_base_gripper: Floats, T_camera_board: Floats, mount: Mount, method: str
) -> tuple[Floats, Floats]:
    """X and Y (4, 4) by one of `CLOSED_FORMS` from checked poses (n, 4, 4), m.

    Raises NotDetermined where the arm did not turn about two axes, SolverFailed where what OpenCV
    returns is no pose.
    """
    M, seen = carrier_stand(T_base_gripper, mount), _parts(T_camera_board)
    if method == "closed_form":
        A, B = motions(T_base_gripper, T_camera_board, mount)
        turn = rotation_half(A, B)
        X = make_transform(turn, translation_half(A, B, turn))
    elif method in HAND_EYE:
        solver = getattr(cv2, f"CALIB_HAND_EYE_{method.upper()}")
        with _opencv(method):
            R, t = cv2.calibrateHandEye(*_parts(invert_transform(M)), *seen, method=solver)
        if np.array_equal(R, np.eye(3)):
            raise SolverFailed(say("hand_eye.identity", method=method))
        X = _rigid(method, R, t)
    else:  # OpenCV's world is the board, its base the stand and its gripper the carrier
        solver = getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{method.upper()}")
        with _opencv(method):
            R_Y, t_Y, R_X, t_X = cv2.calibrateRobotWorldHandEye(*seen, *_parts(M), method=solver)
        X = invert_transform(_rigid(method, R_X, t_X))
        return X, invert_transform(_rigid(method, R_Y, t_Y))
    return X, mean_pose(stand_board(T_base_gripper, T_camera_board, X, mount))


def _parts(T: Floats) -> tuple[list[Floats], list[Floats]]:
    """The rotations and the translations of poses (n, 4, 4), as OpenCV takes them."""
    return list(T[:, :3, :3]), list(T[:, :3, 3])


@contextmanager
def _opencv(method: str) -> Iterator[None]:
    """OpenCV without its log: what goes wrong is raised here, not printed there."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    except cv2.error as error:
        raise SolverFailed(f"{method}: OpenCV gave up ({error.err})") from error
    finally:
        cv2.utils.logging.setLogLevel(level)


def _rigid(method: str, R: ArrayLike, t: ArrayLike) -> Floats:
    """A solver's output as (4, 4), or SolverFailed where it is no rotation."""
    R, t = np.asarray(R, float), np.asarray(t, float).ravel()
    off, away = np.abs(R @ R.T - np.eye(3)).max(), np.linalg.norm(t)
    fault = ""
    if not np.isfinite(off + away):
        fault = "NaN or infinity; do the poses turn about two axes?"
    elif away > NO_CAMERA_M:
        fault = f"a place {away:.0g} m away; do the poses turn about two axes?"
    elif np.linalg.det(R) < 0:
        fault = "a reflection (determinant -1), which is no pose"
    elif off > NONSENSE_ROTATION:
        fault = f"a matrix that is no rotation (off by {off:.1g})"
    if fault:
        raise SolverFailed(f"{method}: returned {fault}")
    return make_transform(nearest_rotation(R), t)


# --- an experiment ---

WORKPLACE = np.array([0.3, 0.0, 0.3])  # m, where the gripper is on average
SHIFT_M = 0.1  # and how far from there it goes along each axis
BOARD_AWAY_M = 0.3  # from the camera


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
        return say("hand_eye.study", point=self)


def error_study(
    poses: Sequence[int] = (15,),
    ranges_deg: Sequence[float] = (10.0, 20.0, 30.0, 40.0),
    axes: Sequence[int] = (2, 3),
    *,
    trials: int = 200,
    pairs: Literal["all", "consecutive"] = "all",
) -> tuple[StudyPoint, ...]:
    """Errors of the closed form, eye-in-hand, for each number of poses, range (deg) and axes.

    Every arm pose and every board pose is off by normal noise of 0.1 deg about and 0.5 mm along
    each axis. trials: sessions behind each median, the same ones in every call. pairs:
    "consecutive" builds A and B from each pose and the next, as many scripts do; "all" takes every
    pair, which costs nothing and is a fifth better. Raises ValueError for fewer than three poses
    and anything that is not positive.

    >>> few, many = error_study((6, 30), (40.0,), (3,), trials=20)
    >>> many.translation_mm < few.translation_mm
    True
    """
    whole("poses", min(poses), least=FEWEST_POSES)
    want(set(axes) <= {2, 3}, "axes", tuple(axes), "2 or 3")
    choice("pairs", pairs, ("all", "consecutive"))
    whole("trials", trials)
    positive("ranges_deg", min(ranges_deg))
    points = []
    for n, about, range_deg in product(poses, axes, ranges_deg):
        i, j = np.triu_indices(n, 1) if pairs == "all" else (np.arange(n - 1), np.arange(1, n))
        rng = np.random.default_rng([0, n, about])
        off = _errors(*_rigs(rng, trials, n, range_deg, about), rng, i, j)
        turn, shift = np.median(np.linalg.norm(off.reshape(-1, 2, 3), axis=2), axis=0)
        points.append(StudyPoint(n, range_deg, about, math.degrees(turn), 1e3 * float(shift)))
    return tuple(points)


def _errors(
    T: Floats, X: Floats, Y: Floats, rng: np.random.Generator, i: Integers, j: Integers
) -> Floats:
    """Twists (trials, 6) from the true X to the one found from noisy poses, pairs i and j."""
    seen = invert_transform(X)[:, None] @ invert_transform(T) @ Y[:, None]
    seen, T = (turned(poses, SCATTER * rng.normal(size=(*T.shape[:2], 6))) for poses in (seen, T))
    M = invert_transform(T)
    A, B = M[:, j] @ invert_transform(M[:, i]), seen[:, j] @ invert_transform(seen[:, i])
    found = np.tile(np.eye(4), (len(T), 1, 1))
    found[:, :3, :3] = rotation_by_axes(A, B)
    found[:, :3, 3] = translation_half(A, B, found[:, :3, :3])
    return pose_difference(X, found)


def _rigs(
    rng: np.random.Generator, trials: int, n: int, range_deg: float, axes: int
) -> tuple[Floats, Floats, Floats]:
    """T_base_gripper (trials, n, 4, 4), and X and Y (trials, 4, 4) of as many eye-in-hand rigs."""
    turns = math.radians(range_deg) * rng.uniform(-1.0, 1.0, (trials * n, 3))
    turns[:, axes:] = 0.0
    T = np.tile(np.eye(4), (trials, n, 1, 1))
    T[..., :3, :3] = Rotation.from_euler("xyz", turns).as_matrix().reshape(trials, n, 3, 3)
    T[..., :3, 3] = WORKPLACE + SHIFT_M * rng.uniform(-1.0, 1.0, (trials, n, 3))
    X, Y = np.tile(np.eye(4), (2, trials, 1, 1))
    X[:, :3, :3] = Y[:, :3, :3] = Rotation.random(trials, rng=rng).as_matrix()
    X[:, :3, 3] = SHIFT_M * rng.uniform(-1.0, 1.0, (trials, 3))
    Y[:, :3, 3] = WORKPLACE + BOARD_AWAY_M * X[:, :3, 2]
    return T, X, Y
