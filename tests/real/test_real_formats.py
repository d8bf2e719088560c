"""Files of others as they came: a robot's poses in mm and degrees, a lens, MoveIt's pairs."""

import json

import numpy as np
import pytest

from coursekit.formats import poses
from coursekit.geometry import Intrinsics
from coursekit.hand_eye import HandEyeSession

pytestmark = pytest.mark.real


@pytest.fixture(scope="module")
def dobot(real_data, song_poses):
    """The poses of a Dobot CR5, where its camera saw the board, and what its owner published."""
    folder = real_data / "song_dobot_cr5"
    arm, known = (
        json.loads((folder / f"{name}.json").read_text("utf-8"))
        for name in ("arm_data", "handeye_result")
    )
    return arm, song_poses[1], np.array(known["matrix_4x4"])


@pytest.mark.parametrize(("mark", "decimal"), [(",", "."), (";", ",")])
def test_a_dobots_table_gives_its_owners_camera(dobot, tmp_path, mark, decimal) -> None:
    arm, seen, published = dobot
    fields = arm["pose_fields"]
    lines = [mark.join(["image", *fields])]
    for pose in arm["poses"]:
        cells = [repr(pose[name]).replace(".", decimal) for name in fields]
        lines.append(mark.join([f"{pose['idx']}.png", *cells]))
    path = tmp_path / "poses.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(ValueError, match="do not say how they turn"):
        poses.read_table(path)
    with pytest.raises(ValueError, match=r"reach [\d]+ m; if they are mm"):
        poses.read_table(path, rotation="xyz", angle="deg")
    with pytest.raises(ValueError, match="reach 180 rad"):
        poses.read_table(path, rotation="xyz", angle="rad", length="mm")
    _, rows = poses.read_table(path, rotation="xyz", angle="deg", length="mm")
    session = HandEyeSession("eye_in_hand", np.stack([row.T for row in rows]), seen)
    X = session.solve("park").X
    off = np.linalg.norm(X[:3, 3] - published[:3, 3])
    assert 1e3 * off < 0.01
    assert np.abs(X[:3, :3] - published[:3, :3]).max() < 1e-5


def test_a_script_of_somebody_keeps_its_lens_in_json(real_data) -> None:
    path = real_data / "song_dobot_cr5" / "camera_data.json"
    with pytest.raises(ValueError, match="no image size"):
        Intrinsics.from_file(path)
    lens = Intrinsics.from_file(path, size=(1280, 720))
    assert (round(lens.fx, 2), round(lens.coeffs[4], 4)) == (630.03, -0.0225)
