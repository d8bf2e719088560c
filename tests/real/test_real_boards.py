"""Boards that other people photographed, with the answers that they published."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from coursekit.boards import Board, BoardNotFound, detect, detect_all

pytestmark = pytest.mark.real

CHECKERBOARD = Board("checkerboard", (10, 7), 0.025)
CHARUCO = Board("charuco", (5, 7), 0.04, 0.02, "DICT_6X6_250")


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


def test_all_thirteen_checkerboards(checkerboards):
    """With a window that fits, RMS is half of the published 0.39 px, and no view sticks out."""
    seen = checkerboards
    assert [skip.name for skip in seen.skipped] == ["left_intrinsics_published.txt"]
    assert len(seen) == 13
    assert min(len(view) for view in seen) >= 53
    rms, K, per_view = fit(seen, CHECKERBOARD, cv2.CALIB_FIX_ASPECT_RATIO)
    assert rms < 0.19
    assert per_view.max() < 0.25
    assert K[0, 0] == pytest.approx(535.9, abs=4)  # published, from 11 px windows
    np.testing.assert_allclose(K[:2, 2], [342.3, 235.6], atol=3)


def test_the_corners_are_those_of_opencv(checkerboards, real_data):
    """With 5 px windows: a tenth of a px apart, the lens and JPEG in a window twice as wide."""
    distances = []
    for view in checkerboards:
        image = cv2.imread(str(real_data / "opencv_chessboard" / view.name), cv2.IMREAD_GRAYSCALE)
        theirs = view.pixels.astype(np.float32).reshape(-1, 1, 2).copy()
        cv2.cornerSubPix(image, theirs, (5, 5), (-1, -1), (3, 50, 1e-3))
        distances.append(np.linalg.norm(view.pixels - theirs.reshape(-1, 2), axis=1))
    assert np.median(np.concatenate(distances)) < 0.15


@pytest.mark.parametrize("squares", [(9, 6), (9, 7), (8, 6), (6, 5)])
def test_a_wrong_size_is_never_found_and_the_right_one_named(real_data, squares):
    for number in (1, 13):
        image = cv2.imread(str(real_data / f"opencv_chessboard/left{number:02}.jpg"))
        with pytest.raises(BoardNotFound, match="but a checkerboard of 10x7 squares"):
            detect(image, Board("checkerboard", squares, 0.025))


def test_the_four_charuco_boards_are_of_either_origin(charuco_views, real_data):
    """Seven rows are an odd number: the print is the same before and after OpenCV 4.6."""
    seen = charuco_views
    assert [len(view) for view in seen] == [24] * 4
    rms, _, _ = fit(seen, CHARUCO)
    assert rms < 0.19  # published: 0.1823
    old = Board("charuco", (5, 7), 0.04, 0.02, "DICT_6X6_250", old_origin=True)
    upside_down = np.arange(24).reshape(6, 4)[::-1].ravel()
    for one, other in zip(seen, detect_all(real_data / "opencv_charuco", old), strict=True):
        np.testing.assert_allclose(other.pixels, one.pixels[upside_down], atol=1e-6)
