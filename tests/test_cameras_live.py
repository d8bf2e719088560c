"""A live RealSense, played by a fake of the vendor's module: no test machine has one."""

import numpy as np
import pytest
from common import EXPECTED
from fake_realsense import SERIAL, real_library

from coursekit.cameras import CameraError, open_camera, realsense
from coursekit.cameras.librealsense import LibraryMissing, load_librealsense


@pytest.fixture
def rs(plug_in):
    return plug_in()


@pytest.fixture
def camera(rs):
    with open_camera() as opened:
        yield opened


# --- opening ---


@pytest.mark.parametrize("which", ["auto", SERIAL])
def test_opens_the_connected_camera_and_asks_it_for_everything(plug_in, which):
    rs = plug_in()
    with open_camera(which) as camera:
        assert rs.enabled == [
            ("device", SERIAL),
            ("depth", 848, 480, "z16", 30),
            ("color", 640, 480, "rgb8", 30),
        ]
        assert (camera.source, camera.serial) == ("live", SERIAL)
        assert (camera.depth_scale_m, camera.baseline_m) == (0.001, pytest.approx(0.05017))
        assert camera.depth.size == (848, 480)
        assert (camera.depth.fx, camera.depth.fy) == (426.0, 426.25)
        assert (camera.color.cx, camera.color.cy) == (321.5, 237.5)
        assert camera.color.model == "inverse_brown_conrady"
        assert camera.color.coeffs == (0.1, -0.2, 0.001, 0.002, 0.05)
        # The library lists rotations by columns: this one takes the depth camera's x to y.
        np.testing.assert_array_equal(camera.T_color_depth @ [1, 0, 0, 1], [0.015, 1, 0, 1])
        assert repr(camera) == (
            f"Intel RealSense D435 (live, serial {SERIAL}): depth 848x480, colour 640x480, "
            "baseline 50.2 mm, depth unit 1 mm"
        )


def test_consecutive_captures_go_on_once_the_exposure_has_settled(camera):
    assert [frame.number for frame in camera.frames(3)] == [31, 32, 33]
    assert camera.frame().number == 34


def test_a_depth_image_is_never_given_twice(plug_in):
    plug_in(color_late=True)
    with open_camera() as camera:
        numbers = [frame.number for frame in camera.frames(10, progress=False)]
    assert len(set(numbers)) == 10


def test_running_the_setup_cell_again_lets_go_of_the_first_camera(plug_in):
    rs = plug_in()
    first = open_camera()
    second = open_camera()
    assert (rs.starts, rs.stops) == (2, 1)
    with pytest.raises(CameraError, match="closed"):
        first.frame()
    assert second.frame().number > 30
    second.close()
    second.close()
    assert rs.stops == 2


def test_a_serial_number_that_is_not_there_lists_those_that_are(plug_in):
    rs = plug_in()
    with pytest.raises(CameraError, match=rf"no RealSense with serial number 123 .* {SERIAL} \("):
        open_camera("123")
    rs.serials = []
    with pytest.raises(CameraError, match="there is none: plug it in"):
        open_camera("123")
    assert rs.starts == 0  # librealsense would wait 15 s


# --- what goes wrong ---


@pytest.mark.parametrize(("error", "advice"), EXPECTED["does_not_start"])
@pytest.mark.parametrize("which", ["auto", SERIAL])
def test_a_camera_that_does_not_start_is_never_replaced(plug_in, which, error, advice):
    plug_in(start_error=error)
    with pytest.raises(CameraError, match=advice) as caught:
        open_camera(which)
    assert error in str(caught.value)
    assert f"the RealSense {SERIAL} does not start" in str(caught.value)


@pytest.mark.parametrize(
    ("then", "raised", "message"),
    [
        (RuntimeError("gone"), CameraError, r"stopped giving frames \(gone\)"),
        (KeyboardInterrupt(), KeyboardInterrupt, "^$"),
    ],
)
def test_unplugged_or_interrupted_while_the_exposure_settles(plug_in, then, raised, message):
    rs = plug_in(frames=12, then=then)
    with pytest.raises(raised, match=message):
        open_camera()
    assert rs.stops == 1


