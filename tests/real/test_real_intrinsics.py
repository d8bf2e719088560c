"""OpenCV's own calibration pictures, against what its authors published and what it hides."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from coursekit import intrinsics
from coursekit.boards import Board, Detection, Detections

pytestmark = pytest.mark.real

CHESSBOARD = Board("checkerboard", (10, 7), 0.025)
CHARUCO = Board("charuco", (5, 7), 0.04, 0.02, "DICT_6X6_250")
PUBLISHED = {"f": 535.91573, "cx": 342.28315, "cy": 235.57083}
PUBLISHED_RMS_PX = 0.39259
PUBLISHED_PER_VIEW_PX = [
    0.19297, 1.18205, 0.17318, 0.19342, 0.15957, 0.17968, 0.23099, 0.24195, 0.29627, 0.16718,
    0.20200, 0.38104, 0.17440,
]  # fmt: skip


@pytest.fixture(scope="module")
def published_corners(real_data) -> Detections:
    """Corners as OpenCV's sample finds them: an 11 px half window for cornerSubPix."""
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.1)
    views = []
    for path in sorted((real_data / "opencv_chessboard").glob("left*.jpg")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        found, corners = cv2.findChessboardCorners(image, CHESSBOARD.corners)
        assert found
        corners = cv2.cornerSubPix(image, corners, (11, 11), (-1, -1), criteria)[:, 0]
        views.append(Detection(np.arange(54), corners, image.shape[::-1], path.name))
    return Detections(views)


@pytest.fixture(scope="module")
def published(published_corners) -> intrinsics.IntrinsicsResult:
    return intrinsics.calibrate(published_corners, CHESSBOARD, same_focal=True)


def test_the_published_fit_comes_out_with_the_published_settings(published):
    """fx = fy held, five coefficients, 11 px window: within 2 % of the stated sigmas."""
    assert published.converged
    assert published.rms_px == pytest.approx(PUBLISHED_RMS_PX, abs=0.001)
    for name, value in PUBLISHED.items():
        assert published.value(name) == pytest.approx(value, abs=0.02 * published.sigma(name))
    np.testing.assert_allclose(published.per_view_rms_px, PUBLISHED_PER_VIEW_PX, atol=0.002)


def test_the_window_moves_f_by_more_than_its_interval(published, checkerboards):
    """With windows as wide as the corners allow, view 02 is as good as any and f is another."""
    assert len(checkerboards) == 13
    ours = intrinsics.calibrate(checkerboards, CHESSBOARD, same_focal=True)
    assert published.per_view_rms_px[1] > 1.1
    assert ours.per_view_rms_px.max() < 0.3
    assert ours.rms_px == pytest.approx(0.195, abs=0.02)
    assert 2 < published.value("f") - ours.value("f") < 4
    assert published.value("f") - ours.value("f") > 2.2 * published.sigma("f")


def test_halves_agree_in_the_middle_and_differ_by_pixels_at_the_edge(checkerboards):
    both = intrinsics.halves(checkerboards, CHESSBOARD)
    length = both.length_px
    assert length[10:20, 15:25].max() < 0.15
    assert 5 < length.max() < 40
    assert both.expected_px.max() > 5  # and the covariance says so
    verdict = intrinsics.calibrate(checkerboards, CHESSBOARD).verdict()
    assert verdict.startswith("Not good enough: in 95 % of the image")
    assert "no corners in the outer tenth" in verdict


def test_four_charuco_views_do_not_determine_k(charuco_views):
    assert len(charuco_views) == 4
    fit = intrinsics.calibrate(charuco_views, CHARUCO)
    assert fit.rms_px == pytest.approx(0.19, abs=0.03)
    assert fit.sigma("fx") > 10
    assert fit.sigma("cy") > 7
    low, high = fit.interval("fx")
    assert low < 452.5 < high  # the published fit, 27 px from the careful re-run with equal RMS
    verdict = fit.verdict()
    assert verdict.startswith("Not good enough: these 4 views do not determine K")
    assert "tilt 30 to 45" in verdict.replace("\n  ", " ")


def test_diagnose_names_the_artefact_in_view_02(published_corners):
    """A refinement window wider than the corners' spacing took in a neighbour."""
    found = {f.name: f for f in intrinsics.diagnose(published_corners, CHESSBOARD)}
    assert "left02" in found["spoiled_view"].evidence
    assert "window" in found["spoiled_view"].remedy


def test_diagnose_says_that_the_halves_disagree_at_the_edge(checkerboards):
    found = {f.name: f for f in intrinsics.diagnose(checkerboards, CHESSBOARD)}
    assert "spoiled_view" not in found
    assert "halves_disagree" in found


def test_diagnose_says_that_four_views_are_few(charuco_views):
    found = intrinsics.diagnose(charuco_views, CHARUCO)
    assert {"few_views", "no_edge_corners"} <= set(found.names)
