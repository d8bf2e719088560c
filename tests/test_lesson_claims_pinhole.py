"""Rows P1 to P12 of data/claims.csv: the pinhole camera."""

import math
import tomllib

import cv2
import numpy as np
import pytest
from common import CHARUCO, CHECKERBOARD
from lesson_claims import ROWS, claim, nominal_fx_px

from coursekit import intrinsics, stereo
from coursekit.boards import detect
from coursekit.cameras import conventions
from coursekit.geometry import Intrinsics, deproject, distort, make_transform, pixel_grid, project
from coursekit.simulation.corner_sessions import corner_session
from coursekit.specifications import DATA, device, lens

K = np.array([[447.0, 0, 424], [0, 447, 240], [0, 0, 1]])
D435, D405, D415 = (device(name) for name in ("D435", "D405", "D415"))
NAMES = ("opencv_left", "moveit_camera", "d405_color", "duckiebot_wide")
LENSES = {name: lens(name).intrinsics for name in NAMES}


@claim("P1", "right")
def test_p1_depth_focal_length() -> None:
    nominal = nominal_fx_px("D435", 848)
    ROWS["P1"].says(f"{nominal:.1f} px", "447 px")
    assert nominal == pytest.approx(447, abs=0.5)
    # the units that data/devices.toml cites; the first gives 640x480, see the rule there
    table = tomllib.loads((DATA / "devices.toml").read_text("utf-8"))
    units = [382.918884 * 0.6625 / 0.6, 424.229095, 427.259766, D435.unit.depth.fx]
    for published in ("382.918884", "424.229095", "427.259766"):
        assert published in table["D435"]["unit"]["depth"]["source"]
    angles = [2 * math.degrees(math.atan(424 / f)) for f in units]
    ROWS["P1"].says(f"{min(units):.1f}-{max(units):.1f} px")
    ROWS["P1"].says(f"{max(angles):.1f}-{min(angles):.1f} deg")


@claim("P2", "right")
def test_p2_colour_focal_length() -> None:
    color = D435.unit.color
    scaled = color.fx * 720 / 480  # 480 rows are 720 shrunk; the sides are cut off
    nominal = 1280 / 2 / math.tan(math.radians(D435.nominal.color_hfov_deg / 2))
    ROWS["P2"].says(f"{color.fx:.1f} px", f"{scaled:.1f} px", f"{nominal:.1f} px", "910 px")
    assert scaled == pytest.approx(910, rel=0.02)


@claim("P3", "right")
def test_p3_principal_point_is_near_the_centre_and_not_on_it() -> None:
    measured = [*LENSES.values(), *(d.unit.depth for d in (D435, D405, D415))]
    for stream in measured:
        centre = (np.array(stream.size) - 1) / 2
        off = np.abs(np.array([stream.cx, stream.cy]) - centre)
        assert off.max() > 1.0
        assert (off < 0.05 * np.array(stream.size)).all()
    # even where the truth is the centre an estimate is not; told not to estimate, OpenCV returns it
    board, true = CHARUCO, Intrinsics(640, 480, 612, 610, 319.5, 239.5)
    views, _ = corner_session(board, true, 3)
    fitted = intrinsics.calibrate(views, board).intrinsics
    assert 0.001 < math.hypot(fitted.cx - 319.5, fitted.cy - 239.5) < 5
    points = [board.points[v.ids].astype(np.float32) for v in views]
    pixels, how = [v.pixels.astype(np.float32) for v in views], cv2.CALIB_FIX_PRINCIPAL_POINT
    _, fixed, *_ = cv2.calibrateCamera(points, pixels, (640, 480), None, None, flags=how)
    assert (fixed[0, 2], fixed[1, 2]) == (319.5, 239.5)


@claim("P4", "right")
def test_p4_focal_length_over_pixel_pitch() -> None:
    f, point = 0.010, np.array([0.03, 0.0, 0.5])
    on_sensor = f * point[0] / point[2]  # m, by similar triangles
    for pitch, wanted in ((10e-6, 1000), (5e-6, 2000)):
        K_sensor = np.array([[wanted, 0, 0], [0, wanted, 0], [0, 0, 1.0]])
        assert project(point, K_sensor)[0] == pytest.approx(on_sensor / pitch)
        ROWS["P4"].says(str(round(f / pitch)))


