"""How large the board really is: its scale against a depth camera's Z or a robot's motion.

A board twice as large at twice the distance gives the same images, so images never show a wrong
square size; whatever else knows metres does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from coursekit.geometry import invert_transform
from coursekit.intrinsics.fit import MIN_CORNERS, MIN_VIEWS

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from coursekit.boards import Detection
    from coursekit.intrinsics.fit import IntrinsicsResult

    Floats = NDArray[np.float64]

TURNING_RAD = 0.05  # motions that turn less say nothing about the camera's place on the gripper


@dataclass(frozen=True)
class Scale:
    """How much larger the world is than the board claims: `factor` (1 is right) and its sigma."""

    factor: float
    sigma: float


def depth_scale(result: IntrinsicsResult, depth_m: Sequence[Floats]) -> Scale | None:
    """The median over the views of measured Z over the fit's Z; None with fewer than 3 views."""
    ratios = []
    for T, detection, measured in zip(
        result.T_camera_board, result.detections, depth_m, strict=True
    ):
        predicted = result.points[detection.ids] @ T[2, :3] + T[2, 3]
        valid = np.isfinite(measured) & (np.asarray(measured) > 0)
        if valid.sum() >= MIN_CORNERS:
            ratios.append(np.median(np.asarray(measured)[valid] / predicted[valid]))
    if len(ratios) < MIN_VIEWS:
        return None
    factor = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(np.array(ratios) - factor)))
    # A median of n values has 1.25 times the error of a mean. All predicted Z scale with fx.
    own = 1.25 * spread / np.sqrt(len(ratios))
    return Scale(factor, float(np.hypot(own, result.sigma("fx") / result.value("fx"))))


def robot_scale(result: IntrinsicsResult, T_base_gripper: Floats) -> Scale | None:
    """The robot's metres over the board's, from the motions between successive views.

    With B X = X A for the gripper's motion B and the camera's motion A, whose translation is
    unknown by a factor s: (R_B - I) t_X - s R_X t_A = -t_B is linear in the mount's translation
    t_X and in s, once R_X has turned the axes of A into those of B. None where too few motions
    turn, since then the two cannot be told apart.
    Source: Park and Martin, "Robot sensor calibration" (1994), with a scale added.
    """
    from scipy.spatial.transform import Rotation

    camera = invert_transform(result.T_camera_board)  # T_board_camera
    A = invert_transform(camera[:-1]) @ camera[1:]
    B = invert_transform(T_base_gripper[:-1]) @ T_base_gripper[1:]
    alpha, beta = (Rotation.from_matrix(M[:, :3, :3]).as_rotvec() for M in (A, B))
    turning = np.linalg.norm(beta, axis=1) > TURNING_RAD
    if np.linalg.matrix_rank(beta[turning], tol=TURNING_RAD) < 2:
        return None
    R_X = Rotation.align_vectors(beta[turning], alpha[turning])[0].as_matrix()
    columns = np.concatenate(
        [B[:, :3, :3] - np.eye(3), -(A[:, :3, 3] @ R_X.T)[..., None]], axis=2
    ).reshape(-1, 4)
    wanted = -B[:, :3, 3].ravel()
    solution, _, rank, _ = np.linalg.lstsq(columns, wanted, rcond=None)
    if rank < 4 or len(wanted) <= 4:
        return None
    off = wanted - columns @ solution
    variance = float(off @ off) / (len(wanted) - 4) * np.linalg.inv(columns.T @ columns)[3, 3]
    return Scale(float(solution[3]), float(np.sqrt(variance)))


def depth_at_corners(
    detections: Sequence[Detection], depth_images_m: Sequence[ArrayLike]
) -> list[Floats]:
    """Z (N_i,) at the corners of each view, m: the median of the valid depths in 3x3 px, or NaN.

    depth_images_m: one (H, W) a view, aligned to the images in which the corners were found, m,
    0 or NaN where invalid. Raises ValueError for another number of images or another size.
    """
    if len(depth_images_m) != len(detections):
        raise ValueError(
            f"depth_images_m: got {len(depth_images_m)} images, want {len(detections)}, one a view"
        )
    depths = []
    for number, (detection, given) in enumerate(zip(detections, depth_images_m, strict=True)):
        image = np.asarray(given, float)
        if image.shape != detection.size[::-1]:
            raise ValueError(
                f"depth_images_m: image {number} has shape {image.shape}, want "
                f"{detection.size[::-1]}, aligned to the images of the corners"
            )
        padded = np.pad(np.where(image > 0, image, np.nan), 1, constant_values=np.nan)
        u, v = np.rint(detection.pixels).astype(int).T
        near = np.stack([padded[v + i, u + j] for i in range(3) for j in range(3)])
        some = np.isfinite(near).any(axis=0)
        z = np.full(len(u), np.nan)
        z[some] = np.nanmedian(near[:, some], axis=0)
        depths.append(z)
    return depths
