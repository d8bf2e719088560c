"""Lenses, boards, sessions and fits to simulated sessions that several test modules share."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
from common import CHARUCO, CHECKERBOARD, EXPECTED, NIGHTLY

from coursekit import intrinsics
from coursekit.arm import ArmErrors
from coursekit.boards import Board, Detections
from coursekit.geometry import Intrinsics
from coursekit.hand_eye.session import HandEyeSession
from coursekit.simulation.arm_sessions import HandEyeMistakes, HandEyeTruth, hand_eye_session
from coursekit.simulation.corner_sessions import Truth, corner_session, ordinary

__all__ = ["CHARUCO", "CHECKERBOARD", "LENS", "NIGHTLY", "fit"]
LENS = Intrinsics(
    640, 480, 612.0, 610.0, 322.0, 238.0, "brown_conrady", (0.08, -0.18, 0.0007, -0.0004, 0.05)
)
LENSES = [Intrinsics(*fields) for fields in EXPECTED["lenses"]]
BOARDS = [CHARUCO, CHECKERBOARD]
# Fisheyes of 120 to 160 degrees across the diagonal, and wide lenses that are a quotient of two
# polynomials, which grows all the way: five coefficients leave two to eight times the noise.
QUOTIENT = {"model": "brown_conrady", "coeffs": (0.12, 0.0, 0.0, 0.0, 0.0)}


def fisheye(points: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """Pixels of an image that grows with the angle."""
    still = np.zeros(3)
    return cv2.fisheye.projectPoints(points[:, None], still, still, lens.K, np.zeros(4))[0][:, 0]


def quotient(points: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """Pixels by OpenCV's rational model, k4 = 0.4 after the lens's own coefficients."""
    dist, still = np.concatenate([lens.dist, [0.4, 0.0, 0.0]]), np.zeros(3)
    return cv2.projectPoints(points[:, None], still, still, lens.K, dist)[0][:, 0]


BEYOND = [
    (replace(LENSES[1], fx=300, fy=300), fisheye),
    (replace(LENSES[1], fx=250, fy=251), fisheye),
    (Intrinsics(1280, 720, 520, 521, 642, 362), fisheye),
    (replace(LENSES[1], fx=300, fy=300, **QUOTIENT), quotient),
    (Intrinsics(1280, 720, 560, 561, 642, 362, **QUOTIENT), quotient),
]


@cache
def fit(board: Board, seed: int, **session) -> intrinsics.IntrinsicsResult:
    """The fit to the views of one seed, made once a run; its `detections` are the views."""
    return intrinsics.calibrate(corner_session(board, LENS, seed, **session)[0], board)


def dense_jacobian(result: intrinsics.IntrinsicsResult) -> np.ndarray:
    """Of a fit's residuals by the shared parameters and by six numbers of each view."""
    shared, poses = result.equations.shared, result.equations.poses
    whole = np.zeros((len(shared), shared.shape[1] + 6 * len(poses)))
    whole[:, : shared.shape[1]] = shared
    for i, (block, rows) in enumerate(zip(poses, result.equations.slices, strict=True)):
        at = shared.shape[1] + 6 * i
        whole[rows, at : at + 6] = block
    return whole


def ordinary_session(seed: int, **more) -> tuple[Detections, Truth, Board]:
    """Both kinds of board, four lenses, 15 to 40 views and noise of 0.04 to 0.15 px in turn.

    more: fields of Effects, what else the session has.
    """
    board, lens = BOARDS[seed % 2], LENSES[(seed // 2) % 4]
    noise_px = 0.04 * 4 ** ((seed % 11) / 10)
    effects = replace(ordinary(seed), **more)
    views = 15 + (7 * seed) % 26
    return *corner_session(board, lens, seed, views, noise_px, effects), board


def beyond_session(seed: int) -> tuple[Detections, Truth, Board]:
    """A session, ordinary otherwise, through a lens that five coefficients do not describe."""
    board, (lens, see) = BOARDS[seed % 2], BEYOND[(seed // 2) % len(BEYOND)]
    street = replace(ordinary(seed), see=see)
    return *corner_session(board, lens, seed, 20 + (7 * seed) % 21, 0.08, street), board


def names_found(sessions: Iterable[tuple[Detections, Truth, Board]]) -> Counter[tuple[str, ...]]:
    """How often `diagnose` gives which names."""
    found = Counter(intrinsics.diagnose(seen, board).names for seen, _, board in sessions)
    print(dict(found))
    return found


def ordinary_arm_session(seed: int, **more) -> tuple[HandEyeSession, HandEyeTruth]:
    """Both mounts, 10 to 30 poses, an arm that errs per pose by 0.1 to 0.5 degrees and 0.5 to 2 mm
    (every third with heavy tails), every other one with zeros of joints and gear play besides.

    more: fields of HandEyeMistakes. Every fourth is reported without joint angles.
    """
    rng = np.random.default_rng([seed, 7])
    share = rng.random()
    habits = {
        "scatter_deg": 0.1 * 5**share,
        "scatter_m": 0.0005 * 4**share,
        "scatter_tails": seed % 3 == 2,
    }
    session, truth = hand_eye_session(
        ("eye_in_hand", "eye_to_hand")[seed % 2],
        seed,
        n=10 + seed % 21,
        corner_noise_px=rng.uniform(0.05, 0.2),
        arm_errors=ArmErrors() if (seed // 2) % 2 else None,
        mistakes=HandEyeMistakes(**habits | more),
        images=ordinary(seed),
    )
    return (replace(session, q=None, dq=None) if seed % 4 == 3 else session), truth
