"""A lens, two boards, and fits to simulated sessions of them that several test modules share."""

from functools import cache

from common import CHARUCO, CHECKERBOARD, NIGHTLY

from coursekit import intrinsics
from coursekit.boards import Board
from coursekit.geometry import Intrinsics
from coursekit.simulation.corner_sessions import corner_session

__all__ = ["CHARUCO", "CHECKERBOARD", "LENS", "NIGHTLY", "fit"]
LENS = Intrinsics(
    640, 480, 612.0, 610.0, 322.0, 238.0, "brown_conrady", (0.08, -0.18, 0.0007, -0.0004, 0.05)
)


@cache
def fit(board: Board, seed: int, **session) -> intrinsics.IntrinsicsResult:
    """The fit to the views of one seed, made once a run; its `detections` are the views."""
    return intrinsics.calibrate(corner_session(board, LENS, seed, **session)[0], board)
