"""The tests behind a verdict on miss vectors, and how surely each would find what it looks for.

**Is their mean zero?** Two tests that know different amounts about the scatter. Hotelling's T^2
takes the scatter as any covariance and estimates its six numbers; ten trials make that dear: a bias
of 3 mm under 2 mm of scatter an axis is found in 53 % of sets at level 0.01. The pooled test weighs
the axes alike, n |mean|^2 / trace S, with degrees of freedom that shrink as the scatter gets uneven
(Box 1954, Annals of Mathematical Statistics 25, 290; the "ANOVA-type statistic"): 85 % of the same
sets, but blind to a small bias across a large scatter, where T^2 sees it. Both are done, and their
p-values joined with Bonferroni's weights. Box's degrees of freedom are an approximation: at level
0.01 both together reject 0.3 to 1.9 % of sets without bias, the most where one axis scatters three
times as much as the others.

**Do they follow the pose of the gripper?** A regression, and a permutation test of it. What an
error that depends on the pose does to a trial is taken as linear in a few numbers: three turns of
what the camera says about the arm's base, one scale, and three numbers of an offset that turns with
the gripper. A joint whose zero has slipped is, near enough, a mixture of them. Under "the pose does
not matter" any assignment of the misses to the poses was as likely as the one seen; the p-value is
its rank among shuffled ones, so it holds at any number of trials and for scatter of any shape.

**Do they differ from place to place by more than repeats in one place do?** The regression on the
pose knows seven numbers, and an arm that errs in each place by something of its own (gears, a
sagging table, a fixed pattern in the depth) follows none of them. Repeats do not need a model:
n |mean of a place - mean of all|^2, summed and pooled over the axes, against the scatter within
places, with Box's degrees of freedom again. Wilks' and Hotelling-Lawley's forms estimate six
numbers of the scatter from the few degrees of freedom within; a permutation of 3 places with 2
trials each has 15 outcomes, none of them as rare as 0.01. Pooled, 3 places with 2 trials each are
enough.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from coursekit.arrays import Floats, Integers
from coursekit.geometry import cross_matrix

POOLED_SHARE, T2_SHARE = 0.95, 0.05  # of the level: T^2 is for the rarer case
FEW_TRIALS = 10  # below it the shape of the scatter is hardly known: then err to fewer axes
SINGULAR = 1e-9  # smallest eigenvalue of the covariance over its largest
REACH_M = 0.2  # makes metres comparable with rotations
STILL = 0.05  # 1 cm at REACH_M, 3 degrees: poses that differ by less say nothing
ROUNDING_M = 1e-9  # scatter below it is that of the arithmetic
SHUFFLES, SHUFFLE_SEED = 2000, 5  # the same misses get the same p-value, to 0.0005
POSE_CAUSES = {  # which columns of `pose_columns` each has
    "a turn of the base": slice(0, 3),
    "a scale": slice(3, 4),
    "the gripper": slice(4, 7),
}
# The same place: 1 cm and 3 degrees, which poses are called still by elsewhere. Slipped joints that
# shift a grasp by 4 mm shift it by 0.3 mm rms more or less so near by, under any depth noise.
ONE_PLACE_M, ONE_PLACE_RAD = STILL * REACH_M, STILL
FEWEST_PLACES, FEWEST_REPEATS = 3, 2
REPEATED_SHARE = 0.5  # of the trials in repeated places, from which a set is one with repeats


# --- is the mean zero? ---


@dataclass(frozen=True)
class MeanTest:
    """p_value: of "the mean is zero", by both tests together; p_pooled by one, p_t2 by the other.

    t2: Hotelling's, with p_t2 None where it cannot be had: under 4 trials, and for scatter in a
    plane or of rounding. axes: how many the scatter really fills, 1 to 3.
    """

    p_value: float
    p_pooled: float
    axes: float
    t2: float | None = None
    p_t2: float | None = None


def mean_test(misses: Floats) -> MeanTest:
    """Test misses (n, 3), n >= 2, m, for a mean of zero."""
    from scipy.stats import f

    n, mean, S = len(misses), misses.mean(axis=0), np.cov(misses.T)
    total = float(np.trace(S))
    axes = effective_axes(S, n)
    squares = float(n * mean @ mean)
    if total > 0:
        p_pooled = float(f.sf(squares / total, axes, box_freedom(S, n) * (n - 1)))
    else:
        p_pooled = 0.0 if squares > 0 else 1.0
    values = np.linalg.eigvalsh(S)
    if n < 4 or values[0] <= SINGULAR * values[-1] or values[-1] < ROUNDING_M**2:
        return MeanTest(min(1.0, p_pooled / POOLED_SHARE), p_pooled, axes)
    t2 = float(n * mean @ np.linalg.solve(S, mean))
    p_t2 = float(f.sf(t2 * (n - 3) / (3 * (n - 1)), 3, n - 3))
    return MeanTest(min(1.0, p_pooled / POOLED_SHARE, p_t2 / T2_SHARE), p_pooled, axes, t2, p_t2)


def effective_axes(S: Floats, n: int) -> float:
    """tr(C)^2 / tr(C^2) of the true covariance C behind S (3, 3) of n trials: 1 to 3.

    From the expectations of tr(S)^2 and tr(S^2) for normal scatter; S alone would say too few. Two
    trials lie on a line, and 1 is all that they show.
    """
    v = n - 1
    if v == 1:
        return 1.0
    both = [float(np.trace(S)) ** 2, float((S * S).sum())]  # trace squared, trace of the square
    a, b = np.linalg.solve([[1.0, 2.0 / v], [1.0 / v, 1.0 + 1.0 / v]], both)
    return float(np.clip(a / b, 1.0, 3.0)) if b > 0 else 3.0


def box_freedom(S: Floats, n: int) -> float:
    """Degrees of freedom of tr S (3, 3) for each of the n - 1 trials behind it: 1 to 3."""
    squares = float((S * S).sum())
    if n >= FEW_TRIALS or squares == 0:
        return effective_axes(S, n)
    return float(np.trace(S)) ** 2 / squares


def power_of_test(
    size_m: float, S: Floats, axes: float, n: int, columns: int, beside: int, level: float
) -> float:
    """The share of sets of n trials in which a part of the misses of size_m, m rms, is found.

    S (3, 3): the scatter that it must stand out from, m^2, taken as known; axes: as of
    `effective_axes`. columns: how many numbers describe the part (3 for a constant); beside: how
    many others are fitted (3 where the mean is taken out first). By the pooled F of that test and
    the noncentral F; 0 where no degrees of freedom are left.
    """
    from scipy.stats import f, ncf

    total, share = float(np.trace(S)), axes / 3.0  # of the freedom that uneven scatter leaves
    above, below = share * columns, share * (3 * n - columns - beside)
    if below <= 0:
        return 0.0
    if total <= 0:
        return float(size_m > 0)
    noncentrality = min(axes * n * size_m**2 / total, 1e4)
    found = ncf.sf(f.isf(level, above, below), above, below, noncentrality)
    return float(np.nan_to_num(found, nan=1.0))


# --- do the misses follow the pose? ---


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


def pose_test(misses: Floats, columns: Floats, shuffles: int = SHUFFLES) -> PoseTest | None:
    """Regress misses (n, 3), m, on columns (n, 3, 7) and a constant; None if no pose differs.

    columns: as `pose_columns` makes them; one, or a combination, that changes by less than `STILL`
    rms is taken as constant. shuffles: of the permutation test, the order seen among them.
    """
    basis = _basis(columns)
    k = basis.shape[1]
    if k == 0 or 3 * (len(misses) - 1) <= k:
        return None
    centred = misses - misses.mean(axis=0)
    total = float((centred**2).sum())
    if total < len(misses) * ROUNDING_M**2:
        return PoseTest(1.0, k, 0.0, {})
    explained = _explained(basis, centred[None])[0]
    left = (total - explained) / (3 * (len(misses) - 1) - k)
    by_chance = _explained(basis, centred[_orders(len(misses), shuffles - 1)])
    as_good = np.count_nonzero(by_chance >= explained * (1 - 1e-9))
    part_m = float(np.sqrt(max(explained - k * left, 0.0) / len(misses)))
    bases = {name: _basis(columns[:, :, part]) for name, part in POSE_CAUSES.items()}
    alone = {name: float(_explained(b, centred[None])[0]) / total for name, b in bases.items()}
    return PoseTest((1 + as_good) / shuffles, k, part_m, alone)


@lru_cache(maxsize=32)
def _orders(n: int, shuffles: int) -> Integers:
    """Shuffled 0 .. n-1, (shuffles, n)."""
    rows = np.tile(np.arange(n), (shuffles, 1))
    return np.random.default_rng(SHUFFLE_SEED).permuted(rows, axis=1)


def _explained(basis: Floats, misses: Floats) -> Floats:
    """Squares of misses (..., n, 3) that lie in the space of basis (3 n, k), (...)."""
    return np.asarray(((misses.reshape(*misses.shape[:-2], -1) @ basis) ** 2).sum(axis=-1))


def _basis(columns: Floats) -> Floats:
    """Orthonormal (3 n, k): what columns (n, 3, m) do beyond a constant."""
    centred = (columns - columns.mean(axis=0)).reshape(-1, columns.shape[2])
    u, sizes, _ = np.linalg.svd(centred, full_matrices=False)
    return np.asarray(u[:, sizes > STILL * np.sqrt(len(columns))])


# --- do they differ from place to place? ---


@dataclass(frozen=True, eq=False)
class PlaceTest:
    """p_value: of "the place does not matter". places, trials: that were repeated, and in them.

    means_m (places, 3): the mean miss of each. part_m: rms length of what differs between places,
    less what chance would give, m; scatter_m: that of repeats in one place. S (3, 3): the
    covariance within places, m^2, and axes: how many it really fills, 1 to 3. p_follows: of "the
    means of the places do not follow the pose", by the regression on them alone; None where p_value
    is not below the level, or the places too few.
    """

    p_value: float
    places: int
    trials: int
    means_m: Floats
    part_m: float
    scatter_m: float
    S: Floats
    axes: float
    p_follows: float | None


def place_test(misses: Floats, T_base_gripper: Floats, level: float) -> PlaceTest | None:
    """Test misses (n, 3), m, at poses (n, 4, 4), n >= 2, for differences between places.

    Only places with 2 trials or more count. None where they are fewer than 3, or hold less than
    half of the trials: then the set says more about the pose by where it was than by repeats.
    """
    from scipy.stats import f

    place = find_places(T_base_gripper)
    repeated = np.bincount(place)[place] >= FEWEST_REPEATS
    names, first, place = np.unique(place[repeated], return_index=True, return_inverse=True)
    if len(names) < FEWEST_PLACES or np.mean(repeated) < REPEATED_SHARE:
        return None
    misses, columns = misses[repeated], pose_columns(T_base_gripper[repeated][first])
    n, places = len(misses), len(names)
    inside = n - places
    means = np.stack([misses[place == one].mean(axis=0) for one in range(places)])
    rest = misses - means[place]
    S = rest.T @ rest / inside
    total, between = float(np.trace(S)), float(((means[place] - misses.mean(axis=0)) ** 2).sum())
    axes = effective_axes(S, inside + 1)
    if total > ROUNDING_M**2:
        above, below = (places - 1) * axes, inside * box_freedom(S, inside + 1)
        p_value = float(f.sf(between / (places - 1) / total, above, below))
    else:
        p_value = 0.0 if between > n * ROUNDING_M**2 else 1.0
    part, scatter = np.sqrt([max(between - (places - 1) * total, 0.0) / n, total]).tolist()
    regression = pose_test(means, columns) if p_value < level else None
    follows = None if regression is None else regression.p_value
    return PlaceTest(p_value, places, n, means, part, scatter, S, axes, follows)


def find_places(T_base_gripper: Floats) -> Integers:
    """A number, 0 or more, for the place of each pose (n, 4, 4), n >= 2: (n,).

    Any two poses of a place are within 1 cm and 3 degrees (complete linkage), whatever the order.
    """
    from scipy.cluster.hierarchy import fcluster, linkage
    from scipy.spatial.distance import pdist

    turns = T_base_gripper[:, :3, :3].reshape(-1, 9) / np.sqrt(2)  # apart by the angle, if small
    apart = np.maximum(pdist(T_base_gripper[:, :3, 3]) / ONE_PLACE_M, pdist(turns) / ONE_PLACE_RAD)
    return np.asarray(fcluster(linkage(apart, "complete"), 1.0, "distance")) - 1
