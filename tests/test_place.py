"""Placing and lighting things before a camera, recorded sets, and that a session comes back."""

import json
import os
import shutil

import numpy as np
import pytest
from common import EXPECTED
from fake_realsense import real_library

from coursekit.cameras import CameraError, open_camera, place
from coursekit.cameras.simulated import SimulatedCamera

BLOCK, DISTANCES_M = "60 mm block", (0.30, 0.45)
pytestmark = pytest.mark.usefixtures("small_cameras")


@pytest.fixture(scope="module")
def recorded_set(small_cameras, tmp_path_factory):
    """Four frames of the block at two distances and of a wall, with the infrared images."""
    real_library()
    folder = tmp_path_factory.mktemp("sets") / "session"
    with SimulatedCamera(depth_scale_m=1e-4) as camera:
        camera.record_set(folder, BLOCK, DISTANCES_M, 4, infrared=True)
        return camera.record_set(folder, "wall", [1.0], 4)


def captures(camera):
    """What a notebook's sweep takes: the depth images at each distance."""
    found = []
    for distance_m in DISTANCES_M:
        with place(camera, BLOCK, distance_m):
            found.append(camera.frames(4).depth)
    return found


# --- the simulated camera ---


def test_a_cell_that_is_run_again_gives_the_same_numbers():
    with SimulatedCamera() as camera:
        first, again = captures(camera), captures(camera)
        np.testing.assert_array_equal(first, again)
        goes_on = camera.frames(4).depth
        assert (goes_on != again[-1]).any()
    with SimulatedCamera() as another:
        another.frames(3)
        np.testing.assert_array_equal(captures(another)[::-1], first[::-1])
    with SimulatedCamera(seed=8) as other_unit:
        assert (captures(other_unit)[0] != first[0]).any()


def test_clock_and_numbers_go_on_when_the_scene_changes():
    with SimulatedCamera() as camera:
        camera.frames(2)
        with place(camera, "wall", 0.7) as given:
            assert given is camera
            frame = camera.frame()
    assert (frame.number, frame.time_s) == (3, pytest.approx(0.1))


@pytest.mark.parametrize("distance_m", [0, -0.3, float("nan"), float("inf"), True, "0.45", None])
def test_a_bad_distance_is_refused(distance_m, recorded_set):
    with SimulatedCamera() as camera, pytest.raises(ValueError, match=r"^distance_m: got"):
        camera.place(BLOCK, distance_m)
    with open_camera(recorded_set) as camera, pytest.raises(ValueError, match=r"^distance_m: got"):
        camera.place(BLOCK, distance_m)


def test_an_unknown_thing_is_refused():
    with SimulatedCamera() as camera:
        before = camera.scene
        with pytest.raises(
            ValueError, match=r"^name: got 'mug', want one of 60 mm block, wall, ar"
        ):
            camera.place("mug", 0.4)
        assert camera.scene is before


def test_simulated_frames_differ_and_do_not_share_memory():
    with SimulatedCamera() as camera:
        one, two = camera.frames(2)
        assert (one.number, two.number) == (1, 2)
        for mine, other in ((one.depth, two.depth), *zip(one.infrared, two.infrared, strict=True)):
            assert 0.2 < np.mean(mine != other) < 1.0
        np.testing.assert_array_equal(one.color, two.color)
        for image in (one.depth, one.color, *one.infrared):
            image[:] = 0
        assert two.depth.any()
        assert camera.frame().color.any()
        assert camera.frame().number == 4


def test_another_unit_of_depth_rounds_the_same_images():
    with SimulatedCamera() as camera:
        fine, coarse = [], []
        for depth_scale_m, frames in ((1e-4, fine), (1e-3, coarse)):
            sentence = camera.set(depth_scale_m=depth_scale_m)
            assert f"depth unit {1000 * depth_scale_m:g} mm" in sentence
            frames.extend(camera.frames(2))
            assert frames[0].depth_scale_m == depth_scale_m
    for one, other in zip(fine, coarse, strict=True):
        np.testing.assert_array_equal(one.infrared[0], other.infrared[0])
        far = one.depth == 0  # 65,535 counts of 0.1 mm end before the wall does
        assert np.abs(one.depth[~far] / 10 - other.depth[~far]).max() <= 0.55


