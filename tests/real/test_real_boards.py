"""Boards that other people photographed, with the answers that they published."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from coursekit.boards import Board, BoardNotFound, detect, detect_all

pytestmark = pytest.mark.real

CHECKERBOARD = Board("checkerboard", (10, 7), 0.025)
CHARUCO = Board("charuco", (5, 7), 0.04, 0.02, "DICT_6X6_250")


@pytest.fixture(scope="module")
def folder():
    if not os.environ.get("COURSEKIT_REAL_DATA"):
        pytest.skip("COURSEKIT_REAL_DATA is not set: it names the folder of real data")
    return Path(os.environ["COURSEKIT_REAL_DATA"])


def fit(seen, board, flags=0):
    """RMS, K and RMS of each view, by OpenCV with one thread."""
    points = [board.points[view.ids].astype(np.float32) for view in seen]
    pixels = [view.pixels.astype(np.float32) for view in seen]
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        guess = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1]])
        rms, K, *_, per_view = cv2.calibrateCameraExtended(
            points, pixels, seen.size, guess, None, flags=flags
        )
    finally:
        cv2.setNumThreads(threads)
    return rms, K, per_view.ravel()


def test_all_thirteen_checkerboards(folder):
    """With a window that fits, RMS is half of the published 0.39 px, and no view sticks out."""
    seen = detect_all(folder / "opencv_chessboard", CHECKERBOARD)
    assert [skip.name for skip in seen.skipped] == ["left_intrinsics_published.txt"]
    assert len(seen) == 13
    assert min(len(view) for view in seen) >= 53
    rms, K, per_view = fit(seen, CHECKERBOARD, cv2.CALIB_FIX_ASPECT_RATIO)
    assert rms < 0.19
    assert per_view.max() < 0.25
    assert K[0, 0] == pytest.approx(535.9, abs=4)  # published, from 11 px windows
    np.testing.assert_allclose(K[:2, 2], [342.3, 235.6], atol=3)


def test_the_corners_are_those_of_opencv(folder):
    """With 5 px windows: a tenth of a px apart, the lens and JPEG in a window twice as wide."""
    seen = detect_all(folder / "opencv_chessboard", CHECKERBOARD)
    distances = []
    for view in seen:
        image = cv2.imread(str(folder / "opencv_chessboard" / view.name), cv2.IMREAD_GRAYSCALE)
        theirs = view.pixels.astype(np.float32).reshape(-1, 1, 2).copy()
        cv2.cornerSubPix(image, theirs, (5, 5), (-1, -1), (3, 50, 1e-3))
        distances.append(np.linalg.norm(view.pixels - theirs.reshape(-1, 2), axis=1))
    assert np.median(np.concatenate(distances)) < 0.15


@pytest.mark.parametrize("squares", [(9, 6), (9, 7), (8, 6), (6, 5)])
def test_a_wrong_size_is_never_found_and_the_right_one_named(folder, squares):
    for number in (1, 8, 13):
        image = cv2.imread(str(folder / f"opencv_chessboard/left{number:02}.jpg"))
        with pytest.raises(BoardNotFound, match="but a checkerboard of 10x7 squares"):
            detect(image, Board("checkerboard", squares, 0.025))


def test_the_four_charuco_boards_are_of_either_origin(folder):
    """Seven rows are an odd number: the print is the same before and after OpenCV 4.6."""
    seen = detect_all(folder / "opencv_charuco", CHARUCO)
    assert [len(view) for view in seen] == [24] * 4
    rms, _, _ = fit(seen, CHARUCO)
    assert rms < 0.19  # published: 0.1823
    old = Board("charuco", (5, 7), 0.04, 0.02, "DICT_6X6_250", old_origin=True)
    upside_down = np.arange(24).reshape(6, 4)[::-1].ravel()
    for one, other in zip(seen, detect_all(folder / "opencv_charuco", old), strict=True):
        np.testing.assert_allclose(other.pixels, one.pixels[upside_down], atol=1e-6)


@pytest.mark.parametrize(("old_origin", "away_mm"), [(True, (0, 2)), (False, (190, 205))])
def test_the_published_pose_has_the_old_origin(folder, old_origin, away_mm):
    image = cv2.imread(str(folder / "moveit_hand_eye/test_charuco_board_detection.jpg"))
    board = Board("charuco", (5, 7), 0.1971 / 7, 0.0176, "DICT_5X5_250", old_origin)
    K = np.array([[590.6972, 0, 322.3310], [0, 592.8468, 247.4003], [0, 0, 1]])
    dist = np.array([0.15405, -0.24917, 0.0035079, -0.0011004, 0])
    seen = detect(image, board)
    _, _, t = cv2.solvePnP(board.points[seen.ids], seen.pixels, K, dist)
    away = 1000 * np.linalg.norm(t.ravel() - [0.0975, 0.1028, 0.3256])
    assert away_mm[0] <= away <= away_mm[1]
