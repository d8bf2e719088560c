"""Do misses differ from place to place by more than repeats in one place do?

The regression on the pose knows seven numbers, and an arm that errs in each place by something of
its own (gears, a sagging table, a fixed pattern in the depth) follows none of them. Repeats do not
need a model: n |mean of a place - mean of all|^2, summed and pooled over the axes, against the
scatter within places, with degrees of freedom that shrink as that scatter gets uneven (Box 1954,
Annals of Mathematical Statistics 25, 290; the trace form of the one-way MANOVA). Wilks' and
Hotelling-Lawley's forms estimate six numbers of the scatter from the few degrees of freedom within;
a permutation of 3 places with 2 trials each has 15 outcomes, none of them as rare as 0.01. Pooled,
3 places with 2 trials each are enough.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from coursekit.attribution.mean_test import box_freedom, effective_axes
from coursekit.attribution.pose_test import REACH_M, ROUNDING_M, STILL, pose_columns, pose_test

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Labels = NDArray[np.int_]

# The same place: 1 cm and 3 degrees, which poses are called still by elsewhere. Slipped joints that
# shift a grasp by 4 mm shift it by 0.3 mm rms more or less so near by, under any depth noise.
SAME_M, SAME_RAD = STILL * REACH_M, STILL
FEWEST_PLACES, FEWEST_REPEATS = 3, 2
REPEATED = 0.5  # share of the trials in repeated places from which a set is one with repeats


@dataclass(frozen=True, eq=False)
class PlaceTest:
    """p_value: of "the place does not matter". places, trials: that were repeated, and in them.

    means_m (places, 3): the mean miss of each. part_m: rms length of what differs between places,
    less what chance would give, m. S (3, 3): the covariance within places, m^2, and axes: how many
    it really fills, 1 to 3. p_follows: of "the means of the places do not follow the pose", by the
    regression on them alone; None where p_value is not below the level, or the places too few.
    """

    p_value: float
    trials: int
    means_m: Floats
    part_m: float
    S: Floats
    axes: float
    p_follows: float | None

    @property
    def places(self) -> int:
        """That were repeated."""
        return len(self.means_m)

    @property
    def columns(self) -> int:
        """Numbers that differences between the places have."""
        return 3 * (self.places - 1)

    @property
    def scatter_m(self) -> float:
        """Of repeats in one place, rms length, m."""
        return float(np.sqrt(np.trace(self.S)))


def place_test(misses: Floats, T_base_gripper: Floats, level: float) -> PlaceTest | None:
    """Test misses (n, 3), m, at poses (n, 4, 4), n >= 2, for differences between places.

    Only places with 2 trials or more count. None where they are fewer than 3, or hold less than
    half of the trials: then the set says more about the pose by where it was than by repeats.
    """
    place = find_places(T_base_gripper)
    repeated = np.bincount(place)[place] >= FEWEST_REPEATS
    names, first, place = np.unique(place[repeated], return_index=True, return_inverse=True)
    if len(names) < FEWEST_PLACES or np.mean(repeated) < REPEATED:
        return None
    columns = pose_columns(T_base_gripper[repeated][first])
    return _between_against_within(misses[repeated], place, columns, level)


def find_places(T_base_gripper: Floats) -> Labels:
    """A number, 0 or more, for the place of each pose (n, 4, 4), n >= 2: (n,).

    Any two poses of a place are within 1 cm and 3 degrees (complete linkage), whatever the order.
    """
    from scipy.cluster.hierarchy import fcluster, linkage
    from scipy.spatial.distance import pdist

    turns = T_base_gripper[:, :3, :3].reshape(-1, 9) / np.sqrt(2)  # apart by the angle, if small
    apart = np.maximum(pdist(T_base_gripper[:, :3, 3]) / SAME_M, pdist(turns) / SAME_RAD)
    return np.asarray(fcluster(linkage(apart, "complete"), 1.0, "distance")) - 1


def _between_against_within(
    misses: Floats, place: Labels, columns: Floats, level: float
) -> PlaceTest:
    from scipy.stats import f

    n, places = len(misses), len(columns)
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
    part = max(between - (places - 1) * total, 0.0) / n
    regression = pose_test(means, columns, {}, STILL, level) if p_value < level else None
    follows = None if regression is None else regression.p_value
    return PlaceTest(p_value, n, means, float(np.sqrt(part)), S, axes, follows)
