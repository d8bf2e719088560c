"""`diagnose` on MoveIt's fifty pose pairs: quiet as they are, and each mistake by its name."""

import re
from dataclasses import replace

import numpy as np
import pytest
from common import NIGHTLY, nightly

from coursekit.geometry import invert_transform
from coursekit.hand_eye import HandEyeSession
from coursekit.hand_eye.diagnosis import diagnose as diagnose_session

pytestmark = pytest.mark.real

MOUNT = "eye_to_hand"


def diagnose(arm: np.ndarray, seen: np.ndarray, mount: str = MOUNT):
    return diagnose_session(HandEyeSession(mount, arm, seen))


def larger(T: np.ndarray, factor: float) -> np.ndarray:
    T = T.copy()
    T[:, :3, 3] *= factor
    return T


def test_as_they_are_nothing_is_found(moveit_poses) -> None:
    assert diagnose(*moveit_poses).names == ()


MISTAKES = {  # that no simulated session of test_hand_eye_diagnose.py has
    "both in mm": ("millimetres", lambda arm, seen: (larger(arm, 1e3), larger(seen, 1e3))),
    "rolled": ("off_by_one", lambda arm, seen: (np.roll(arm, 1, axis=0), seen)),
}


@pytest.mark.parametrize("kind", MISTAKES)
def test_a_mistake_is_named(moveit_poses, kind: str) -> None:
    name, mistake = MISTAKES[kind]
    assert diagnose(*mistake(*moveit_poses)).names == (name,)


@pytest.mark.parametrize("factor", [1.05, pytest.param(0.95, marks=nightly)])
def test_board_size(moveit_poses, factor: float) -> None:
    arm, seen = moveit_poses
    [finding] = diagnose(arm, larger(seen, factor))
    assert finding.name == "wrong_square_size"
    stated = float(finding.evidence.split("the board is ")[1].split()[0])
    assert stated == pytest.approx(1 / factor, abs=0.005)


def test_the_other_way_round(moveit_poses) -> None:
    arm, seen = moveit_poses
    inverted = diagnose(invert_transform(arm), seen)
    others = diagnose(arm, invert_transform(seen)), diagnose(arm, seen, "eye_in_hand")
    for [finding] in (inverted, *others):
        assert finding.name == "inconsistent_convention"
        for number, name in enumerate(("arm poses", "board poses", "another mount"), 1):
            assert f"({number}) {name}" in finding.evidence
        assert "(0.659, -0.250, 0.830) m" in finding.evidence
    assert "Only one is plausible: arm poses inverted" in inverted[0].evidence


def test_healthy_sessions_of_other_arms_get_no_finding(song_poses, doosan_poses) -> None:
    for arm, seen in (song_poses, doosan_poses):
        assert diagnose(arm, seen, "eye_in_hand").names == ()


@pytest.mark.parametrize(
    ("camera", "names"),
    [
        (1, ("exchanged_rows",)),
        pytest.param(2, ("exchanged_rows",), marks=nightly),
        (3, ("exchanged_rows", "slow_drift")),
        (4, ("exchanged_rows", "outlier_pose", "slipping_board")),
    ],
)
def test_four_webcams(ur3_webcam, camera: int, names: tuple[str, ...]) -> None:
    """Two rows of the table are exchanged, camera 3 sinks, six images are another camera's.

    Camera 4 turned by a degree in its clamp after its sixth image.
    """
    given, _ = ur3_webcam(camera)
    findings = diagnose_session(given)
    assert findings.names == names
    assert f"img25_cam{camera}.png and img26_cam{camera}.png" in findings[0].says
    if camera == 4:
        foreign = {int(number) for number in re.findall(r"img(\d+)_cam4", findings[1].evidence)}
        assert foreign == {9, 14, 15, 31, 33, 38}


def test_joint_angles_of_another_arm(ur3_webcam) -> None:
    given, q = ur3_webcam(1)
    [finding] = diagnose_session(replace(given, T_base_gripper=given.arm.forward(q), q=q))
    assert finding.name == "joints_of_another_arm"
    assert "WidowX AI" in finding.evidence
    beside = diagnose_session(replace(given, q=q))
    assert beside.names == ("exchanged_rows", "joints_of_another_arm")


def test_pairs_of_real_sessions(song_poses, doosan_poses, moveit_poses) -> None:
    """A lost image, the order of text and a camera frame of ROS, on data of three arms; by day of
    the two with fewer poses."""
    arms = [(*song_poses, "eye_in_hand"), (*doosan_poses, "eye_in_hand"), (*moveit_poses, MOUNT)]
    for arm, seen, mount in arms if NIGHTLY else arms[:2]:
        n = len(arm)
        lost = diagnose(arm[:-1], np.delete(seen, n // 3, axis=0), mount)
        assert lost.names == ("off_by_one",)
        assert f"from view {n // 3:02d} on each image" in lost[0].says
        text = sorted(range(n), key=str)
        assert diagnose(arm, seen[text], mount).names == ("text_order",)
        body = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
        [frame] = diagnose(arm, body @ seen, mount)
        assert "x forward, y left, z up" in frame.evidence
