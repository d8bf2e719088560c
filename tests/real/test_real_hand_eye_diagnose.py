"""`diagnose` on MoveIt's fifty pose pairs: quiet as they are, and each mistake by its name."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coursekit.geometry import invert_transform
from coursekit.hand_eye import HandEyeSession
from coursekit.hand_eye.diagnosis import diagnose as diagnose_session

pytestmark = pytest.mark.real

MOUNT = "eye_to_hand"


@pytest.fixture(scope="module")
def pairs() -> tuple[np.ndarray, np.ndarray]:
    """T_base_gripper and T_camera_board, (50, 4, 4) each."""
    if not os.environ.get("COURSEKIT_REAL_DATA"):
        pytest.skip("COURSEKIT_REAL_DATA is not set: it names the folder of real data")
    folder = Path(os.environ["COURSEKIT_REAL_DATA"]) / "moveit_hand_eye"
    samples = np.array(json.loads((folder / "pose_samples.json").read_text(encoding="utf-8")))
    return samples[:, 0], samples[:, 1]


def diagnose(arm: np.ndarray, seen: np.ndarray, mount: str = MOUNT):
    return diagnose_session(HandEyeSession(mount, arm, seen))


def larger(T: np.ndarray, factor: float) -> np.ndarray:
    T = T.copy()
    T[:, :3, 3] *= factor
    return T


def test_as_they_are_nothing_is_found(pairs) -> None:
    assert diagnose(*pairs).names == ()


def test_millimetres(pairs) -> None:
    arm, seen = pairs
    for given in (
        (larger(arm, 1e3), seen),
        (arm, larger(seen, 1e3)),
        (larger(arm, 1e3), larger(seen, 1e3)),
    ):
        assert diagnose(*given).names == ("millimetres",)


@pytest.mark.parametrize("kind", ["rotation vectors", "xyz", "XYZ"])
def test_degrees(pairs, kind: str) -> None:
    arm, seen = pairs
    turns = Rotation.from_matrix(arm[:, :3, :3])
    given = arm.copy()
    if kind == "rotation vectors":
        turns = Rotation.from_rotvec(turns.as_rotvec(degrees=True))
    else:
        turns = Rotation.from_euler(kind, turns.as_euler(kind, degrees=True))
    given[:, :3, :3] = turns.as_matrix()
    [finding] = diagnose(given, seen)
    assert finding.name == "degrees"
    assert "4.1 mm" in finding.evidence


def test_shifted_by_one(pairs) -> None:
    arm, seen = pairs
    for given in ((arm[1:], seen[:-1]), (arm[:-1], seen[1:]), (np.roll(arm, 1, axis=0), seen)):
        assert diagnose(*given).names == ("off_by_one",)


@pytest.mark.parametrize("factor", [1.05, 0.95])
def test_board_size(pairs, factor: float) -> None:
    arm, seen = pairs
    [finding] = diagnose(arm, larger(seen, factor))
    assert finding.name == "wrong_square_size"
    stated = float(finding.evidence.split("the board is ")[1].split()[0])
    assert stated == pytest.approx(1 / factor, abs=0.005)


def test_the_other_way_round(pairs) -> None:
    arm, seen = pairs
    inverted = (invert_transform(arm), seen)
    for given in (inverted, (arm, invert_transform(seen), MOUNT), (arm, seen, "eye_in_hand")):
        [finding] = diagnose(*given)
        assert finding.name == "inconsistent_convention"
        for number, name in enumerate(("arm poses", "board poses", "another mount"), 1):
            assert f"({number}) {name}" in finding.evidence
        assert "(0.659, -0.250, 0.830) m" in finding.evidence
    assert "Only one is plausible: arm poses inverted" in diagnose(*inverted)[0].evidence
