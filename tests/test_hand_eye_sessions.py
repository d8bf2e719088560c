"""Simulated hand-eye sessions against their own truth, and sessions in folders."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from common import by_opencv, mutants, named, refusals
from simulated_hand_eye import holds

from coursekit.arm import ArmErrors, widowx
from coursekit.geometry import pose_difference
from coursekit.hand_eye.poses import camera_board
from coursekit.hand_eye.session import HandEyeSession
from coursekit.simulation.arm_sessions import (
    FOLDER_VIEWS,
    HandEyeMistakes,
    hand_eye_session,
    rendered_session,
    session_folder,
    truth_of,
)
from coursekit.simulation.corner_sessions import Effects
from coursekit.specifications import DATA
from tools import make_data

MOUNTS = ("eye_in_hand", "eye_to_hand")
SHIPPED = [DATA / f"hand_{mount}" for mount in MOUNTS]


def seen_by_opencv(truth, view: int) -> np.ndarray:
    """All corners (N, 2) of a view by another implementation of the projection."""
    T, lens = truth.T_camera_board[view], truth.setup.intrinsics
    points = truth.setup.board.points * truth.mistakes.square_scale
    return by_opencv(points, T, lens)


# --- what is simulated ---


@pytest.mark.parametrize("mount", MOUNTS)
def test_corners_are_where_opencv_projects_them(mount) -> None:
    session, truth = hand_eye_session(mount, 3, corner_noise_px=0.1, arm_errors=ArmErrors())
    off = [d.pixels - seen_by_opencv(truth, i)[d.ids] for i, d in enumerate(session.seen)]
    assert np.std(np.concatenate(off)) == pytest.approx(0.1, rel=0.05)
    assert np.abs(np.mean(np.concatenate(off), axis=0)).max() < 0.02
    exact, truth = hand_eye_session(mount, 3, corner_noise_px=0.0)
    for i, d in enumerate(exact.seen):
        np.testing.assert_allclose(d.pixels, seen_by_opencv(truth, i)[d.ids], atol=1e-6)


@pytest.mark.parametrize("mount", MOUNTS)
def test_truth_closes_the_loop_and_the_report_is_off_by_what_the_arm_errs(mount) -> None:
    session, truth = hand_eye_session(mount, 5, arm_errors=ArmErrors())
    expected = camera_board(truth.T_base_gripper, truth.X, truth.setup.Y, mount)
    np.testing.assert_allclose(truth.T_camera_board, expected, atol=1e-12)
    np.testing.assert_allclose(session.T_base_gripper, widowx().forward(session.q), atol=1e-12)
    off = pose_difference(session.T_base_gripper, truth.T_base_gripper)
    assert 5e-4 < np.median(np.linalg.norm(off[:, 3:], axis=1)) < 8e-3
    exact, truth = hand_eye_session(mount, 5)
    np.testing.assert_allclose(exact.T_base_gripper, truth.T_base_gripper, atol=1e-12)
    off = pose_difference(truth.X, exact.solve().X)
    assert np.abs(off[3:]).max() < 3e-4
    assert np.abs(off[:3]).max() < np.radians(0.05)


@pytest.mark.parametrize("tails", [False, True])
def test_an_arm_errs_by_its_scatter_at_each_pose_on_its_own(tails: bool) -> None:
    """With the std asked for, independent from pose to pose; heavy tails have some far larger."""
    habits = HandEyeMistakes(scatter_m=1e-3, scatter_deg=0.2, scatter_tails=tails)
    off = []
    for seed in range(12):
        session, truth = hand_eye_session("eye_in_hand", seed, 25, mistakes=habits)
        off.append(pose_difference(session.T_base_gripper, truth.T_base_gripper))
    off = np.stack(off) / np.repeat([np.radians(0.2), 1e-3], 3)
    middle = 0.765 / np.sqrt(3) if tails else 0.674  # of |t| with 3 degrees of freedom, of |normal|
    assert np.median(np.abs(off)) == pytest.approx(middle, abs=0.06)
    assert abs(np.mean(np.sign(off[:, 1:] * off[:, :-1]))) < 0.12
    far = (np.abs(off) > 4).sum()  # of 1,800: 0.1 of normal ones, 11 of t, six of one pose together
    assert (far > 2) == tails


def test_the_images_of_an_arm_may_be_ordinary_too() -> None:
    """A wavy board and shared errors; the poses and the laboratory's noise stay as they are."""
    plain, truth = hand_eye_session("eye_in_hand", 4, 10)
    wavy, same = hand_eye_session("eye_in_hand", 4, 10, images=Effects(wave_m=4e-4, claimed=0.1))
    assert np.array_equal(truth.T_camera_board, same.T_camera_board)
    moved = [np.abs(b.pixels - a.pixels).max() for a, b in zip(plain.seen, wavy.seen, strict=True)]
    assert min(moved) > 0.1
    assert max(moved) < 3.0
    assert wavy.seen[0].noise_px == pytest.approx(0.01)