def test_light_and_exposure_reach_the_images():
    with SimulatedCamera() as camera:
        automatic = camera.frame()
        assert "Ambient infrared 0.01, exposure 1 ms" in camera.set(exposure=1.0)
        dark = camera.frame().infrared[0].mean()
        camera.set(exposure=2.0)
        longer = camera.frame().infrared[0].mean()
        assert "Ambient infrared 0.2, exposure 1 ms" in camera.set(ambient=0.2, exposure=1.0)
        bright = camera.frame().infrared[0].mean()
        assert "exposure auto" in camera.set(ambient=0.01, exposure="auto")
        np.testing.assert_array_equal(camera.frame().infrared, automatic.infrared)
    black = 4.0
    assert longer - black == pytest.approx(2 * (dark - black), rel=0.1)
    assert bright > dark + 3.0  # grey levels


def test_lock_freezes_the_exposure_of_the_nearer_scene():
    with SimulatedCamera() as camera:
        camera.place("wall", 0.5)
        camera.lock()
        camera.place("wall", 1.0)
        locked = np.percentile(camera.frame().infrared[0], 98)
        camera.set(exposure="auto")
        automatic = np.percentile(camera.frame().infrared[0], 98)
    assert locked < 0.5 * automatic  # light falls off with the square of the distance


BAD_SETTINGS, BAD_CAMERAS = EXPECTED["bad_settings"], EXPECTED["bad_cameras"]


@pytest.mark.parametrize(("change", "message"), BAD_SETTINGS)
def test_a_bad_setting_is_refused_and_changes_nothing(change, message):
    with SimulatedCamera() as camera:
        before = camera.frame().infrared
        with pytest.raises(ValueError, match=message):
            camera.set(**change)
        camera.set()
        np.testing.assert_array_equal(camera.frame().infrared, before)
        assert camera.depth_scale_m == 0.001


@pytest.mark.parametrize(("arguments", "message"), BAD_SETTINGS[3:] + BAD_CAMERAS)
def test_simulated_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        SimulatedCamera(**arguments)


# --- recorded sets ---


def test_a_set_plays_what_the_simulated_camera_gave(recorded_set):
    """The same notebook cells, equal numbers."""
    with SimulatedCamera(depth_scale_m=1e-4) as camera, open_camera(recorded_set) as played:
        np.testing.assert_array_equal(captures(camera), captures(played))
        with place(camera, BLOCK, 0.30), place(played, BLOCK, 0.30):
            for one, other in zip(camera.frames(4), played.frames(4), strict=True):
                np.testing.assert_array_equal(one.infrared, other.infrared)
                np.testing.assert_array_equal(one.color, other.color)
        assert (played.source, played.can_place) == ("recorded", True)
        for name in ("name", "serial", "depth_scale_m"):
            assert getattr(played, name) == getattr(camera, name)
        assert played.baseline_m == pytest.approx(camera.baseline_m, abs=1e-9)
        played.place("wall", 1.0)
        assert played.frame().infrared is None  # recorded without


def test_a_set_says_what_it_holds(recorded_set, monkeypatch):
    monkeypatch.setenv("COURSEKIT_CAMERA", str(recorded_set))
    with open_camera() as camera:
        assert repr(camera) == (
            "Simulated D435 (recorded set session, now 60 mm block at 0.300 m), which holds "
            "60 mm block at 0.300, 0.450 m; wall at 1.000 m"
        )
        for name, distance_m in ((BLOCK, 0.6), ("wall", 0.45), ("mug", 0.3)):
            with pytest.raises(CameraError) as caught:
                camera.place(name, distance_m)
            assert f"has no {name} at {distance_m:.3f} m: it holds 60 mm block at 0.300, " in str(
                caught.value
            )
        camera.place(BLOCK, 0.45 + 1e-9)
        assert "now 60 mm block at 0.450 m" in repr(camera)
        assert "cannot be changed" in camera.lock()
        assert "cannot be changed" in camera.set(depth_scale_m=1e-4)
        with pytest.raises(CameraError, match="nobody knows the true geometry"):
            camera.reveal()
        camera.close()
        camera.close()
        with pytest.raises(CameraError, match="closed"):
            camera.frame()


def test_a_folder_by_its_bare_name(recorded_set, monkeypatch):
    monkeypatch.chdir(recorded_set.parent)
    with open_camera(recorded_set.name) as camera:
        assert camera.name == "Simulated D435"