@claim("P5", "imprecise")
def test_p5_pixel_coordinates_are_continuous_and_begin_at_a_pixels_centre() -> None:
    """Whole numbers would cost 0.29 px a coordinate, several times what a detector makes of it."""
    board, true = CHECKERBOARD, Intrinsics(640, 480, 612, 610, 322, 238)
    views, _ = corner_session(board, true, 0, views=8, noise_px=0.0)
    pixels = np.concatenate([view.pixels for view in views])
    rounding = np.rint(pixels) - pixels
    assert rounding.std() == pytest.approx(1 / math.sqrt(12), rel=0.05)
    # Squares of 40 px side by side: pixel 39 is the last of the first, so their border is at 39.5
    margin, side = 60, 40
    image = np.pad(board.image(side), margin, constant_values=255)
    found = detect(image, board).pixels
    exact = margin + side * np.stack(np.meshgrid(range(1, 10), range(1, 7)), -1).reshape(-1, 2)
    assert np.abs(found - (exact - 0.5)).max() < 0.05
    assert np.abs(found - exact).min() > 0.4
    # OpenCV's and our grid of pixel centres begin at (0, 0)
    maps = cv2.initUndistortRectifyMap(K, np.zeros(5), None, K, (848, 480), cv2.CV_32FC1)
    np.testing.assert_allclose(np.stack(maps, -1), pixel_grid(848, 480), atol=1e-3)
    ROWS["P5"].says("continuous", "(0, 0) is the centre of the top-left pixel")


@claim("P6", "imprecise")
def test_p6_focal_length_carries_a_unit() -> None:
    """A number without a unit stays when the unit changes. Count in pixels twice as large: f_x
    halves as the disparity does, and lengths, which have other units, do not move."""
    f, B, Z, sigma_d = 447.0, 0.05, 0.8, 0.08
    d = f * B / Z
    in_large = np.diag([0.5, 0.5, 1]) @ K
    point = [0.1, 0.05, 0.45]
    np.testing.assert_allclose(project(point, in_large), project(point, K) / 2)
    assert in_large[0, 0] == f / 2  # so it is not dimensionless
    assert float(stereo.depth_from_disparity(d / 2, f / 2, B)) == pytest.approx(Z)
    assert float(stereo.depth_from_disparity(d / 2, f, B)) == pytest.approx(2 * Z)  # px forgotten
    noise = stereo.depth_noise(Z, f / 2, B, sigma_d / 2)
    assert noise == pytest.approx(stereo.depth_noise(Z, f, B, sigma_d))
    ROWS["P6"].says("px", "f_x B has units px.m")


def border_shift_px(camera: Intrinsics) -> tuple[float, float]:
    """Least and most that a lens moves the points of the image's border, px."""
    w, h = camera.size
    grid = pixel_grid(w, h)
    border = np.concatenate([grid[0], grid[-1], grid[:, 0], grid[:, -1]])
    ideal = (border - camera.K[:2, 2]) / [camera.fx, camera.fy]
    shift = (distort(ideal, camera.dist) - ideal) * [camera.fx, camera.fy]
    length = np.linalg.norm(shift, axis=1)
    return float(length.min()), float(length.max())


@claim("P7", "imprecise")
def test_p7_what_real_lenses_do_at_the_border() -> None:
    shifts = {name: border_shift_px(camera) for name, camera in LENSES.items()}
    (low, high), (low5, high5) = shifts["moveit_camera"], shifts["d405_color"]
    assert LENSES["moveit_camera"].hfov_deg == pytest.approx(57, abs=0.5)
    assert min(low, low5) > 3  # "1-3 px" holds nowhere on their borders
    ROWS["P7"].says("1-3; tens px", f"{low:.0f}-{high:.0f} px", f"{low5:.0f}-{high5:.0f} px of")
    wide = [shifts["opencv_left"], shifts["duckiebot_wide"]]
    ROWS["P7"].says(f"{min(s[0] for s in wide):.0f}-{max(s[1] for s in wide):.0f} px")
    assert max(s[1] for s in wide) > 50  # tens, and beyond