test_arguments_are_checked = refusals(
    *named(HandEyeMistakes, design=["circle"], square_scale=[0.0], late_s=[np.nan]),
    ("corner_noise_px", lambda: hand_eye_session("eye_in_hand", 0, corner_noise_px=-1)),
    ("mount: got 'on_the_ceiling'", lambda: hand_eye_session("on_the_ceiling", 0)),
)


# --- sessions in memory ---


def test_a_session_checks_what_belongs_together() -> None:
    session, _ = hand_eye_session("eye_in_hand", 0, n=10)
    q = session.q.copy()
    q[3, 2] = np.nan
    for changes, message in (
        ({"names": ("a", "b")}, "names: got 2, want 10"),
        ({"q": session.q[:5]}, r"q: got shape \(5, 6\), want \(10, 6\)"),
        ({"q": q}, r"q\[3\]: got .*nan"),
        ({"q": None, "dq": session.q}, "q: got None, want the joint angles"),
    ):
        with pytest.raises(ValueError, match=message):
            replace(session, **changes)


def test_pick_and_repr() -> None:
    session, _ = hand_eye_session("eye_in_hand", 0, n=10)
    part = session.pick([7, 2])
    assert part.names == ("view_07", "view_02")
    np.testing.assert_array_equal(part.q, session.q[[7, 2]])
    np.testing.assert_array_equal(part.seen[0].pixels, session.seen[7].pixels)
    assert session.pick(session.times > session.times[7]).names == ("view_08", "view_09")
    assert "10 arm poses and images, joint angles, times" in repr(session)


# --- sessions in a folder ---


@pytest.fixture(scope="module")
def shipped() -> list[HandEyeSession]:
    return [HandEyeSession.from_folder(folder, progress=False) for folder in SHIPPED]


@pytest.fixture
def small(tmp_path) -> Path:
    """A folder with the first six views of a shipped session."""
    lines = (SHIPPED[0] / "poses.csv").read_text("utf-8").splitlines(keepends=True)
    (tmp_path / "poses.csv").write_text("".join(lines[:7]), encoding="utf-8")
    for name in ["session.json", *(f"view_{i:02d}.jpg" for i in range(6))]:
        shutil.copy(SHIPPED[0] / name, tmp_path / name)
    return tmp_path


def read(folder: Path, **options) -> HandEyeSession:
    return HandEyeSession.from_folder(folder, progress=False, **options)


def test_a_picture_with_too_small_a_board_leaves_the_others() -> None:
    """Of unit 14 the markers over the shoulder are too small in one picture of twenty."""
    assert len(rendered_session("eye_to_hand", 8, arm_errors=ArmErrors())[2]) == FOLDER_VIEWS - 1


def test_shipped_sessions_are_what_make_data_makes(shipped) -> None:
    for folder, session in zip(SHIPPED, shipped, strict=True):
        assert (len(session), session.skipped) == (FOLDER_VIEWS, ())
        assert sum(path.stat().st_size for path in folder.iterdir()) < 1.6e6
        assert truth_of(folder).setup.mount == session.mount
        seed = make_data.HAND_EYE_SEED
        assert session_folder(session.mount, seed, folder) == folder
        made, _ = hand_eye_session(session.mount, seed, len(session), 0.0, ArmErrors())
        np.testing.assert_allclose(session.q, made.q, atol=1e-7)
        np.testing.assert_allclose(session.T_base_gripper, made.T_base_gripper, atol=1e-7)
        off = [
            seen.pixels - exact.pixels[np.isin(exact.ids, seen.ids)]
            for seen, exact in zip(session.seen, made.seen, strict=True)
            if np.isin(seen.ids, exact.ids).all()
        ]
        assert len(off) > 10
        assert np.sqrt(np.mean(np.concatenate(off) ** 2)) < 0.1


def test_shipped_sessions_show_the_error_of_the_arm(shipped) -> None:
    """At its word the arm puts X millimetres off; where its errors are weighed intervals hold."""
    for folder, session in zip(SHIPPED, shipped, strict=True):
        truth, result = truth_of(folder), session.solve()
        off = pose_difference(truth.X, session.solve(fk=None).X)
        assert 3e-4 < np.linalg.norm(off[3:]) < 6e-3
        assert holds(result, truth.X).all()
        text = (folder / "session.json").read_text("utf-8")
        assert f"{truth.X[0, 3]:.4f}" not in text


def test_truth_is_only_for_simulated_sessions(small) -> None:
    card = json.loads((small / "session.json").read_text(encoding="utf-8"))
    (small / "session.json").write_text(json.dumps(card | {"source": "my arm"}), encoding="utf-8")
    with pytest.raises(ValueError, match="nobody knows its X"):
        truth_of(small)
    with pytest.raises(ValueError, match=r"has no session\.json"):
        truth_of(small / "nowhere")