def test_a_scene_that_is_there_is_kept_unless_told(recorded_set, tmp_path):
    folder = shutil.copytree(recorded_set, tmp_path / "copy")
    with SimulatedCamera(seed=7) as camera:
        with pytest.raises(ValueError, match=r"holds 60 mm block at 0\.450 m already"):
            camera.record_set(folder, BLOCK, [0.6, 0.45], 2)
        assert not any("0.600" in name for name in os.listdir(folder))
        camera.record_set(folder, BLOCK, [0.45], 2, overwrite=True)
    with open_camera(folder) as played:
        played.place(BLOCK, 0.45)
        assert len(played.frames(2)) == 2
        assert played.depth_scale_m == 0.001
    assert len(json.loads((folder / "index.json").read_text(encoding="utf-8"))["scenes"]) == 3


def test_one_set_is_of_one_camera(recorded_set, tmp_path):
    folder = shutil.copytree(recorded_set, tmp_path / "copy")
    with SimulatedCamera(seed=8) as camera:
        camera.record_set(folder, BLOCK, [0.6], 1)
    with open_camera(folder) as played:
        with pytest.raises(CameraError, match=r"another camera \(seed-8, not seed-7\)"):
            played.place(BLOCK, 0.6)
        assert played.frame().depth.any()


def test_a_single_recording_says_that_it_cannot_be_rearranged(recorded_set, tmp_path, capsys):
    with open_camera(recorded_set / "60-mm-block_0.300m.db3") as camera:
        assert not camera.can_place
        with place(camera, BLOCK, 0.45):
            assert len(camera.frames(2)) == 2
        said = "Simulated D435: a recording cannot be rearranged, it shows what it shows.\n"
        assert capsys.readouterr() == (said, "")
        with pytest.raises(CameraError, match="cannot be rearranged, so it makes no set"):
            camera.record_set(tmp_path / "set", BLOCK, [0.45], 2)
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_keeps_the_scenes_so_far(tmp_path, capsys, monkeypatch):
    real_library()
    with SimulatedCamera() as camera:
        stream = camera.stream

        def interrupted_in_the_second_scene():
            for count, frame in enumerate(stream()):
                if camera._distance_m == 0.45 and count == 1:
                    raise KeyboardInterrupt
                yield frame

        monkeypatch.setattr(camera, "stream", interrupted_in_the_second_scene)
        folder = camera.record_set(tmp_path / "set", BLOCK, [0.30, 0.45, 0.60], 3)
    assert capsys.readouterr().out.endswith(
        "holds the 1 frames so far.\nThe set set holds 60 mm block at 0.300, 0.450 m.\n"
    )
    with open_camera(folder) as played:
        assert len(played.frames(3)) == 3


@pytest.mark.parametrize(("arguments", "message"), EXPECTED["bad_sets"])
def test_a_bad_set_is_refused(tmp_path, arguments, message):
    wanted = {"folder": "set", "name": BLOCK, "distances_m": [0.3], "n": 2} | arguments
    wanted["folder"] = tmp_path / wanted["folder"]
    with SimulatedCamera() as camera, pytest.raises(ValueError, match=message):
        camera.record_set(**wanted)
    assert not list(tmp_path.rglob("*.*"))


@pytest.mark.parametrize(("content", "message"), EXPECTED["damaged_index"])
def test_a_damaged_index_says_so(tmp_path, content, message):
    (tmp_path / "index.json").write_text(content, encoding="utf-8")
    with pytest.raises(CameraError, match=rf"index\.json is damaged \(.*{message}"):
        open_camera(tmp_path)


def test_a_folder_without_a_set_and_a_set_without_a_file(recorded_set, tmp_path):
    with pytest.raises(CameraError, match=r"is a folder: name the \.db3 or \.bag file in it, or a"):
        open_camera(tmp_path)
    folder = shutil.copytree(recorded_set, tmp_path / "copy")
    (folder / "60-mm-block_0.450m.db3").unlink()
    with open_camera(folder) as camera:
        with pytest.raises(CameraError, match=r"there is no file .*0\.450m\.db3"):
            camera.place(BLOCK, 0.45)
        assert camera.frame().depth.any()  # still the one before
