"""The tables of cameras and lenses: every figure that ships, and what a wrong name says."""

import re
import tomllib
from dataclasses import fields

import numpy as np
import pytest
from common import EXPECTED, refusals

from coursekit.geometry import deproject
from coursekit.results import read_json
from coursekit.specifications import DATA, Nominal, device, device_names, lens, published_noise
from coursekit.stereo import depth_noise

TABLES = [DATA / "devices.toml", DATA / "lenses.toml"]
SHEET = ("name", "baseline_m", "scale_m", "nearest_mm", "projector")
DEVICES, LENSES = (tomllib.loads(path.read_text("utf-8")) for path in TABLES)


@pytest.mark.parametrize(SHEET, EXPECTED["data_sheets"])
def test_devices_agree_with_their_data_sheets(name, baseline_m, scale_m, nearest_mm, projector):
    """The sheets' least distances at 848x480, as far as found, are 14-15 % above f B / 126."""
    sheet, unit = device(name).nominal, device(name).unit
    assert device(name).name == f"Intel RealSense {name}"
    assert device(name).projector is projector
    assert (sheet.baseline_m, sheet.depth_scale_m) == (baseline_m, scale_m)
    assert unit.baseline_m == pytest.approx(baseline_m, rel=0.01)
    assert unit.depth_scale_m == scale_m
    assert unit.depth.size == (848, 480)
    assert unit.color.size == (640, 480)
    assert unit.depth.dist is None
    assert abs(unit.depth.hfov_deg - sheet.depth_hfov_deg) < (3 if name == "D435" else 3.5)
    assert not unit.T_color_depth.flags.writeable
    assert 0.001 < sheet.glass_m < 0.005
    if nearest_mm:
        nearest = 1000 * unit.depth.fx * unit.baseline_m / 126
        assert nearest_mm / nearest == pytest.approx(1.145, abs=0.01)


def test_the_colour_camera_of_the_d435_is_beside_its_left_imager():
    unit = device("D435").unit
    assert abs(unit.color.hfov_deg - 55) < 1.5  # 640x480 is cropped from 69 degrees at 16:9
    assert unit.T_color_depth[:3, 3] == pytest.approx([0.0143, 0.0006, 0.0006], abs=1e-4)


def test_the_d405_sees_colour_with_its_left_imager():
    unit, published = device("D405").unit, lens("d405_color").intrinsics
    np.testing.assert_array_equal(unit.T_color_depth, np.eye(4))
    assert unit.color.coeffs == published.coeffs
    assert unit.color.dist is not None
    # 640x480 is the middle of 768x480, which is the 1280x800 imager scaled by 0.6.
    ends = np.array([[0.0, 240.0], [640.0, 240.0]])
    larger = (ends - (320, 240)) / 0.6 + (640, 360)
    one, other = (deproject(ends, 1.0, unit.color.K), deproject(larger, 1.0, published.K))
    np.testing.assert_allclose(one, other, atol=1e-6)


@pytest.mark.real
def test_d435_unit_is_the_recorded_one(real_data):
    recorded = read_json(real_data / "realsense_d435/intrinsics.json")
    unit = device("D435").unit
    for mine, theirs in (("fx", "fx"), ("fy", "fy"), ("cx", "ppx"), ("cy", "ppy")):
        assert getattr(unit.color, mine) == recorded["color"][theirs]
    extrinsics = recorded["depth_to_color"]
    rotation = np.reshape(extrinsics["rotation_colmajor"], (3, 3), order="F")
    assert np.array_equal(unit.T_color_depth[:3, :3], rotation)
    assert np.array_equal(unit.T_color_depth[:3, 3], extrinsics["translation"])


@pytest.mark.real
def test_opencv_left_is_the_published_calibration(real_data):
    path = real_data / "opencv_chessboard/left_intrinsics_published.txt"
    numbers = [float(n) for n in re.findall(r"-?\d+\.\d+", path.read_text(encoding="utf-8"))][:8]
    left = lens("opencv_left").intrinsics
    assert numbers == [left.fx, left.cx, left.cy, *left.coeffs]