def test_save_and_read_again(small, tmp_path) -> None:
    session = read(small)
    folder = tmp_path / "copy"
    images = {name: (small / name).read_bytes() for name in session.names}
    session.save(folder, images, {"origin": "a test"})
    again = read(folder)
    np.testing.assert_allclose(again.T_base_gripper, session.T_base_gripper, atol=1e-7)
    np.testing.assert_allclose(again.q, session.q, atol=1e-7)
    np.testing.assert_allclose(again.times, session.times)
    assert again.board == session.board
    assert again.intrinsics == session.intrinsics
    assert json.loads((folder / "session.json").read_text(encoding="utf-8"))["origin"] == "a test"
    with pytest.raises(ValueError, match=r"images: got \[\], want .* 'view_00.jpg'"):
        session.save(folder, {})


def test_joint_angles_alone_are_enough(small) -> None:
    lines = (small / "poses.csv").read_text(encoding="utf-8").splitlines()
    drop = set(range(1, 8))
    kept = [",".join(c for i, c in enumerate(line.split(",")) if i not in drop) for line in lines]
    (small / "poses.csv").write_text(
        "\ufeff" + "\r\n".join(kept), encoding="utf-8"
    )  # as Excel on Windows saves
    session = read(small)
    np.testing.assert_allclose(session.T_base_gripper, widowx().forward(session.q))


def test_bad_rows_are_named_and_the_rest_is_used(small) -> None:
    lines = (small / "poses.csv").read_text(encoding="utf-8").splitlines()
    cells = [line.split(",") for line in lines]
    cells[1][1] = "0,3"  # becomes two cells: a decimal comma
    cells[2][4] = "2.0"
    cells[3][8] = "nan"
    rows = [",".join(row) for row in cells]
    rows += ["view_99.jpg" + rows[4][len("view_03.jpg") :], rows[5], "," + rows[5].split(",", 1)[1]]
    shutil.copy(small / "view_05.jpg", small / "view_06.jpg")
    rows.append("view_06.jpg" + rows[6][len("view_05.jpg") :])
    (small / "view_05.jpg").write_bytes(b"")
    (small / "poses.csv").write_text("\n".join(rows), encoding="utf-8")
    session = read(small)
    assert session.names == ("view_03.jpg", "view_04.jpg", "view_06.jpg")
    said = {skip.name: skip.reason for skip in session.skipped}
    assert "length" in said["poses.csv, line 3 (view_01.jpg)"]
    assert "time is nan" in said["poses.csv, line 4 (view_02.jpg)"]
    assert "no such file" in said["poses.csv, line 8 (view_99.jpg)"]
    assert "a row already" in said["poses.csv, line 9 (view_04.jpg)"]
    assert said["poses.csv, line 10"] == "no file is named"
    assert "empty" in said["view_05.jpg"]
    assert any(name.startswith("poses.csv, line 2") for name in said)
    assert "not used: poses.csv, line 3" in repr(session)


def test_folders_that_are_no_session(small, tmp_path) -> None:
    with pytest.raises(ValueError, match="want a folder that exists"):
        read(tmp_path / "nowhere")
    (tmp_path / "bare").mkdir()
    with pytest.raises(
        ValueError, match=r"mount: neither given \(mount=.eye_in_hand. or .eye_to_hand.\) nor in"
    ):
        read(tmp_path / "bare")
    session = read(small)
    known = {"mount": session.mount, "board": session.board, "intrinsics": session.intrinsics}
    with pytest.raises(ValueError, match=r"has no poses.csv"):
        read(tmp_path / "bare", **known)
    (small / "session.json").unlink()
    assert len(read(small, **known)) == 6
    text = (small / "poses.csv").read_text(encoding="utf-8")
    (small / "poses.csv").write_text(
        text.replace("qw", "w").replace("q5", "joint_5"), encoding="utf-8"
    )
    with pytest.raises(ValueError, match="no column 'qw'"):
        read(small, **known)
    (small / "poses.csv").write_text("\n".join(text.splitlines()[:3]), encoding="utf-8")
    with pytest.raises(ValueError, match="2 usable pairs"):
        read(small, **known)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_damaged_folder_is_a_sentence(tmp_path):
    lens = {"width": 640, "height": 480, "fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0}
    board = {"kind": "charuco", "squares": [9, 12], "square_m": 0.02}
    card = {"mount": "eye_in_hand", "board": board, "intrinsics": lens}
    lines = [f"v{i}.png,0.{i},0.2,0.3,0,0,0,1\n" for i in range(5)]
    poses = "".join(["file,x,y,z,qx,qy,qz,qw\n", *lines]).encode()
    random, tables = np.random.default_rng(1), [poses]
    for sign in (b'"', b"'", b";", b"\0", b"\xff", b"nan", b"1e999", b"9" * 400, b"x" * 200_000):
        for at in random.integers(0, len(poses), 20):
            tables.append(poses[:at] + sign + poses[at + 1 :])
    cards = [*mutants(card), json.dumps(card | {"board": board | {"squares": [10**9] * 2}})]
    for text, table in [(c, poses) for c in cards] + [(json.dumps(card), t) for t in tables]:
        (tmp_path / "session.json").write_text(text, encoding="utf-8")
        (tmp_path / "poses.csv").write_bytes(table)
        with pytest.raises(ValueError, match=r"\w+.*: "):
            HandEyeSession.from_folder(tmp_path, progress=False)
