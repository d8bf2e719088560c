"""A real D435's recording, made by somebody else, played as any camera of the course."""

import json

import numpy as np
import pytest

from coursekit.cameras import open_camera
from coursekit.geometry import deproject

pytestmark = pytest.mark.real

NAME = "single_depth_color_640x480.bag"


@pytest.fixture(scope="module")
def folder(real_data):
    return real_data / "realsense_d435"


@pytest.fixture
def camera(rs, folder):
    with open_camera(folder / NAME) as opened:
        yield opened


def test_reports_what_its_owners_published(camera, folder):
    published = json.loads((folder / "intrinsics.json").read_text(encoding="utf-8"))
    for stream in ("depth", "color"):
        intrinsics, expected = getattr(camera, stream), published[stream]
        assert intrinsics.size == (expected["width"], expected["height"])
        assert (intrinsics.fx, intrinsics.fy) == (expected["fx"], expected["fy"])
        assert (intrinsics.cx, intrinsics.cy) == (expected["ppx"], expected["ppy"])
        assert intrinsics.model == expected["model"].split(".")[1]
        assert list(intrinsics.coeffs) == expected["coeffs"]
    pose = published["depth_to_color"]
    columns = np.reshape(pose["rotation_colmajor"], (3, 3))
    np.testing.assert_allclose(camera.T_color_depth[:3, :3], columns.T, rtol=0, atol=5e-8)
    np.testing.assert_allclose(camera.T_color_depth[:3, 3], pose["translation"], atol=2e-9)
    assert camera.depth_scale_m == published["depth_units"]
    assert camera.baseline_m == pytest.approx(0.0501707, abs=1e-7)
    assert (camera.source, camera.serial) == ("recorded", "728612070259")
    assert repr(camera) == (
        f"Intel RealSense D435 (recording {NAME}): depth 640x480, colour 640x480, "
        "baseline 50.2 mm, depth unit 1 mm"
    )


def test_holds_two_depth_images_and_one_colour_image(camera, capsys):
    """librealsense alone gives one frame, number 170: it loses the first while it starts."""
    frames = camera.frames(5)
    assert capsys.readouterr().out == "The recording ends after 2 of the 5 frames asked for.\n"
    assert [frame.number for frame in frames] == [169, 170]
    assert [frame.time_s for frame in frames] == [360.815089, 360.981765]
    np.testing.assert_array_equal(frames[0].color, frames[1].color)
    assert (frames[0].depth != frames[1].depth).mean() > 0.1


def test_its_images_and_lenses_are_those_that_librealsense_plays(rs, folder, camera):
    pipeline, config = rs.pipeline(), rs.config()
    config.enable_device_from_file(str(folder / NAME), repeat_playback=False)
    profile = pipeline.start(config)
    profile.get_device().as_playback().set_real_time(False)
    try:
        theirs = pipeline.wait_for_frames(60_000)
        depth, color = theirs.get_depth_frame(), theirs.get_color_frame()
        [ours] = [frame for frame in camera.frames(5) if frame.number == depth.get_frame_number()]
        np.testing.assert_array_equal(ours.depth, np.asanyarray(depth.get_data()))
        np.testing.assert_array_equal(ours.color, np.asanyarray(color.get_data()))
        assert ours.depth_scale_m == pytest.approx(depth.get_units(), rel=1e-6)
        for lens, frame in ((camera.depth, depth), (camera.color, color)):
            said = frame.profile.as_video_stream_profile().get_intrinsics()
            assert (lens.fx, lens.fy, lens.cx, lens.cy) == (said.fx, said.fy, said.ppx, said.ppy)
    finally:
        pipeline.stop()


def test_its_points_are_those_of_the_vendors_function(rs, camera):
    frame = camera.frame()
    points = frame.points()
    intrinsics = rs.intrinsics()
    intrinsics.width, intrinsics.height = camera.depth.size
    intrinsics.fx, intrinsics.fy = camera.depth.fx, camera.depth.fy
    intrinsics.ppx, intrinsics.ppy = camera.depth.cx, camera.depth.cy
    intrinsics.model = rs.distortion.brown_conrady
    rng = np.random.default_rng(8)
    v, u = np.nonzero(frame.depth)
    for i in rng.choice(len(v), 200, replace=False):
        pixel, z = [float(u[i]), float(v[i])], float(frame.depth_m[v[i], u[i]])
        vendor = rs.rs2_deproject_pixel_to_point(intrinsics, pixel, z)
        np.testing.assert_allclose(points[v[i], u[i]], vendor, atol=2e-6)
        np.testing.assert_allclose(
            points[v[i], u[i]], deproject(pixel, z, camera.depth.K), atol=1e-6
        )
    assert np.isnan(points[frame.depth == 0]).all()