@pytest.mark.parametrize(
    ("then", "message"),
    [
        (RuntimeError("Frame didn't arrive within 5000"), "stopped giving frames .* plugged in"),
        (None, "no frame came from the RealSense .* is it still plugged in"),
    ],
)
def test_unplugged_keeps_the_frames_so_far(plug_in, then, message):
    plug_in(frames=30 + 7, then=then)
    camera = open_camera()
    with pytest.raises(CameraError, match=message) as caught:
        camera.frames(100)
    assert [frame.number for frame in caught.value.frames] == list(range(31, 38))
    camera.close()


def test_unplugged_while_recording_leaves_a_readable_file(plug_in, tmp_path, monkeypatch):
    real_library()
    path = tmp_path / "a.db3"
    plug_in(frames=30 + 5, then=RuntimeError("Device disconnected"))
    camera = open_camera()
    with pytest.raises(CameraError, match=r"disconnected.*its 5 frames so far are in .*a\.db3"):
        camera.record(path, 100)
    camera.close()
    monkeypatch.setattr(realsense, "load_librealsense", load_librealsense)
    with open_camera(path) as played:
        assert (played.name, played.serial) == ("Intel RealSense D435", SERIAL)
        assert played.color.model == "inverse_brown_conrady"
        np.testing.assert_allclose(played.T_color_depth, camera.T_color_depth, atol=1e-6)
        frames = played.frames(5)
        assert [frame.number for frame in frames] == [31, 32, 33, 34, 35]
        assert [frame.depth[0, 0] for frame in frames] == [403, 404, 405, 406, 400]


# --- infrared, placing, settings ---


def test_infrared_only_if_asked(plug_in):
    rs = plug_in()
    with open_camera() as camera:
        assert camera.frame().infrared is None
    assert len(rs.enabled) == 3
    with open_camera(infrared=True) as camera:
        left, right = camera.frame().infrared
    assert rs.enabled[-2:] == [("infrared", eye, 848, 480, "y8", 30) for eye in (1, 2)]
    assert (left.dtype, left.shape, left[0, 0], right[0, 0]) == (np.uint8, (480, 848), 50, 100)


@pytest.mark.parametrize(("name", "instruction"), EXPECTED["placing"])
def test_placing_tells_the_person_and_waits(plug_in, monkeypatch, capsys, name, instruction):
    rs = plug_in()
    asked = []
    monkeypatch.setattr("builtins.input", lambda prompt: asked.append((prompt, rs.given)) or "")
    with open_camera() as camera:
        assert camera.can_place
        camera.place(name, 0.45)
        said = capsys.readouterr().out
        assert said.startswith(instruction)
        # The data sheet's Z = 0 of a D435 is 4.2 mm behind its glass.
        assert "446 mm from the camera's front glass by tape measure" in said
        assert said.count("\n") == 1
        assert asked == [("Press Enter when it stands there", 30)]
        assert camera.frame().number == 30 + 30 + 1  # not one from before


def test_ctrl_c_while_placing_passes_through(camera, monkeypatch):
    def interrupted(prompt):
        raise KeyboardInterrupt

    monkeypatch.setattr("builtins.input", interrupted)
    with pytest.raises(ValueError, match=r"^distance_m: got -1"):  # before anybody is asked
        camera.place("wall", -1)
    with pytest.raises(KeyboardInterrupt):
        camera.place("wall", 1.0)
    assert camera.frame().number == 31


def test_the_depth_unit_is_set_with_the_camera_stopped(rs, camera):
    assert camera.set(depth_scale_m=1e-4) == "Depth unit set to 0.1 mm."
    assert (rs.starts, rs.stops) == (2, 1)
    assert rs.depth_sensor.set_calls == [("depth_units", 1e-4)]
    assert camera.depth_scale_m == camera.frame().depth_scale_m == 1e-4
    with pytest.raises(ValueError, match=r"^depth_scale_m: got 1"):
        camera.set(depth_scale_m=1)


