"""An experiment: how X gets better with more poses and with more rotation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from coursekit.arm import pose_difference
from coursekit.geometry import invert_transform
from coursekit.hand_eye.closed_form import rotation_by_axes, translation_half
from coursekit.hand_eye.poses import turned

if TYPE_CHECKING:
    from typing import Literal

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

    Pairs = Literal["all", "consecutive"]

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
