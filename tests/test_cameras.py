"""The same tests for the simulated camera and a recording of it, then what is special to each."""

import numpy as np
import pytest
from common import EXPECTED, NIGHTLY
from fake_realsense import ending_after
from scipy.spatial.transform import Rotation

import coursekit as ck
from coursekit.boards import Board, detect
from coursekit.cameras import Camera, CameraError, Frame, Frames, open_camera
from coursekit.cameras.simulated import SimulatedCamera
from coursekit.geometry import Intrinsics, deproject, make_transform, project, transform_points

CALIBRATION_TOLERANCE = 1e-6  # the recorder writes extrinsics with six decimals
SIGMA_D_PX = 0.08  # temporal std of one pixel's disparity, the planning value


def expected_m(camera, distance_m):
    """The depth that a SimulatedCamera's hidden geometry makes of a true distance."""
    truth, fx = camera.reveal(), camera.depth.fx
    disparity = fx * truth.baseline_m / distance_m + truth.disparity_offset_px
    return fx * truth.reported_baseline_m / disparity


def middle_mm(frames, half=20):
    """Valid depths (N, 2 half + 1, 2 half + 1) about the principal point, mm, NaN invalid."""
    intrinsics = frames[0].depth_intrinsics
    v, u = round(intrinsics.cy), round(intrinsics.cx)
    window = frames.depth[:, v - half : v + half + 1, u - half : u + half + 1].astype(float)
    return 1000 * frames[0].depth_scale_m * np.where(window > 0, window, np.nan)


@pytest.fixture(params=["simulated", "recorded"])
def camera(request):
    recorded = request.param == "recorded"
    with open_camera(request.getfixturevalue("tabletop") if recorded else "simulated") as opened:
        yield opened


# --- one protocol ---


def test_describes_itself(camera):
    truth = ck.specifications.device("D435").unit
    assert isinstance(camera, Camera)
    assert (camera.name, camera.serial) == ("Simulated D435", "seed-7")
    assert camera.depth_scale_m == 0.001
    assert camera.baseline_m == pytest.approx(truth.baseline_m, abs=1e-9)
    for mine, true in ((camera.depth, truth.depth), (camera.color, truth.color)):
        assert mine.size == true.size
        assert mine.model == true.model
        np.testing.assert_array_equal(np.float32(mine.K), np.float32(true.K))
        np.testing.assert_array_equal(np.float32(mine.coeffs), np.float32(true.coeffs))
    np.testing.assert_allclose(
        camera.T_color_depth, truth.T_color_depth, rtol=0, atol=CALIBRATION_TOLERANCE
    )


def test_frames_are_a_sequence_numbered_and_timed_at_30_hz(camera, capsys):
    frames = camera.frames(5, progress=False)
    assert isinstance(frames, Frames)
    assert len(frames) == 5
    assert frames.depth.shape == (5, 480, 848)
    assert frames.depth.dtype == np.uint16
    assert [frame.number for frame in frames] == list(range(frames[0].number, frames[0].number + 5))
    np.testing.assert_allclose(np.diff([frame.time_s for frame in frames]), 1 / 30, atol=1e-6)
    assert isinstance(frames[1:3], Frames)
    assert [frame.number for frame in frames[1:3]] == [frames[1].number, frames[2].number]
    assert capsys.readouterr() == ("", "")


def test_a_frame_carries_its_calibration(camera):
    frame = camera.frame()
    assert frame.color.shape == (480, 640, 3)
    assert frame.color.dtype == np.uint8
    assert frame.depth_intrinsics == camera.depth
    assert frame.color_intrinsics == camera.color
    assert frame.depth_scale_m == camera.depth_scale_m
    assert frame.depth_m.dtype == np.float32
    np.testing.assert_allclose(frame.depth_m, frame.depth / 1000, rtol=1e-6)


def test_the_block_is_where_the_scene_says(camera):
    """On average over the face, but for the unit's own error: 450 mm reads as about 448."""
    frame = camera.frame()
    truth_mm = 1000 * expected_m(SimulatedCamera(), 0.45)
    assert truth_mm == pytest.approx(448.4, abs=0.1)
    assert np.nanmean(middle_mm(Frames([frame]))) == pytest.approx(truth_mm, abs=0.8)
    points = frame.points()
    assert points.shape == (480, 848, 3)
    v, u = np.argwhere(frame.depth > 0)[1000]
    expected = deproject((u, v), 0.001 * frame.depth[v, u], camera.depth.K)
    np.testing.assert_allclose(points[v, u], expected, atol=1e-6)
    assert np.isnan(points[frame.depth == 0]).all()
    assert 0.02 < np.mean(frame.depth == 0) < 0.50  # shadows and holes