def test_light_and_exposure_are_the_persons(rs, camera):
    sentence = camera.set(ambient=0.05, exposure=5.0)
    assert sentence.startswith("The room's light is yours to change")
    assert "exposure stays: lock()" in sentence
    assert camera.set() == "Nothing to change."
    assert rs.depth_sensor.set_calls == []
    assert rs.starts == 1


def test_a_camera_without_other_units_keeps_its_own(rs, camera):
    del rs.depth_sensor.options["depth_units"]
    sentence = camera.set(depth_scale_m=1e-4)
    assert sentence == "Depth unit stays 1 mm: this camera has no other."
    assert camera.depth_scale_m == 0.001


def refuse(option, value):
    raise RuntimeError("hwmon command failed")


@pytest.mark.parametrize("answer", [refuse, lambda option, value: None], ids=["aloud", "silently"])
def test_a_depth_unit_that_is_refused(rs, camera, monkeypatch, answer):
    monkeypatch.setattr(rs.depth_sensor, "set_option", answer)
    with pytest.raises(CameraError, match="keeps its depth unit of 1 mm"):
        camera.set(depth_scale_m=1e-4)
    assert camera.frame().depth_scale_m == 0.001  # still streaming


# --- lock ---


def test_lock_fixes_the_exposure_that_the_camera_chose_and_waits_until_it_shows(rs, camera):
    before = rs.given
    sentence = camera.lock()
    assert rs.given - before == 1 + 6
    for sensor, calls in ((rs.depth_sensor, "depth"), (rs.color_sensor, "color")):
        assert [*map(list, sensor.set_calls)] == EXPECTED["locked"][calls]
    assert rs.motion_sensor.set_calls == []
    assert sentence == (
        "Locked depth exposure at 8.5 ms, colour (manual setting) exposure at 15.6 ms, "
        "white balance; the focus is fixed by the lenses."
    )


def test_lock_that_the_camera_refuses(rs, camera, monkeypatch):
    monkeypatch.setattr(rs.color_sensor, "set_option", refuse)
    with pytest.raises(CameraError, match="be locked: hwmon command"):
        camera.lock()
    camera.close()
    with pytest.raises(CameraError, match="closed: open it again"):
        camera.lock()


# --- without the library ---


def test_without_the_library_auto_is_simulated_and_says_why(no_library):
    camera = open_camera()
    assert camera.source == "simulated"
    assert repr(camera).startswith(
        "Simulated D435, seed 7: no real camera in use.\nThe reason: pyrealsense2 is not "
        "installed, so no RealSense can be opened and nothing recorded"
    )
    assert "requirements-camera.txt" in repr(camera)


def test_without_the_library_a_named_camera_says_what_to_do(no_library):
    with pytest.raises(LibraryMissing, match=r"requirements-camera\.txt.*simulated camera work"):
        open_camera(SERIAL)


def test_without_the_library_nothing_is_recorded(no_library, tmp_path):
    with open_camera("simulated") as camera, pytest.raises(LibraryMissing):
        camera.record(tmp_path / "a.db3", 2)
    assert list(tmp_path.iterdir()) == []


def test_plugged_in_but_invisible_to_the_library_is_not_simulated(plug_in, tmp_path):
    plug_in().serials = []
    assert open_camera().source == "simulated"
    product = tmp_path / "1-2" / "product"
    product.parent.mkdir()
    product.write_text("USB Keyboard\n", encoding="utf-8")
    assert open_camera().source == "simulated"
    product.write_text("Intel(R) RealSense(TM) Depth Camera 435\n", encoding="utf-8")
    with pytest.raises(CameraError, match=r"a RealSense is plugged in, .* udev rules"):
        open_camera()
