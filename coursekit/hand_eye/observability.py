"""Which directions of X a set of arm poses determines, and which it leaves free."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from coursekit.hand_eye.poses import (
    Mount,
    carrier_stand,
    check_mount,
    check_one,
    check_poses,
    mean_pose,
)
from coursekit.hand_eye.refine import by_X_and_Y

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]

ROTATION_RAD, POSITION_M = np.radians(0.1), 0.5e-3  # what a pair of pose and image scatters by
LEVER_M = 0.3  # a rotation of X counts by what it does this far in front of the camera
FREE_M = 0.03  # a direction known no better than this is free: nobody would mount a camera so
TURN_DEG = 10.0  # rms about an axis from which that axis counts as turned about


@dataclass(frozen=True, eq=False, repr=False)
class Observability:
    """What the poses determine of X.

    singular_values (6,): of the linearised problem, descending, 1/m: one over the standard
    deviation with which X comes out along each direction. directions (6, 6): rows (omega, v), the
    directions in the frame that X is given in, rotations measured by what they do at `LEVER_M`.
    free: the undetermined ones, in words. turns_deg (3,): rms rotation between poses about the
    principal axes (rows of axes (3, 3), same frame). largest_turn_deg: between any two poses.
    """

    singular_values: Floats
    directions: Floats
    free: tuple[str, ...]
    turns_deg: Floats
    axes: Floats
    largest_turn_deg: float
    poses: int

    @property
    def sigma_mm(self) -> Floats:
        """Standard deviation along each direction, mm, ascending; infinite if nothing is known."""
        with np.errstate(divide="ignore"):
            return 1e3 / self.singular_values

    @property
    def determined(self) -> bool:
        """Whether all six directions are."""
        return not self.free

    @property
    def axes_turned(self) -> int:
        """About how many axes the poses turn."""
        return int(np.sum(self.turns_deg > TURN_DEG))

    def __repr__(self) -> str:
        turns = ", ".join(f"{turn:.1f}" for turn in self.turns_deg)
        sigmas = ", ".join(_size(sigma) for sigma in self.sigma_mm)
        lines = [
            f"{self.poses} poses, turned by {turns} deg (rms) about three axes, at most "
            f"{self.largest_turn_deg:.0f} deg between two",
            f"X would be known to {sigmas} mm (1 sigma, its six directions)",
            "All of X is determined." if self.determined else "NOT determined: "
            + "; ".join(self.free) + ".",
        ]  # fmt: skip
        return "\n".join(textwrap.fill(line, 88, subsequent_indent="  ") for line in lines)


def observability(
    T_base_gripper: ArrayLike,
    mount: Mount,
    X: ArrayLike | None = None,
    Y: ArrayLike | None = None,
    rotation_rad: float = ROTATION_RAD,
    position_m: float = POSITION_M,
) -> Observability:
    """What arm poses (n, 4, 4) determine of X, before any solver runs.

    rotation_rad, position_m: by how much one pair of arm pose and image scatters. X, Y (4, 4):
    where camera and board roughly are; without them the camera is taken to sit at its carrier's
    origin, and the board where it is nearest to it. They change how well X is determined and where
    an axis lies, not which directions are free. Raises ValueError for poses that are none.
    """
    poses = check_poses("T_base_gripper", T_base_gripper, 2)
    check_mount(mount)
    for name, size in (("rotation_rad", rotation_rad), ("position_m", position_m)):
        if not size > 0:
            raise ValueError(f"{name}: got {size!r}, want a positive standard deviation")
    X = np.eye(4) if X is None else check_one("X", X)
    Y = _nearest_stand(poses, mount, X) if Y is None else check_one("Y", Y)
    root = known_of_X(poses, mount, X, Y, rotation_rad, position_m)
    _, values, directions = np.linalg.svd(root / units())
    values = np.where(values < 1e-9 * values[0], 0.0, values)
    weak = directions[values * FREE_M < 1.0] / units()
    turns, axes = _diversity(poses, mount)
    return Observability(
        values, directions / units(), tuple(_in_words(weak)), turns, axes,
        _largest_turn(poses), len(poses),
    )  # fmt: skip


def units() -> Floats:
    """What turns (omega, v) into metres, (6,): omega acts at `LEVER_M`."""
    return np.array([LEVER_M, LEVER_M, LEVER_M, 1.0, 1.0, 1.0])


def known_of_X(
    poses: Floats, mount: Mount, X: Floats, Y: Floats, rotation_rad: float, position_m: float
) -> Floats:
    """The Jacobian (6n, 6) of the scaled residuals by X, what Y can imitate taken out."""
    rows = by_X_and_Y(poses, X, Y, mount) / np.repeat([rotation_rad, position_m], 3)[:, None]
    rows = rows.reshape(-1, 12)
    by_X, by_Y = rows[:, :6], rows[:, 6:]
    q, _ = np.linalg.qr(by_Y)
    return by_X - q @ (q.T @ by_X)


def _nearest_stand(poses: Floats, mount: Mount, X: Floats) -> Floats:
    """Y with the board where, over all poses, it is nearest to the camera."""
    M = carrier_stand(poses, mount)
    Y = np.eye(4)
    rows, right = M[:, :3, :3].reshape(-1, 3), (X[:3, 3] - M[:, :3, 3]).ravel()
    Y[:3, 3] = np.linalg.lstsq(rows, right, rcond=None)[0]
    return Y


def _diversity(poses: Floats, mount: Mount) -> tuple[Floats, Floats]:
    """Rms rotation about the principal axes, deg, in the carrier's frame, and those axes.

    Each pose against the mean pose; about the carrier's axes, because X is given there.
    """
    from scipy.spatial.transform import Rotation

    M = carrier_stand(poses, mount)
    turns = Rotation.from_matrix(M[:, :3, :3] @ mean_pose(M)[:3, :3].T).as_rotvec()
    _, values, axes = np.linalg.svd(turns, full_matrices=True)
    full = np.zeros(3)
    full[: len(values)] = values
    return np.degrees(full) / np.sqrt(len(poses)), axes


def _largest_turn(poses: Floats) -> float:
    i, j = np.triu_indices(len(poses), 1)
    cosines = (np.einsum("nij,nij->n", poses[i, :3, :3], poses[j, :3, :3]) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosines.min(), -1.0, 1.0))))


# --- words ---


def _in_words(weak: Floats) -> list[str]:
    """Free directions, rows (omega, v) (k, 6), as phrases."""
    if not len(weak):
        return []
    scaled = weak * units()
    # Turns: the span of the omegas. Pure shifts: combinations of the rows whose omega vanishes.
    u, turns, axes = np.linalg.svd(scaled[:, :3])
    turning = int(np.sum(turns > 0.05))
    shifts = (u.T @ scaled)[turning:, 3:]
    rank = 0
    if len(shifts):
        _, sizes, along = np.linalg.svd(shifts)
        rank = int(np.sum(sizes > 0.05))
    words = []
    if turning:
        words.append(f"rotation about {_named(axes[:turning], 'axis', 'axes')} is free")
    if rank:
        words.append(f"translation along {_named(along[:rank], 'axis', 'axes')} is free")
    return words


def _named(axes: Floats, one: str, many: str) -> str:
    if len(axes) == 3:
        return f"all {many}"
    if len(axes) == 2:
        normal = np.cross(axes[0], axes[1])
        return f"all {many} across {_vector(normal)}"
    return f"the common {one} {_vector(axes[0])}"


def _vector(axis: Floats) -> str:
    axis = axis / np.linalg.norm(axis) * np.sign(axis[np.argmax(np.abs(axis))])
    parts = [0.0 if abs(part) < 0.005 else part for part in axis]
    return "(" + ", ".join(f"{part:.2f}".rstrip("0").rstrip(".") for part in parts) + ")"


def _size(sigma_mm: float) -> str:
    return "unknown" if not np.isfinite(sigma_mm) or sigma_mm > 1e4 else f"{sigma_mm:.2g}"
