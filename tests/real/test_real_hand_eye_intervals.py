"""Hand-eye sessions of other people: do halves agree as stated, is good told from broken?

Sources and published answers: README.md and SOURCE.md in the folder of real data.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from common import nightly

import coursekit.hand_eye as he
from coursekit.geometry import pose_difference
from coursekit.hand_eye.poses import camera_board, mean_pose, stand_board
from coursekit.hand_eye.views import rms_length, view_residuals

pytestmark = pytest.mark.real

OF_ANOTHER_CAMERA = np.array([9, 14, 15, 31, 33, 38]) - 1  # images of cam4
CAMERAS = (1, 2, 3, 4)


@pytest.fixture(scope="module")
def webcams(ur3_webcam) -> dict[int, he.HandEyeSession]:
    """Four webcams that look at a UR3e with a board in its gripper; as published."""
    return {camera: ur3_webcam(camera)[0] for camera in CAMERAS}


def put_right(session: he.HandEyeSession, camera: int) -> he.HandEyeSession:
    """Rows 25 and 26 exchanged back, and without the images of another camera."""
    order = np.arange(40)
    order[[24, 25]] = [25, 24]
    session = replace(session, T_base_gripper=session.T_base_gripper[order])
    rows = np.arange(40)
    return session.pick(np.setdiff1d(rows, OF_ANOTHER_CAMERA) if camera == 4 else rows)


@pytest.fixture(scope="module")
def healthy(moveit_poses, song_poses, doosan_poses, webcams) -> dict[str, he.HandEyeSession]:
    """Sessions whose rows belong together, of five arms."""
    found = {f"cam{camera}": put_right(webcams[camera], camera) for camera in CAMERAS}
    found["moveit"] = he.HandEyeSession("eye_to_hand", *moveit_poses)
    found["song"] = he.HandEyeSession("eye_in_hand", *song_poses)
    found["jpjp"] = he.HandEyeSession("eye_in_hand", *doosan_poses)
    return found


@pytest.fixture(scope="module")
def results(healthy) -> dict[str, he.HandEyeResult]:
    return {name: session.solve() for name, session in healthy.items()}


def sigmas_apart(one: he.HandEyeSession, other: he.HandEyeSession) -> float:
    """Rms over the six numbers of X of their difference, in stated sigmas."""
    first, second = one.solve(), other.solve()
    variance = np.diag(first.covariance + second.covariance)[:6]
    return float(np.sqrt(np.mean(pose_difference(first.X, second.X) ** 2 / variance)))


def test_halves_of_a_session_differ_by_what_they_state(healthy):
    """Every other pose (0.4 to 1.0 sigmas: neighbours share what drifts), and first against last
    half (0.5 to 1.9: they do not)."""
    apart = []
    for session in healthy.values():
        n = len(session)
        apart.append([
            sigmas_apart(session.pick(range(0, n, 2)), session.pick(range(1, n, 2))),
            sigmas_apart(session.pick(range(n // 2)), session.pick(range(n // 2, n))),
        ])  # fmt: skip
    assert 0.7 < np.sqrt(np.mean(np.square(apart))) < 1.5
    assert np.max(apart) < 2.0


def test_a_verdict_tells_good_sessions_from_broken_ones(results, webcams):
    for name, result in results.items():
        assert result.judgement.trusted, name
        assert repr(result).count("(95 %") == 2
        assert replace(result.session, q=None).joints is None  # no WidowX took these poses
        assert result.verdict().split(":")[0] in ("Good", "Usable with care", "Not good enough")
    for session in webcams.values():  # with exchanged rows and foreign images
        result = session.solve()
        assert result.verdict().startswith("Not to be trusted")
        assert "95 %" not in repr(result)


def test_intervals_hold_published_cameras_or_those_fit_far_worse(real_data, healthy, results):
    held = {"moveit": (0.659, -0.249, 0.830), "song": (0.058541, 0.071351, 0.117351)}
    for name, place in held.items():
        result = results[name]
        far = np.abs(result.X[:3, 3] - place)
        assert (far < result.quantile() * result.sigma_mm / 1e3).sum() >= 2
        assert (far < 3 * result.sigma_mm / 1e3).all()
    # Of the webcams the published places put one and the same board in the gripper 6 to 17 mm
    # apart, and miss the corners by three times as many pixels; ours put it within 3 mm.
    path = real_data / "alimedlej_ur3_four_webcams/tf_base_to_camera.json"
    cameras = json.loads(path.read_text("utf-8"))["T_base_to_camera"]
    boards, worse = {"published": [], "ours": []}, []
    for camera in CAMERAS:
        session, result, rms = healthy[f"cam{camera}"], results[f"cam{camera}"], []
        published = np.array(cameras[f"cam{camera}"]["T_4x4"])
        for name, X in (("published", published), ("ours", result.X)):
            places = stand_board(session.T_base_gripper, result.measured, X, session.mount)
            Y = mean_pose(places)
            boards[name].append(Y[:3, 3])
            expected = camera_board(session.T_base_gripper, X, Y, session.mount)
            rows = view_residuals(session.corners(), expected, 1.0)
            rms.append(rms_length(np.concatenate(rows)))
        worse.append(rms[0] / rms[1])
    assert np.ptp(boards["ours"], axis=0).max() < 3e-3
    assert np.ptp(boards["published"], axis=0).max() > 15e-3
    assert min(np.delete(worse, 2)) > 3.0  # the third sinks, and is wide enough to hold its own


@pytest.mark.parametrize("camera", [1, *(pytest.param(k, marks=nightly) for k in (2, 4))])
def test_the_lens_of_another_camera_is_named(webcams, camera: int) -> None:
    """That of `udacity_chessboard`, given by mistake; it is too near to what cam3's images say.

    With its own none is accused of it: test_real_hand_eye_diagnose.py.
    """
    lens = webcams[camera].intrinsics
    other = replace(lens, fx=1161.0, fy=1157.0)
    assert he.diagnose(replace(webcams[camera], intrinsics=other)).names[0] == "foreign_lens"
