"""What views say about the poses of the board in them: corners in pixels, or poses measured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np

from coursekit.arm import pose_difference
from coursekit.hand_eye.poses import cross_matrix
from coursekit.intrinsics.derivatives import project_with_derivatives, twist_columns

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from coursekit.boards import Board, Detection
    from coursekit.geometry import Intrinsics

    Floats = NDArray[np.float64]


class Views(Protocol):
    """What n views say about the poses of the board in them."""

    @property
    def observations(self) -> int:
        """How many numbers were observed."""

    def linear(self, T_camera_board: Floats, scale: float) -> tuple[Floats, Floats, Floats]:
        """At poses (n, 4, 4): squares (n,), gradient (n, 7), information (n, 7, 7); whitened.

        The gradient is J'r and the information J'J of the twist (omega, v) of each pose and of
        the logarithm of the board's scale. Infinite squares for a board that reaches behind the
        camera.
        """


@dataclass(frozen=True, eq=False)
class PixelViews:
    """Corners: board points (N, 3) in m, pixels (N, 2), and where each view starts (n,).

    sigma_px: the standard deviation of one coordinate.
    """

    points: Floats
    pixels: Floats
    starts: NDArray[np.intp]
    intrinsics: Intrinsics
    sigma_px: float

    @classmethod
    def of(
        cls,
        detections: Sequence[Detection],
        board: Board,
        intrinsics: Intrinsics,
        sigma_px: float = 1.0,
    ) -> PixelViews:
        """The corners of detections in one row."""
        counts = [len(seen.ids) for seen in detections]
        ids = np.concatenate([seen.ids for seen in detections])
        pixels = np.concatenate([seen.pixels for seen in detections])
        starts = np.cumsum([0, *counts[:-1]])
        return cls(board.points[ids], pixels, starts, intrinsics, sigma_px)

    @property
    def observations(self) -> int:
        """Two a corner."""
        return self.pixels.size

    @cached_property
    def view(self) -> NDArray[np.intp]:
        """The view (N,) of each corner."""
        counts = np.diff([*self.starts, len(self.pixels)])
        return np.repeat(np.arange(len(self.starts)), counts)

    def pick(self, which: NDArray[np.intp]) -> PixelViews:
        """The views with these numbers, in this order."""
        ends = [*self.starts[1:], len(self.pixels)]
        rows = [np.arange(self.starts[i], ends[i]) for i in which]
        starts = np.cumsum([0, *(len(row) for row in rows[:-1])])
        chosen = np.concatenate(rows)
        return replace(self, points=self.points[chosen], pixels=self.pixels[chosen], starts=starts)

    def predicted(self, T_camera_board: Floats, scale: float = 1.0) -> tuple[Floats, Floats]:
        """Corners in the camera's frame and the same from the board's origin, (N, 3) each, m."""
        T = T_camera_board[self.view]
        arm = np.einsum("nij,nj->ni", T[:, :3, :3], scale * self.points)
        return arm + T[:, :3, 3], arm

    def residuals(self, T_camera_board: Floats, scale: float = 1.0) -> Floats:
        """Observed - predicted, (N, 2) px; infinite for a corner behind the camera."""
        at, _ = self.predicted(T_camera_board, scale)
        front = at[:, 2] > 0
        pixels = np.full((len(at), 2), np.inf)
        pixels[front] = project_with_derivatives(at[front], self.intrinsics)[0]
        return self.pixels - pixels

    def linear(self, T_camera_board: Floats, scale: float) -> tuple[Floats, Floats, Floats]:
        """See `Views`."""
        at, arm = self.predicted(T_camera_board, scale)
        behind = np.logical_or.reduceat(at[:, 2] <= 0, self.starts)
        at[behind[self.view], 2] = 1.0
        predicted, _, by_point = project_with_derivatives(at, self.intrinsics)
        residuals = (self.pixels - predicted) / self.sigma_px
        columns = np.empty((len(at), 2, 7))
        columns[..., :6] = twist_columns(arm, by_point)
        columns[..., 6] = np.einsum("nij,nj->ni", by_point, arm)
        columns /= self.sigma_px
        turned_columns = np.swapaxes(columns, 1, 2)
        gradient = (turned_columns @ residuals[..., None])[..., 0]
        squares = np.add.reduceat((residuals**2).sum(axis=1), self.starts)
        return (
            np.where(behind, np.inf, squares),
            np.add.reduceat(gradient, self.starts),
            np.add.reduceat(turned_columns @ columns, self.starts),
        )


@dataclass(frozen=True, eq=False)
class PoseViews:
    """Poses T_camera_board (n, 4, 4) that somebody measured, with their information (n, 6, 6)."""

    poses: Floats
    information: Floats

    @property
    def observations(self) -> int:
        """Six a pose."""
        return 6 * len(self.poses)

    def linear(self, T_camera_board: Floats, scale: float) -> tuple[Floats, Floats, Floats]:
        """See `Views`. A board `scale` times larger than said shrinks all distances by as much."""
        predicted = T_camera_board.copy()
        predicted[:, :3, 3] /= scale
        residuals = pose_difference(predicted, self.poses)
        columns = np.zeros((len(self.poses), 6, 7))
        # log(exp(r) exp(-w)) = r - (1 + [r]x / 2 + ..) w
        columns[:, :3, :3] = np.eye(3) + cross_matrix(residuals[:, :3]) / 2
        columns[:, 3:, 3:6] = np.eye(3) / scale
        columns[:, 3:, 6] = -predicted[:, :3, 3]
        weighted = np.swapaxes(columns, 1, 2) @ self.information
        return (
            np.einsum("ni,nij,nj->n", residuals, self.information, residuals),
            np.einsum("nij,nj->ni", weighted, residuals),
            weighted @ columns,
        )
