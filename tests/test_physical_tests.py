"""Touching the board and looking with two cameras: what the world says of an X."""

import numpy as np
import pytest

from coursekit.arm import ArmErrors
from coursekit.geometry import transform_points
from coursekit.hand_eye import MOUNTS
from coursekit.simulation import arm_sessions
from coursekit.simulation.arm_sessions import hand_eye_session, shared_target, touch_corners
from coursekit.specifications import DATA

NO_ERRORS = ArmErrors(0.0, 0.0, 0.0, 0.0)


def test_an_arm_without_errors_reports_where_the_corners_are() -> None:
    _, truth = hand_eye_session("eye_in_hand", 5, n=6, arm_errors=NO_ERRORS)
    corners = [0, 7, 39]
    places = transform_points(truth.setup.Y, truth.setup.board.points[corners])
    # the inverse kinematics stops at micrometres, and the controller half a milliradian short
    assert touch_corners(truth, corners) == pytest.approx(places, abs=1e-5)


def test_an_arm_with_errors_reports_other_places() -> None:
    """The mean of many units is the size that `ArmErrors` gives at the gripper: 2 to 5 mm."""
    off = []
    for seed in range(12):
        _, truth = hand_eye_session("eye_in_hand", seed, n=6, arm_errors=ArmErrors())
        places = transform_points(truth.setup.Y, truth.setup.board.points[[0]])
        off.append(np.linalg.norm(touch_corners(truth, [0]) - places))
    assert 1.5e-3 < np.mean(off) < 5e-3
    assert np.ptp(off) > 1e-3


def test_two_good_cameras_on_a_good_arm_agree() -> None:
    _, on_wrist = hand_eye_session("eye_in_hand", 5, n=6, arm_errors=NO_ERRORS)
    _, above = hand_eye_session("eye_to_hand", 5, n=6, arm_errors=NO_ERRORS)
    target = shared_target(on_wrist, above)
    near = transform_points(target.T_base_gripper @ on_wrist.X, target.in_wrist_camera)
    far = transform_points(above.X, target.in_shoulder_camera)
    assert np.linalg.norm(near - far) < 5 * arm_sessions.SEEN_TO_M
    middle = on_wrist.setup.board.points.mean(axis=0)
    assert near == pytest.approx(transform_points(on_wrist.setup.Y, middle), abs=1e-3)
    with pytest.raises(ValueError, match=r"^truth: got 'eye_to_hand'"):
        touch_corners(above)
    with pytest.raises(ValueError, match=r"^on_wrist, over_shoulder: "):
        shared_target(above, above)


def test_the_shipped_sessions_are_of_one_arm() -> None:
    """Notebook 04 compares what its two cameras say."""
    units = [arm_sessions.truth_of(DATA / f"hand_{mount}").arm.reveal() for mount in MOUNTS]
    assert units[0].offset_rad == pytest.approx(units[1].offset_rad)
    assert units[0].link == pytest.approx(units[1].link)