def test_infrared_images_show_what_was_matched(camera):
    """They are in no recording that was not asked for them; see test_cameras_recording."""
    frame = camera.frame()
    if camera.source == "recorded":
        assert frame.infrared is None
        return
    left, right = frame.infrared
    assert left.shape == right.shape == frame.depth.shape
    disparity = ck.simulation.match(left, right)
    with np.errstate(divide="ignore"):
        depth = 1000 * camera.depth.fx * camera.baseline_m / disparity
    seen = frame.depth > 0
    np.testing.assert_allclose(frame.depth[seen], depth[seen], atol=0.51)


@pytest.mark.parametrize("n", [0, -1, 2.5, True, "3", None])
def test_refuses_a_bad_count(camera, n, tmp_path):
    with pytest.raises(ValueError, match=r"^n: got"):
        camera.frames(n)
    with pytest.raises(ValueError, match=r"^n: got"):
        camera.record(tmp_path / "a.db3", n)
    assert list(tmp_path.iterdir()) == []


def test_closing_twice_is_fine_and_a_closed_camera_says_so(camera):
    begun = camera.stream()
    next(begun)
    camera.close()
    camera.close()
    for stream in (begun, camera.stream()):
        with pytest.raises(CameraError, match=r"closed: open it again with open_camera\(\)"):
            list(stream)


SAID = EXPECTED["cameras_said"]


def test_description_and_what_lock_did(camera):
    locked, description = SAID[camera.source]
    assert repr(camera) == description
    assert locked in camera.lock()


def test_ctrl_c_keeps_the_frames_so_far(camera, capsys):
    ending_after(camera, 3, KeyboardInterrupt())
    frames = camera.frames(9)
    assert len(frames) == 3
    assert capsys.readouterr().out == "Stopped after 3 of 9 frames; they are kept.\n"