def test_every_device_is_whole_and_has_its_sources():
    """Nothing is checked when a table is read: what ships is checked here."""
    assert set(device_names()) == set(DEVICES) == {"D405", "D415", "D435", "D455"}
    for name, table in DEVICES.items():
        assert set(table) == {"name", "projector", "nominal", "unit"}
        unit, sheet = table["unit"], table["nominal"]
        assert isinstance(table["projector"], bool)
        assert set(sheet) == {field.name for field in fields(Nominal)}
        figures = [sheet[key] for key in sheet.keys() - {"source"}]
        assert all(isinstance(figure, float) and figure > 0 for figure in figures)
        parts = {"depth", "color", "T_color_depth"}
        assert set(unit) == parts | {"baseline_m", "depth_scale_m", "source"}
        assert all(isinstance(unit[key], float) for key in ("baseline_m", "depth_scale_m"))
        parts = [unit["depth"], unit["color"], unit["T_color_depth"]]
        lens_keys = {"width", "height", "fx", "fy", "cx", "cy", "model", "coeffs", "source"}
        assert all(set(part) == lens_keys for part in parts[:2])
        assert all(len(part["source"]) > 20 for part in (sheet, unit, *parts))
        assert device(name).unit.depth.fx == unit["depth"]["fx"]


def test_every_lens_is_whole_and_has_its_source():
    assert set(LENSES) >= {"opencv_left", "moveit_camera", "d405_color", "duckiebot_wide"}
    known = {"description", "width", "height", "fx", "fy", "cx", "cy", "model", "coeffs", "source"}
    for name, table in LENSES.items():
        assert known - {"model"} <= set(table) <= known
        entry = lens(name)
        assert (entry.name, entry.description) == (name, table["description"])
        assert list(entry.intrinsics.coeffs) == table["coeffs"]
        assert len(entry.source) > 20
        assert entry.intrinsics.dist is not None


test_unknown_names_list_the_known_ones = refusals(
    ("^name: got 'D999', want one of .*D435", lambda: device("D999")),
    ("^name: got 'fisheye', want .*opencv_left.*d405_color", lambda: lens("fisheye")),
)


def test_published_noise_implies_the_published_exponents() -> None:
    """The window means of a D435 grow with Z^2.6; the pixel model gives 0.045-0.15 px."""
    series = {s["id"]: s for s in read_json(DATA / "published_depth_noise.json")["series"]}
    assert all(s["source"] and s["quantity"] for s in series.values())
    model, window = series["d435_mapping_model"], series["d435_window_mean"]
    means, pixels = published_noise()
    assert "mean of a 100x100 px window" in means.quantity
    slope, _ = np.polyfit(np.log(means.distances_m), np.log(means.std_mm), 1)
    assert slope == pytest.approx(window["exponent"], abs=0.06)
    assert slope == pytest.approx(2.6, abs=0.1)
    z, (a, b, c) = np.array(pixels.distances_m), model["coefficients"]
    std = a + b * (z - c) ** 2
    np.testing.assert_allclose(pixels.std_mm, 1e3 * std, atol=5e-3)
    implied = std / depth_noise(z, model["fx_baseline_px_m"], 1.0, 1.0)
    np.testing.assert_allclose(model["sigma_d_px"], implied, atol=6e-4)


def test_the_848_crop_follows_the_rule_that_published_units_follow():
    """(f, cx, cy) at 640x480 and 848x480 of two units, librealsense 3474, realsense-ros 2788."""
    depths = (device("D435").unit.depth, device("D455").unit.depth)
    d435, d455 = ((depth.fx, depth.cx, depth.cy) for depth in depths)
    for small, large, tolerance in (
        ((382.918884, 321.015106, 235.879822), (422.806274, 425.120850, 235.450638), 1e-4),
        ((384.207489, 319.480408, 236.351501), (424.229095, 423.426300, 236.046249), 0.08),
        ((390.43145751953125, 331.38787841796875, 242.18734741210938), d435, 1e-4),
        ((387.543, 324.224, 237.357), d455, 1e-3),
    ):
        centred = np.array(small) - (0, 320, 240)
        predicted = centred * (848 / 1280) / (480 / 800) + (0, 424, 240)
        assert predicted[0] == pytest.approx(large[0], abs=min(tolerance, 1e-3))
        assert predicted[1:] == pytest.approx(large[1:], abs=tolerance)
