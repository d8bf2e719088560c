"""Do miss vectors follow the pose of the gripper? A regression, and a permutation test of it.

What an error that depends on the pose does to a trial is taken as linear in a few numbers: three
turns of what the camera says about the arm's base, one scale, and three numbers of an offset that
turns with the gripper. A joint whose zero has slipped is, near enough, a mixture of them. Under
"the pose does not matter" any assignment of the misses to the poses was as likely as the one seen;
the p-value is its rank among shuffled ones, so it holds at any number of trials and for scatter of
any shape.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from coursekit.hand_eye.poses import cross_matrix

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

REACH_M = 0.2  # makes metres comparable with rotations
STILL = 0.05  # 1 cm at REACH_M, 3 degrees: poses that differ by less say nothing
GROUPS = {"a turn of the base": slice(0, 3), "a scale": slice(3, 4), "the gripper": slice(4, 7)}
ROUNDING_M = 1e-9  # scatter below it is that of the arithmetic
SEED = 5  # of the shuffles: the same misses get the same p-value


@dataclass(frozen=True)
class PoseTest:
    """p_value: of "the misses do not follow the pose". columns: numbers in the regression.

    part_m: rms length of the part that follows the pose, less what chance would give, m. shares:
    of the scatter that each group of columns would explain alone, 0 to 1.
    """

    p_value: float
    columns: int
    part_m: float
    shares: dict[str, float]


def pose_columns(T_base_gripper: Floats) -> Floats:
    """What each cause does to each trial, (n, 3, 7): three turns, a scale, three in the gripper."""
    places = T_base_gripper[:, :3, 3] / REACH_M
    turns = -cross_matrix(places)
    return np.concatenate([turns, places[:, :, None], T_base_gripper[:, :3, :3]], axis=2)


def pose_test(
    misses: Floats, columns: Floats, groups: dict[str, slice], still: float, level: float
) -> PoseTest | None:
    """Regress misses (n, 3), m, on columns (n, 3, k) and a constant; None if no pose differs.

    groups: names of parts of the k columns. still: rms over the trials below which a column, or a
    combination of columns, is taken as constant.
    """
    basis = _basis(columns, still)
    k = basis.shape[1]
    if k == 0 or 3 * (len(misses) - 1) <= k:
        return None
    centred = misses - misses.mean(axis=0)
    total = float((centred**2).sum())
    if total < len(misses) * ROUNDING_M**2:
        return PoseTest(1.0, k, 0.0, {})
    explained = _explained(basis, centred[None])[0]
    left = (total - explained) / (3 * (len(misses) - 1) - k)
    return PoseTest(
        p_value=_rank(basis, centred, explained, round(20 / level)),
        columns=k,
        part_m=float(np.sqrt(max(explained - k * left, 0.0) / len(misses))),
        shares={
            name: float(_explained(_basis(columns[:, :, part], still), centred[None])[0]) / total
            for name, part in groups.items()
        },
    )


def _rank(basis: Floats, centred: Floats, explained: float, shuffles: int) -> float:
    by_chance = _explained(basis, centred[_orders(len(centred), shuffles - 1)])
    as_good = np.count_nonzero(by_chance >= explained * (1 - 1e-9))
    return (1 + as_good) / shuffles


@lru_cache(maxsize=32)
def _orders(n: int, shuffles: int) -> NDArray[np.intp]:
    """Shuffled 0 .. n-1, (shuffles, n)."""
    rows = np.tile(np.arange(n), (shuffles, 1))
    return np.random.default_rng(SEED).permuted(rows, axis=1)


def _explained(basis: Floats, misses: Floats) -> Floats:
    """Squares of misses (..., n, 3) that lie in the space of basis (3 n, k), (...)."""
    return np.asarray(((misses.reshape(*misses.shape[:-2], -1) @ basis) ** 2).sum(axis=-1))


def _basis(columns: Floats, still: float) -> Floats:
    """Orthonormal (3 n, k): what columns (n, 3, m) do beyond a constant."""
    centred = (columns - columns.mean(axis=0)).reshape(-1, columns.shape[2])
    u, sizes, _ = np.linalg.svd(centred, full_matrices=False)
    return np.asarray(u[:, sizes > still * np.sqrt(len(columns))])
