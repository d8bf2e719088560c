"""Boards that other people photographed, with the answers that they published."""

import cv2
import numpy as np
import pytest

from coursekit.boards import Board, BoardNotFound, detect, detect_all

pytestmark = pytest.mark.real

CHARUCO = Board("charuco", (5, 7), 0.04, 0.02, "DICT_6X6_250")


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
    old = Board("charuco", (5, 7), 0.04, 0.02, "DICT_6X6_250", old_origin=True)
    upside_down = np.arange(24).reshape(6, 4)[::-1].ravel()
    for one, other in zip(seen, detect_all(real_data / "opencv_charuco", old), strict=True):
        np.testing.assert_allclose(other.pixels, one.pixels[upside_down], atol=1e-6)