def test_ctrl_c_before_the_first_frame_is_not_swallowed(camera):
    ending_after(camera, 0, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        camera.frames(9)


def test_an_error_carries_the_frames_so_far(camera):
    ending_after(camera, 2, CameraError("gone"))
    with pytest.raises(CameraError, match="gone") as caught:
        camera.frames(9)
    assert len(caught.value.frames) == 2
    assert caught.value.frames.depth.shape == (2, 480, 848)


# --- a recording ---


def test_a_recording_begins_at_its_start_gives_what_there_is_and_says_so(tabletop, capsys):
    with open_camera(tabletop) as camera:
        numbers = [[frame.number for frame in camera.frames(n, progress=False)] for n in (3, 3, 50)]
    assert numbers == [[1, 2, 3], [1, 2, 3], list(range(1, 13))]
    assert capsys.readouterr() == ("The recording ends after 12 of the 50 frames asked for.\n", "")


def test_two_views_of_one_recording_do_not_disturb_each_other(tabletop):
    with open_camera(tabletop) as one, open_camera(tabletop) as other:
        assert len(one.frames(4)) == 4
        assert len(other.frames(12)) == 12
        one.close()
        assert other.frame().number == 1


# --- the simulated camera ---


@pytest.mark.parametrize(("seed", "distance_m"), [(7, 0.45), *([(1, 0.6)] if NIGHTLY else [])])
def test_noise_on_the_face_has_the_size_that_the_matcher_gives_it(seed, distance_m):
    """Temporal std of a pixel about sigma_d Z^2 / (f B), and the mean where the truth puts it."""
    with SimulatedCamera(seed=seed, depth_scale_m=1e-4) as camera:
        camera.place("60 mm block", distance_m)
        depth = middle_mm(camera.frames(24, progress=False), half=10)  # clear of the edges
        truth_mm = 1000 * expected_m(camera, distance_m)
        predicted_mm = SIGMA_D_PX * truth_mm**2 / (camera.depth.fx * 1000 * camera.baseline_m)
    pixel_std = np.sqrt(np.nanmean(np.nanvar(depth, axis=0, ddof=1)))
    assert pixel_std == pytest.approx(predicted_mm, rel=0.2)
    window_std = np.nanmean(depth, axis=(1, 2)).std(ddof=1)
    assert window_std < 0.6 * pixel_std  # and not 31 times less: neighbours and drift correlate
    assert window_std > 0.1 * pixel_std
    assert np.nanmean(depth) == pytest.approx(truth_mm, abs=predicted_mm + 0.3)
    assert np.isnan(depth).mean() < 0.01


def test_the_truth_is_near_what_is_reported_and_each_unit_has_its_own():
    truths = [SimulatedCamera(seed=seed).reveal() for seed in range(40)]
    scale = np.array([truth.scale_error for truth in truths])
    assert all(truth.reported_baseline_m == 0.0501707 for truth in truths)
    assert ((np.abs(scale) > 0.0035) & (np.abs(scale) < 0.0105)).all()
    assert 10 < (scale > 0).sum() < 30
    assert len({truth.disparity_offset_px for truth in truths}) == 40
    assert 0.06 < np.std([truth.disparity_offset_px for truth in truths]) < 0.14
    bias_mm = [1000 * expected_m(SimulatedCamera(seed=seed), 0.45) - 450 for seed in range(40)]
    assert np.mean((np.abs(bias_mm) > 1.5) & (np.abs(bias_mm) < 5.5)) > 0.8
    assert repr(truths[7]) == EXPECTED["unit_7"]


def test_the_colour_image_is_seen_through_the_true_lens():
    """The block's front edges are where the true lens puts them, not the reported one."""
    with SimulatedCamera() as camera:
        row = camera.frame().color[240].astype(float).mean(axis=-1)
        true, reported = camera.reveal().color_lens, camera.color
    sides = transform_points(camera.T_color_depth, [[-0.03, 0.0, 0.45], [0.03, 0.0, 0.45]])
    expected = project(sides, true.K, true.dist)[:, 0]
    steps = np.abs(np.diff(row))
    for u in expected:
        near = slice(round(u) - 4, round(u) + 4)
        assert near.start + steps[near].argmax() + 0.5 == pytest.approx(u, abs=0.6)
    assert (np.abs(project(sides, reported.K)[:, 0] - expected) > 1.0).any()


def test_a_board_is_shown_until_the_next_place():
    board = Board("charuco", (9, 6), 0.025)
    T = make_transform(Rotation.from_euler("xy", [25, -20], degrees=True), (-0.10, -0.06, 0.45))
    with SimulatedCamera() as camera:
        before = camera.frame()
        camera.show_board(board, T)
        one, two = camera.frames(2)
        camera.show_board(board, T)
        again = camera.color_image()
        camera.place("60 mm block", 0.45)
        after = camera.frame()
    true = camera.reveal().color_lens
    seen = detect(one.color, board)
    expected = project(transform_points(T, board.points[seen.ids]), true.K, true.dist)
    assert np.sqrt(((seen.pixels - expected) ** 2).mean()) < 0.1
    np.testing.assert_array_equal(one.color[..., 0], one.color[..., 2])
    np.testing.assert_array_equal(one.color, again)
    assert (one.color != two.color).mean() > 0.5  # new noise
    assert two.number == one.number + 1
    np.testing.assert_array_equal(before.depth, after.depth)
    np.testing.assert_array_equal(before.color, after.color)


def test_depth_sees_the_board_where_it_is():
    board = Board("checkerboard", (10, 7), 0.025)
    T = make_transform(Rotation.from_euler("y", -20, degrees=True), (-0.09, -0.06, 0.50))
    with SimulatedCamera() as camera:
        camera.show_board(board, T)
        frame = camera.frame()
    seen = transform_points(T, board.points)
    pixels = np.rint(project(seen, camera.color.K)).astype(int)
    depth_m = frame.depth_on_color()[pixels[:, 1], pixels[:, 0]]
    found = depth_m > 0
    assert found.mean() > 0.7
    ratio = np.median(depth_m[found] / seen[found, 2])
    assert ratio == pytest.approx(expected_m(camera, 0.48) / 0.48, abs=0.003)


def test_a_board_that_faces_away_is_refused_and_changes_nothing():
    board = Board("charuco", (9, 6), 0.025)
    turned = make_transform(Rotation.from_euler("y", 180, degrees=True), (0.1, 0.0, 0.5))
    with SimulatedCamera() as camera:
        scene = camera.scene
        for T in (turned, make_transform(np.eye(3), (0.0, 0.0, -0.5))):
            with pytest.raises(ValueError, match=r"^T_camera_board: .* does not face the camera"):
                camera.show_board(board, T)
        assert camera.scene is scene


@pytest.mark.parametrize("device", ["D405", "D415", "D455"])
def test_every_device_sees_the_block(device):
    with SimulatedCamera(device=device, depth_scale_m=1e-4) as camera:
        frames = camera.frames(1)
        truth_mm = 1000 * expected_m(camera, 0.45)
    window = middle_mm(frames, half=15)
    sigma_mm = SIGMA_D_PX * truth_mm**2 / (camera.depth.fx * 1000 * camera.baseline_m)
    if device == "D405":  # a bland face by the room's light alone
        assert np.isnan(window).mean() > 0.5
    else:
        assert np.nanmedian(window) == pytest.approx(truth_mm, abs=2 * sigma_mm)
        assert np.isnan(window).mean() < 0.02
    assert (camera.name, camera.serial) == (f"Simulated {device}", "seed-7")
    assert frames[0].color.shape == (480, 640, 3)


# --- frames ---


def test_a_frame_without_colour_in_metres_by_the_depth_unit():
    depth = np.array([[0, 1000, 2000, 65535], [1, 2, 3, 4]], np.uint16)
    frame = Frame(depth, None, 0.0001, 0.5, 9, Intrinsics(4, 2, 5.0, 5.0, 1.5, 0.5))
    expected = [[0, 0.1, 0.2, 0], [1e-4, 2e-4, 3e-4, 4e-4]]  # the largest count is no depth
    np.testing.assert_allclose(frame.depth_m, expected, rtol=1e-6)
    point = [0.5 / 5 * 0.2, -0.02, 0.2]
    np.testing.assert_allclose(frame.points()[0, 2], point, rtol=1e-6)
    with pytest.raises(CameraError, match="no colour stream"):
        frame.depth_on_color()
    assert repr(frame) == "Frame 9 at 0.500 s: depth 4x2, no colour"


# --- open_camera ---


def test_the_environment_variable_names_the_camera_of_auto(monkeypatch, tabletop):
    monkeypatch.setenv("COURSEKIT_CAMERA", "simulated")
    assert open_camera().source == "simulated"
    monkeypatch.setenv("COURSEKIT_CAMERA", str(tabletop))
    for which, source in (("auto", "recorded"), ("simulated", "simulated")):
        with open_camera(which) as camera:
            assert camera.source == source
    monkeypatch.setenv("COURSEKIT_CAMERA", "bogus")
    with pytest.raises(ValueError, match=r"^COURSEKIT_CAMERA: got 'bogus'"):
        open_camera()


def test_what_the_factory_says_is_the_reference_of_notebook_01():
    path = ck.specifications.DATA / "reference_results" / "01_pinhole.json"
    stored = ck.results.read(path).quantities
    del stored["one_pixel_at_450_mm"]
    assert open_camera("simulated").factory_values() == stored


@pytest.mark.parametrize("which", ["", "bogus", 7, None, b"a.db3", "Simulated"])
def test_nonsense_is_refused_with_what_is_wanted(which):
    with pytest.raises(ValueError, match=r'^which: got .*, want "auto", "simulated", a serial'):
        open_camera(which)


def test_a_name_makes_a_unit_of_ones_own(monkeypatch, own_results):
    monkeypatch.setenv("COURSEKIT_CAMERA", "simulated")
    assert (ck.my_unit(), ck.my_unit(), open_camera().seed) == (7, 7, 7)
    assert not own_results.exists()
    mine = ck.my_unit("José Müller")
    assert mine == ck.my_unit("  jose MÜLLER ") == ck.my_unit() == open_camera().seed == 60769597
    assert open_camera("simulated", seed=8).seed == 8
    assert open_camera().reveal() != open_camera(seed=7).reveal()
    others = {ck.my_unit(f"Student {n}") for n in range(200)}
    assert len(others) == 200
    assert min(others) > 9_999_999  # far from the seeds that notebooks count up from


def test_a_damaged_unit_says_what_to_do(monkeypatch, tmp_path):
    monkeypatch.setenv("COURSEKIT_RESULTS", str(tmp_path))
    for damaged in ("", "[]", "{}", '{"seed": "7"}', '{"seed": -1}', '{"seed": 7.5}'):
        (tmp_path / "unit.json").write_text(damaged, encoding="utf-8")
        with pytest.raises(ValueError, match=r'^unit\.json in results/ is .* ck\.my_unit\("your'):
            open_camera("simulated")
    assert open_camera("simulated", seed=7).seed == 7
    assert ck.my_unit("Ada") == ck.my_unit()
    for nameless in (" ", "!?"):
        with pytest.raises(ValueError, match=r"^name: got .*, want one with letters"):
            ck.my_unit(nameless)
    with pytest.raises(ValueError, match=r"^name: got int, want str"):
        ck.my_unit(7)