@claim("P8", "imprecise")
def test_p8_which_streams_report_zeros() -> None:
    for camera in (D435, D405, D415):
        assert camera.unit.depth.dist is None
    assert D435.unit.color.dist is None  # against the lesson: a colour stream with zeros
    assert D405.unit.color.dist is not None
    rows = {(row.model, row.coefficients): row for row in conventions.table()[0]}
    inverse = rows["inverse_brown_conrady", "radial"]
    assert inverse.project_px < 1e-3  # evaluated as our forward equation
    assert inverse.round_trip_px < 1e-3
    # evaluated as its name says it would be many pixels away
    camera = conventions.CAMERA
    ideal = (np.array([20.0, 20.0]) - camera.K[:2, 2]) / [camera.fx, camera.fy]
    bent = distort(ideal, conventions.COEFFS["radial"])
    assert np.linalg.norm((bent - ideal) * camera.fx) > 20
    ROWS["P8"].says("all-zero coefficients", "D405's does not", "evaluates forward")


@claim("P9", "right")
def test_p9_the_example_pixel() -> None:
    u, v = project([0.10, -0.05, 0.45], K)
    ROWS["P9"].says(f"[{u:.2f}, {v:.2f}]", f"[{u:.1f}, {v:.1f}] px")
    still, point = np.zeros(3), np.array([[0.10, -0.05, 0.45]])
    opencv, _ = cv2.projectPoints(point, still, still, K, None)
    np.testing.assert_allclose([u, v], opencv[0, 0])


@claim("P10", "right")
def test_p10_negative_y_is_up() -> None:
    """A camera 0.3 m over the base that looks along its x; up is +z there and right is -y."""
    T_base_camera = make_transform([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0.3])
    p_base = np.array([0.45, -0.10, 0.35])  # 45 cm ahead, 10 cm right, 5 cm above the camera
    p_camera = (np.linalg.inv(T_base_camera) @ [*p_base, 1])[:3]
    np.testing.assert_allclose(p_camera, [0.10, -0.05, 0.45], atol=1e-12)
    assert project(p_camera, K)[1] < K[1, 2]  # and above the middle of the image
    ROWS["P10"].says("y points down")


@claim("P11", "imprecise")
def test_p11_colour_pixels_need_the_distortion_undone() -> None:
    color, depth = D405.unit.color, D435.unit.depth
    points = np.array([[x, y, 0.45] for x in (-0.3, 0.0, 0.3) for y in (-0.2, 0.0, 0.2)])
    pixels = project(points, color.K, color.dist)
    right = deproject(pixels, 0.45, color.K, color.dist)
    np.testing.assert_allclose(right, points, atol=1e-9)
    taken_as_rectified = np.linalg.norm(deproject(pixels, 0.45, color.K) - points, axis=1)
    assert 1e3 * taken_as_rectified.max() > 3  # mm
    np.testing.assert_allclose(deproject(project(points, depth.K), 0.45, depth.K), points)
    ROWS["P11"].says("takes distortion and inverts it")


@claim("P12", "wrong")
def test_p12_pixel_pitch() -> None:
    """Focal length in metres (the vendor's data sheet) over focal length in pixels of all columns
    that the sensor has: 1280 of the D435's infrared imagers, 1920 of the others."""
    pitches = {
        "D435 infrared": 1.93e-3 / (D435.unit.depth.fx * 1280 / 848),
        "D435 colour": 1.88e-3 / (D435.unit.color.fx * 720 / 480 * 1920 / 1280),
        "D415 infrared": 1.88e-3 / (D415.unit.depth.fx * 1280 / 848 * 1920 / 1280),
    }
    assert (
        1e-6 < min(pitches.values()) < max(pitches.values()) < 6e-6
    )  # the lesson's begins at 1e-5
    assert pitches["D435 infrared"] == pytest.approx(3.0e-6, rel=0.02)
    assert pitches["D435 colour"] == pytest.approx(1.4e-6, rel=0.04)
    ROWS["P12"].says("1e-5-1e-4 m", "1-6 um", "1e-6 to 1e-5 m")
