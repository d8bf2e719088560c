"""Hand-eye: closed forms, OpenCV's solvers, the pose of a board, observability, the next pose."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_hand_eye import BOARD, LENS, arm_session, corners_at, free_session, typical

import coursekit.hand_eye as he
from coursekit.arm import pose_difference, widowx
from coursekit.boards import Board, Detection
from coursekit.geometry import invert_transform, make_transform, project, transform_points
from coursekit.hand_eye.poses import camera_board, check_poses, turned


def solve(session, method="refine", **options):
    return he.solve(
        session.T_base_gripper, session.detections, session.mount, method,
        board=BOARD, intrinsics=LENS, **options,
    )  # fmt: skip


def exact(session):
    return camera_board(session.T_base_gripper, session.X, session.Y, session.mount)


# --- solvers ---


@pytest.mark.parametrize("mount", he.MOUNTS)
@pytest.mark.parametrize("method", he.METHODS)
def test_every_method_finds_exact_poses_again(mount, method):
    session = free_session(1, mount, n=10)
    result = he.solve(session.T_base_gripper, exact(session), mount, method)
    np.testing.assert_allclose(result.X, session.X, atol=1e-8)
    np.testing.assert_allclose(result.Y, session.Y, atol=1e-8)
    assert result.spread_board_mm < 1e-5
    assert result.spread_gripper_mm < 1e-5
    assert result.method == method


@pytest.mark.parametrize("mount", he.MOUNTS)
@pytest.mark.parametrize("method", he.METHODS)
def test_every_method_is_near_the_truth_with_noisy_corners(mount, method):
    session = arm_session(2, mount)
    off = pose_difference(solve(session, method).X, session.X)
    assert np.degrees(np.linalg.norm(off[:3])) < 0.1
    assert np.linalg.norm(off[3:]) < 1.5e-3


@pytest.mark.parametrize("mount", he.MOUNTS)
def test_a_point_reaches_the_base_the_same_way_through_camera_and_board(mount):
    """The meaning of X and Y, told by points and not by the equation that was solved."""
    session = arm_session(4, mount, n=12)
    result = solve(session)
    for T, seen in zip(session.T_base_gripper, exact(session), strict=True):
        in_camera = transform_points(seen, BOARD.points)
        if mount == "eye_in_hand":
            one = transform_points(T @ result.X, in_camera)
            other = transform_points(result.Y, BOARD.points)
        else:
            one = transform_points(result.X, in_camera)
            other = transform_points(T @ result.Y, BOARD.points)
        np.testing.assert_allclose(one, other, atol=3e-4)


def test_the_halves_are_the_lessons_equations():
    session = free_session(3, n=6)
    A, B = he.motions(session.T_base_gripper, exact(session), "eye_in_hand")
    T, C = session.T_base_gripper, exact(session)
    np.testing.assert_allclose(A[0], np.linalg.inv(T[1]) @ T[0], atol=1e-12)  # i, j = 0, 1
    np.testing.assert_allclose(B[0], C[1] @ np.linalg.inv(C[0]), atol=1e-12)
    R = he.rotation_half(A, B)
    np.testing.assert_allclose(A[:, :3, :3] @ R, R @ B[:, :3, :3], atol=1e-10)
    t = he.translation_half(A, B, R)
    left = (A[:, :3, :3] - np.eye(3)) @ t
    np.testing.assert_allclose(left, B[:, :3, 3] @ R.T - A[:, :3, 3], atol=1e-10)
    np.testing.assert_allclose(make_transform(R, t), session.X, atol=1e-10)


def test_half_turns_do_no_harm():
    """At 180 deg an axis and its opposite are the same rotation; noise decides which is read."""
    rng = np.random.default_rng(5)
    X, Y = typical("eye_in_hand")
    turns = Rotation.from_rotvec(np.radians([[0, 0, a] for a in (0, 180, 179.99, 180.01, 30, 60)]))
    lean = Rotation.from_euler("xy", [[0, 0], [0, 0], [0, 0], [0, 0], [30, 0], [0, 30]], True)
    T = np.tile(np.eye(4), (6, 1, 1))
    T[:, :3, :3] = (turns * lean).as_matrix()
    T[:, :3, 3] = rng.uniform(-0.1, 0.1, (6, 3))
    seen = turned(camera_board(T, X, Y, "eye_in_hand"), 1e-5 * rng.normal(size=(6, 6)))
    result = he.solve(T, seen, "eye_in_hand", "closed_form")
    np.testing.assert_allclose(result.X, X, atol=1e-4)


# --- what is no session ---


def test_bad_input_names_the_argument_and_the_index():
    session = free_session(6, n=5)
    T, C = session.T_base_gripper, exact(session)
    mirrored, skewed, holes = T.copy(), C.copy(), C.copy()
    mirrored[3, :3, 0] *= -1
    skewed[1, :3, :3] *= 1.01
    holes[4, 0, 3] = np.nan
    flipped = np.swapaxes(T, 1, 2)
    cases = [
        (T[:2], C[:2], r"T_base_gripper: got 2 poses, want at least 3"),
        (T, C[:4], r"seen: got 4, T_base_gripper has 5"),
        (mirrored, C, r"T_base_gripper\[3\]: .* reflection"),
        (T, skewed, r"seen\[1\]: .* no rotation"),
        (T, holes, r"seen\[4\]: has NaN"),
        (flipped, C, r"T_base_gripper\[0\]: the last row .* transposed"),
        (T[:, :3], C, r"T_base_gripper: got float64 of shape \(5, 3, 4\)"),
        (T, list("abcde"), r"seen: got"),
    ]
    for arm, seen, message in cases:
        with pytest.raises(ValueError, match=message):
            he.solve(arm, seen, "eye_in_hand")
    with pytest.raises(ValueError, match=r"mount: got 'eye'"):
        he.solve(T, C, "eye")
    with pytest.raises(ValueError, match=r"method: got 'best'"):
        he.solve(T, C, "eye_in_hand", "best")
    with pytest.raises(ValueError, match=r"method: park has no free_scale"):
        he.solve(T, C, "eye_in_hand", "park", free_scale=True)
    with pytest.raises(ValueError, match=r"intrinsics: got None"):
        he.solve(T, session.detections, "eye_in_hand", board=BOARD)
    with pytest.raises(ValueError, match=r"seen: got 4, .* 5"):
        he.solve(T, session.detections[:4], "eye_in_hand", board=BOARD, intrinsics=LENS)
    with pytest.raises(ValueError, match=r"arm, q: .* both"):
        he.solve(T, C, "eye_in_hand", arm=widowx())


def test_a_closed_form_claims_no_uncertainty():
    result = solve(free_session(7, n=6), "park")
    with pytest.raises(ValueError, match="park gives no covariance"):
        result.interval("tx")
    assert "Uncertain" in result.verdict()


def around(T, twists):
    return np.stack([T @ turned(np.eye(4), twist) for twist in twists])


def degenerate(kind):
    """Arm poses and detections of a wrist camera over a board, by what the arm does."""
    X, _ = typical("eye_in_hand")
    T = widowx().forward([0.0, 1.2, 1.0, 0.2, 0.0, 0.0])
    centre = make_transform(np.eye(3), -BOARD.points.mean(axis=0))
    Y = T @ X @ make_transform(np.eye(3), [0, 0, 0.35]) @ centre
    twists = np.zeros((25, 6))
    if kind == "grid":
        twists[:, 3:5] = 0.015 * (np.mgrid[-2:3, -2:3].reshape(2, -1).T)
    elif kind == "one axis":
        twists[:, 0] = np.radians(np.linspace(-20, 20, 25))
    else:
        twists[:, :3] = np.radians(0.5) * np.random.default_rng(8).uniform(-1, 1, (25, 3))
    T = around(T, twists)
    seen = corners_at(camera_board(T, X, Y, "eye_in_hand"), np.random.default_rng(9), 0.1)
    return T, seen, X, Y


def test_a_grid_at_fixed_orientation_leaves_the_translation_free():
    T, seen, X, Y = degenerate("grid")
    with pytest.raises(he.NotDetermined, match="translation is free in all directions"):
        he.solve(T, seen, "eye_in_hand", board=BOARD, intrinsics=LENS)
    assert he.observability(T, "eye_in_hand").free == ("translation along all axes is free",)
    poses = [pose.T_camera_board for pose in he.board_poses(seen, BOARD, LENS)]
    R = he.rotation_from_shifts(T, poses, "eye_in_hand")
    assert np.degrees(Rotation.from_matrix(R @ X[:3, :3].T).magnitude()) < 1.0
    perfect = camera_board(T, X, Y, "eye_in_hand")
    np.testing.assert_allclose(
        he.rotation_from_shifts(T, perfect, "eye_in_hand"), X[:3, :3], atol=1e-9
    )
    with pytest.raises(he.NotDetermined, match="one line"):
        he.rotation_from_shifts(T[:5], poses[:5], "eye_in_hand")


def test_one_axis_leaves_a_turn_and_a_shift_free():
    T, seen, X, Y = degenerate("one axis")
    with pytest.raises(he.NotDetermined, match=r"one axis, \(1.00, .*0.00, .*0.00\)"):
        he.solve(T, seen, "eye_in_hand", board=BOARD, intrinsics=LENS)
    words = (
        "rotation about the common axis (1, 0, 0) is free",
        "translation along the common axis (1, 0, 0) is free",
    )
    assert he.observability(T, "eye_in_hand").free == words
    assert he.observability(T, "eye_in_hand", X, Y).free == words


def test_the_null_space_of_one_axis_is_no_figure_of_speech():
    """Sliding the camera along the axis, and turning it about it, changes no prediction."""
    T, _, X, Y = degenerate("one axis")
    M = invert_transform(T)
    found = he.observability(T, "eye_in_hand", X, Y)
    free = found.directions[found.singular_values < 1.0]
    assert len(free) == 2
    for direction in free:
        moved = turned(X, 1e-4 * direction / np.linalg.norm(direction))
        stand = invert_transform(M[0]) @ moved @ camera_board(T, X, Y, "eye_in_hand")[0]
        off = pose_difference(
            camera_board(T, X, Y, "eye_in_hand"), camera_board(T, moved, stand, "eye_in_hand")
        )
        assert np.abs(off).max() < 1e-7


@pytest.mark.parametrize("kind", ["grid", "one axis", "small"])
@pytest.mark.parametrize("method", sorted(set(he.CLOSED_FORMS)))
def test_no_solver_fails_silently(kind, method, capfd):
    T, seen, *_ = degenerate(kind)
    try:
        result = he.solve(T, seen, "eye_in_hand", method, board=BOARD, intrinsics=LENS)
    except (he.SolverFailed, he.NotDetermined):
        pass
    else:
        R = result.X[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(R) > 0
        if kind != "small":
            assert "NOT DETERMINED: " in repr(result)
            assert "is free" in result.verdict()
    assert capfd.readouterr().err == ""


def test_tsais_identity_is_caught():
    T, seen, *_ = degenerate("small")
    with pytest.raises(he.SolverFailed, match="tsai: OpenCV returned the identity"):
        he.solve(T, seen, "eye_in_hand", "tsai", board=BOARD, intrinsics=LENS)


@pytest.mark.parametrize(
    ("R", "message"),
    [
        (np.diag([1.0, 1.0, -1.0]), "reflection"),
        (np.full((3, 3), np.nan), "NaN"),
        (2 * np.eye(3), "no rotation"),
    ],
)
def test_what_a_solver_returns_is_checked(monkeypatch, R, message):
    session = free_session(10, n=6)
    monkeypatch.setattr(cv2, "calibrateHandEye", lambda *args, **kwargs: (R, np.zeros((3, 1))))
    with pytest.raises(he.SolverFailed, match=f"park: returned .*{message}"):
        solve(session, "park")


# --- the pose of the board ---


def test_the_pose_of_a_board_agrees_with_opencv():
    seen = free_session(11, n=12).detections
    for detection, pose in zip(seen, he.board_poses(seen, BOARD, LENS), strict=True):
        rotation, translation = (
            cv2.Rodrigues(pose.T_camera_board[:3, :3])[0].copy(),
            pose.T_camera_board[:3, 3:].copy(),
        )
        refined = cv2.solvePnPRefineLM(
            BOARD.points, detection.pixels, LENS.K, LENS.dist, rotation, translation,
            (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-14),
        )  # fmt: skip
        np.testing.assert_allclose(refined[1], pose.T_camera_board[:3, 3:], atol=1e-7)
        predicted = cv2.projectPoints(BOARD.points, *refined, LENS.K, LENS.dist)[0][:, 0]
        rms = np.sqrt(np.mean(np.sum((predicted - detection.pixels) ** 2, axis=1)))
        assert pose.rms_px == pytest.approx(rms, rel=1e-6)
        assert not pose.ambiguous


def test_the_covariance_of_a_board_pose_is_honest():
    T = exact(free_session(12, n=3))[:1]
    rng = np.random.default_rng(13)
    squares = []
    for _ in range(200):
        pose = he.board_pose(corners_at(T, rng, 0.1)[0], BOARD, LENS)
        off = pose_difference(pose.T_camera_board, T[0])
        squares.append(off @ np.linalg.solve(pose.covariance, off))
    assert np.mean(squares) == pytest.approx(6.0 * 102 / 100, abs=0.9)  # F with 6 and 102


def test_a_small_board_seen_head_on_has_two_poses():
    board = Board("checkerboard", (5, 4), 0.005)
    lean = make_transform(Rotation.from_euler("x", 12, degrees=True), [-0.008, -0.005, 0.45])
    pixels = project(transform_points(lean, board.points), LENS.K, LENS.dist)
    pixels += 0.1 * np.random.default_rng(14).normal(size=pixels.shape)
    pose = he.board_pose(Detection(np.arange(12), pixels, LENS.size), board, LENS)
    assert pose.ambiguous
    both = [np.linalg.norm(pose_difference(T, lean)[:3]) for T in (pose.T_camera_board, pose.other)]
    assert np.degrees(min(both)) < 8
    assert np.degrees(max(both)) > 12


def test_board_poses_name_the_image():
    seen = list(free_session(15, n=4).detections)
    with pytest.raises(ValueError, match=r"detections\[2\] \(02\): has 5 corners"):
        he.board_poses([*seen[:2], Detection(range(5), seen[2].pixels[:5], LENS.size, "02")],
                       BOARD, LENS)  # fmt: skip
    line = Detection(range(9), seen[0].pixels[:9], LENS.size)
    with pytest.raises(ValueError, match=r"detection\[0\]: .* on one line"):
        he.board_pose(line, BOARD, LENS)
    with pytest.raises(ValueError, match=r"has corner 60, the board has 0 to 53"):
        he.board_pose(Detection(range(55, 61), seen[0].pixels[:6], LENS.size), BOARD, LENS)
    with pytest.raises(ValueError, match=r"is \(320, 240\) px, the intrinsics \(640, 480\)"):
        he.board_pose(Detection(range(9), seen[0].pixels[:9], (320, 240)), BOARD, LENS)


def test_poses_written_with_few_digits_are_rotations_all_the_same():
    T = exact(free_session(16, n=5))
    rounded = check_poses("T", T.round(5))
    np.testing.assert_allclose(
        rounded[:, :3, :3] @ np.swapaxes(rounded[:, :3, :3], 1, 2), np.tile(np.eye(3), (5, 1, 1)),
        atol=1e-14,
    )  # fmt: skip
    np.testing.assert_allclose(rounded, T, atol=2e-5)


# --- observability and the next pose ---


def test_observability_predicts_the_scatter_of_the_closed_form():
    """With the noise that it is told, its worst direction is as uncertain as repetition says."""
    session = free_session(17, n=12)
    sizes = np.repeat([np.radians(0.1), 0.5e-3], 3)
    predicted = he.observability(session.T_base_gripper, "eye_in_hand", session.X, session.Y)
    rng, found = np.random.default_rng(18), []
    for _ in range(300):
        seen = turned(exact(session), sizes * rng.normal(size=(12, 6)))
        result = he.solve(session.T_base_gripper, seen, "eye_in_hand")
        found.append(pose_difference(session.X, result.X))
    unit = np.repeat([0.3, 1.0], 3)
    measured = np.sqrt(np.linalg.eigvalsh(np.cov(np.array(found).T * unit[:, None])))
    np.testing.assert_allclose(1e3 * measured, np.sort(predicted.sigma_mm), rtol=0.25)


def test_observability_counts_axes_and_angles():
    narrow = he.observability(free_session(19, n=25, tilt_deg=2.0).T_base_gripper, "eye_in_hand")
    wide = he.observability(free_session(19, n=25).T_base_gripper, "eye_in_hand")
    assert (narrow.axes_turned, wide.axes_turned) == (1, 3)
    assert wide.determined
    assert max(map(len, repr(wide).splitlines())) <= 92
    assert wide.sigma_mm[-1] < narrow.sigma_mm[-1] / 3
    with pytest.raises(ValueError, match="rotation_rad: got 0"):
        he.observability(np.tile(np.eye(4), (3, 1, 1)), "eye_in_hand", rotation_rad=0)


@pytest.mark.parametrize("mount", he.MOUNTS)
def test_the_next_pose_is_the_one_that_a_refit_likes_best(mount):
    session = arm_session(20, mount, n=14)
    result = solve(session.part(slice(0, 6)))
    q = session.q[6:]
    proposal = he.next_pose(result, q, arm=widowx())
    sizes = []
    for index in range(len(q)):
        six = [*range(6), 6 + index]
        seen = he.observability(session.T_base_gripper[six], mount, result.X, result.Y)
        sizes.append(seen.sigma_mm[-1])
    order = np.argsort(sizes)
    assert proposal.index in order[:2]  # the image's own noise is in one and not in the other
    np.testing.assert_array_equal(proposal.q, q[proposal.index])
    assert proposal.then_mm[proposal.index] < proposal.now_mm
    assert proposal.usable.all()


@pytest.mark.parametrize("mount", he.MOUNTS)
def test_a_proposal_is_within_the_limits_and_sees_the_board(mount):
    arm, session = widowx(), arm_session(21, mount, n=5)
    proposal = he.next_pose(solve(session), arm=arm, seed=3)
    arm.check(proposal.q)
    assert arm.is_free(proposal.q)
    C = camera_board(proposal.T_base_gripper[None], session.X, session.Y, mount)[0]
    pixels = project(transform_points(C, BOARD.points), LENS.K, LENS.dist)
    assert ((pixels > 0) & (pixels < [639, 479])).all()
    assert C[2, 2] > 0
    assert proposal.then_mm[proposal.index] < 0.8 * proposal.now_mm
    assert max(map(len, repr(proposal).splitlines())) <= 92
    assert he.next_pose(solve(session), arm=arm, seed=3).index == proposal.index


def test_after_one_axis_the_next_pose_turns_about_another():
    T, seen, X, Y = degenerate("one axis")
    result = he.solve(T, seen, "eye_in_hand", board=BOARD, intrinsics=LENS, guess=X)
    assert "unknown in part" in repr(result)
    middle = Y @ make_transform(np.eye(3), BOARD.points.mean(axis=0))
    orbit = middle @ turned(np.eye(4), np.array([0.35, 0, 0, 0, 0, 0])) @ invert_transform(middle)
    shifted = around(T[12], np.array([[0, 0, 0, 0.02, 0, 0], [0.1, 0, 0, 0, 0, 0]]))
    shifted = np.concatenate([shifted, (orbit @ T[12])[None]])
    proposal = he.next_pose(result, shifted)
    assert proposal.index == 2
    assert proposal.then_mm[2] < 0.1 * proposal.then_mm[:2].min()


def test_the_next_pose_needs_a_candidate():
    result = solve(free_session(22, n=6))
    away = np.tile(make_transform(np.eye(3), [5.0, 0, 0]), (3, 1, 1))
    with pytest.raises(ValueError, match="candidates: in none of 3"):
        he.next_pose(result, away)
    with pytest.raises(ValueError, match="arm: got None"):
        he.next_pose(result, np.zeros((3, 6)))
    with pytest.raises(ValueError, match="candidates: got None"):
        he.next_pose(result)


# --- claim H4 ---


def test_claim_h4_more_rotation_makes_a_better_camera_pose():
    """The claim's figures: consecutive pairs give its rotations, both bracket its millimetres."""
    claimed = {(3, 40): (0.13, 0.8), (2, 40): (0.17, 0.95), (2, 30): (0.22, 1.3),
               (3, 10): (0.50, 3.0), (2, 10): (0.65, 4.4)}  # fmt: skip
    points = {
        pairs: {(p.axes, p.range_deg): p for p in he.error_study(
            ranges_deg=(10, 30, 40), trials=400, pairs=pairs
        )} for pairs in ("all", "consecutive")
    }  # fmt: skip
    for key, (deg, mm) in claimed.items():
        every, next_one = points["all"][key], points["consecutive"][key]
        assert next_one.rotation_deg == pytest.approx(deg, rel=0.1)
        assert 0.85 * every.translation_mm < mm < 1.05 * next_one.translation_mm
        assert every.rotation_deg < 0.9 * next_one.rotation_deg


def test_errors_fall_with_the_number_of_poses():
    few, many = he.error_study(poses=(8, 32), ranges_deg=(30,), axes=(3,), trials=300)
    assert few.rotation_deg / many.rotation_deg == pytest.approx(2.0, rel=0.25)
    assert few.translation_mm / many.translation_mm == pytest.approx(2.0, rel=0.35)
    with pytest.raises(ValueError, match="poses: got 2"):
        he.error_study(poses=(2,))
    with pytest.raises(ValueError, match="axes: got"):
        he.error_study(axes=(1,))
