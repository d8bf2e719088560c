"""Hand-eye: closed forms, OpenCV's solvers, the pose of a board, observability, the next pose."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from common import EXPECTED, by_opencv, each, named, refusals
from scipy.spatial.transform import Rotation
from simulated_hand_eye import BOARD, LENS, arm_session, corners_at, free_session, typical

import coursekit.hand_eye as he
from coursekit.arm import widowx
from coursekit.boards import Board, Detection
from coursekit.geometry import (
    invert_transform,
    make_transform,
    pose_difference,
    project,
    transform_points,
    turned,
)
from coursekit.hand_eye.poses import camera_board, check_poses

# --- solvers ---


@pytest.mark.parametrize("mount", he.MOUNTS)
@pytest.mark.parametrize("method", he.METHODS)
def test_every_method_finds_exact_poses_again_and_is_near_with_noisy_corners(mount, method):
    known = free_session(1, mount, n=10)
    result = he.solve(known.with_poses(), method)
    np.testing.assert_allclose(result.X, known.X, atol=1e-8)
    np.testing.assert_allclose(result.Y, known.Y, atol=1e-8)
    assert result.spread_board_mm < 1e-5
    assert result.spread_gripper_mm < 1e-5
    assert result.method == method
    known = arm_session(2, mount)
    off = pose_difference(known.solve(method).X, known.X)
    assert np.degrees(np.linalg.norm(off[:3])) < 0.1
    assert np.linalg.norm(off[3:]) < 1.5e-3


@pytest.mark.parametrize("mount", he.MOUNTS)
def test_a_point_reaches_the_base_the_same_way_through_camera_and_board(mount):
    """The meaning of X and Y, told by points and not by the equation that was solved."""
    known = arm_session(4, mount, n=12)
    result = known.solve()
    for T, seen in zip(known.T, known.exact, strict=True):
        in_camera = transform_points(seen, BOARD.points)
        if mount == "eye_in_hand":
            one = transform_points(T @ result.X, in_camera)
            other = transform_points(result.Y, BOARD.points)
        else:
            one = transform_points(result.X, in_camera)
            other = transform_points(T @ result.Y, BOARD.points)
        np.testing.assert_allclose(one, other, atol=3e-4)


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
    result = he.HandEyeSession("eye_in_hand", T, seen).solve("closed_form")
    np.testing.assert_allclose(result.X, X, atol=1e-4)
    T[:4, :3, :3] = Rotation.from_rotvec(np.radians(175) * np.eye(4, 3)).as_matrix()
    alone = he.HandEyeSession("eye_in_hand", T[:4], camera_board(T[:4], X, Y, "eye_in_hand"))
    np.testing.assert_allclose(alone.solve("closed_form").X, X, atol=1e-4)


# --- what is no session ---


def test_bad_input_names_the_argument_and_the_index():
    known = free_session(6, n=5)
    T, C = known.T, known.exact
    mirrored, skewed, holes = T.copy(), C.copy(), C.copy()
    mirrored[3, :3, 0] *= -1
    skewed[1, :3, :3] *= 1.01
    holes[4, 0, 3] = np.nan
    cases = [
        (T, C[:4], r"seen: got 4, want 5, one for each arm pose"),
        (mirrored, C, r"T_base_gripper\[3\]: .* reflection"),
        (T, skewed, r"seen\[1\]: the rotation is not orthonormal"),
        (T, holes, r"seen\[4\]: has NaN"),
        (np.swapaxes(T, 1, 2), C, r"T_base_gripper\[0\]: the last row .* transposed"),
        (T[:, :3], C, r"T_base_gripper: got shape \(5, 3, 4\), want \(n, 4, 4\)"),
        (T, list("abcde"), r"seen: want an array"),
        (T, known.session.detections, r"board: got None"),
    ]
    for arm, seen, message in cases:
        with pytest.raises(ValueError, match=message):
            he.HandEyeSession("eye_in_hand", arm, seen)
    with pytest.raises(ValueError, match=r"mount: got 'eye'"):
        he.HandEyeSession("eye", T, C)
    with pytest.raises(ValueError, match=r"seen: got 4, want 5"):
        replace(known.session, seen=known.session.detections[:4])
    for options, message in (
        ({"method": "best"}, r"method: got 'best'"),
        ({"method": "park", "free_scale": True}, r"method: got 'park', want 'refine' with free_sc"),
        ({"method": "park", "guess": known.X}, r"method: got 'park', want 'refine' with guess"),
        ({"free_offsets": True}, r"q: got None, want joint angles"),
        ({"fk": "usuall"}, r"fk: got 'usuall', want 'usual', None or FkErrors"),
    ):
        with pytest.raises(ValueError, match=message):
            known.solve(**options)
    with pytest.raises(ValueError, match=r"T_base_gripper: got 2, want at least 3 poses"):
        known.session.pick([0, 1]).solve()


def test_a_closed_form_claims_no_uncertainty():
    result = free_session(7, n=6).solve("park")
    with pytest.raises(ValueError, match="park gives no covariance"):
        result.interval("tx")
    assert "Uncertain" in result.verdict()


def around(T, twists):
    return np.stack([T @ turned(np.eye(4), twist) for twist in twists])


def degenerate(kind, noise=9):
    """A session of a wrist camera over a board, by what the arm does; X and Y."""
    X, T = typical("eye_in_hand")[0], widowx().forward([0.0, 1.2, 1.0, 0.2, 0.0, 0.0])
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
    seen = corners_at(camera_board(T, X, Y, "eye_in_hand"), np.random.default_rng(noise))
    return he.HandEyeSession("eye_in_hand", T, seen, BOARD, LENS), X, Y


def test_a_grid_at_fixed_orientation_leaves_the_translation_free():
    """Of exact poses: claim H5."""
    session, X, _ = degenerate("grid")
    T = session.T_base_gripper
    assert he.observability(T, "eye_in_hand").free == ("translation along all axes is free",)
    R = he.rotation_from_shifts(T, session.T_camera_board, "eye_in_hand")
    assert np.degrees(Rotation.from_matrix(R @ X[:3, :3].T).magnitude()) < 1.0
    with pytest.raises(he.NotDetermined, match="one line"):
        he.rotation_from_shifts(T[:5], session.T_camera_board[:5], "eye_in_hand")


def test_one_axis_leaves_a_turn_and_a_shift_free():
    """In words; and sliding along the axis or turning about it changes no prediction."""
    session, X, Y = degenerate("one axis")
    T = session.T_base_gripper
    with pytest.raises(he.NotDetermined, match=r"one axis, \(1, 0, 0\)"):
        session.solve()
    found = he.observability(T, "eye_in_hand", X, Y)
    assert he.observability(T, "eye_in_hand").free == found.free
    assert list(found.free) == EXPECTED["free_with_one_axis"]
    free = found.directions[found.singular_values < 1.0]
    assert len(free) == 2
    seen = camera_board(T, X, Y, "eye_in_hand")
    for direction in free:
        moved = turned(X, 1e-4 * direction / np.linalg.norm(direction))
        off = pose_difference(seen, camera_board(T, moved, T[0] @ moved @ seen[0], "eye_in_hand"))
        assert np.abs(off).max() < 1e-7


@pytest.mark.parametrize("kind", ["grid", "one axis", "small"])
def test_no_solver_fails_silently(kind, capfd):
    session, *_ = degenerate(kind)
    for method in he.CLOSED_FORMS:
        try:
            result = session.solve(method)
        except (he.SolverFailed, he.NotDetermined):
            continue
        R = result.X[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(R) > 0
        if kind != "small":
            assert "NOT DETERMINED: " in repr(result)
            assert "is free" in result.verdict()
    assert capfd.readouterr().err == ""
    if kind == "small":
        with pytest.raises(he.SolverFailed, match="tsai: OpenCV returned the identity"):
            session.solve("tsai")


@pytest.mark.parametrize(
    ("R", "t", "message"),
    [
        (np.diag([1.0, 1.0, -1.0]), 0.0, "reflection"),
        (np.full((3, 3), np.nan), 0.0, "NaN"),
        (2 * np.eye(3), 0.0, "no rotation"),
        (np.diag([1.0, -1.0, -1.0]), 1e6, "a place 2e[+]06 m away"),
    ],
)
def test_what_a_solver_returns_is_checked(monkeypatch, R, t, message):
    monkeypatch.setattr(cv2, "calibrateHandEye", lambda *a, **k: (R, np.full((3, 1), t)))
    with pytest.raises(he.SolverFailed, match=f"park: returned .*{message}"):
        free_session(10, n=6).solve("park")


# --- the pose of the board ---


def test_the_pose_of_a_board_is_where_least_squares_ends():
    """Gauss-Newton on the own derivatives takes no step from where OpenCV's iteration stopped."""
    session = free_session(11, n=12).session
    T = session.T_camera_board
    squares, gradient, information = session.corners().linear(T, 1.0)
    step = np.linalg.solve(information[:, :6, :6], gradient[:, :6, None])[..., 0]
    assert np.abs(step).max() < 1e-6
    better = session.corners().linear(turned(T, step), 1.0)[0]
    np.testing.assert_allclose(squares, better, rtol=1e-9)
    for detection, pose in zip(session.detections, session.board_poses, strict=True):
        predicted = by_opencv(BOARD.points, pose.T_camera_board, LENS)
        rms = np.sqrt(np.mean(np.sum((predicted - detection.pixels) ** 2, axis=1)))
        assert pose.rms_px == pytest.approx(rms, rel=1e-6)
        assert pose.other is None


def test_the_covariance_of_a_board_pose_is_honest():
    T = np.tile(free_session(12, n=3).exact[:1], (200, 1, 1))
    poses = he.board_poses(corners_at(T, np.random.default_rng(13)), BOARD, LENS)
    off = pose_difference(np.stack([pose.T_camera_board for pose in poses]), T)
    pairs = zip(off, poses, strict=True)
    squares = [one @ np.linalg.solve(pose.covariance, one) for one, pose in pairs]
    assert np.mean(squares) == pytest.approx(6.0 * 102 / 100, abs=0.9)  # F with 6 and 102


def test_a_small_board_seen_head_on_has_two_poses():
    board = Board("checkerboard", (5, 4), 0.005)
    lean = make_transform(Rotation.from_euler("x", 12, degrees=True), [-0.008, -0.005, 0.45])
    (pose,) = he.board_poses(corners_at(lean[None], np.random.default_rng(14), board), board, LENS)
    assert pose.other is not None
    both = [np.linalg.norm(pose_difference(T, lean)[:3]) for T in (pose.T_camera_board, pose.other)]
    assert np.degrees(min(both)) < 8
    assert np.degrees(max(both)) > 12


def test_board_poses_name_the_image():
    seen = list(free_session(15, n=4).session.detections)
    pixels = seen[0].pixels
    for views, message in (
        ([*seen[:2], Detection(range(5), pixels[:5], LENS.size, "02")],
         r"detections\[2\] \(02\): has 5 corners"),
        ([Detection(range(9), pixels[:9], LENS.size)], r"detections\[0\]: .* on one line"),
        ([Detection(range(55, 61), pixels[:6], LENS.size)], "has corner 60, .* 0 to 53"),
        ([Detection(range(9), pixels[:9], (320, 240))], r"is \(320, 240\) px, not \(640, 480\)"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            he.board_poses(views, BOARD, LENS)


def test_poses_written_with_few_digits_are_rotations_all_the_same():
    T = free_session(16, n=5).exact
    rounded = check_poses("T", T.round(5))
    R = rounded[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (5, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(rounded, T, atol=2e-5)


# --- observability and the next pose ---


def test_observability_predicts_the_scatter_of_the_refinement():
    """With the noise that it assumes, its worst direction is as uncertain as repetition says."""
    known = free_session(17, n=12)
    sizes = np.repeat([np.radians(0.1), 0.5e-3], 3)
    predicted = he.observability(known.T, "eye_in_hand", known.X, known.Y)
    rng, found = np.random.default_rng(18), []
    for _ in range(50):
        seen = turned(known.exact, sizes * rng.normal(size=(12, 6)))
        found.append(pose_difference(known.X, he.solve(known.with_poses(seen)).X))
    unit = np.repeat([0.3, 1.0], 3)
    measured = np.sqrt(np.linalg.eigvalsh(np.cov(np.array(found).T * unit[:, None])))
    np.testing.assert_allclose(1e3 * measured, np.sort(predicted.sigma_mm), rtol=0.25)


def test_observability_measures_angles():
    narrow = he.observability(free_session(19, n=25, tilt_deg=2.0).T, "eye_in_hand")
    wide = he.observability(free_session(19, n=25).T, "eye_in_hand")
    assert [int(np.sum(one.turns_deg > 10.0)) for one in (narrow, wide)] == [1, 3]
    assert not wide.free
    assert max(map(len, repr(wide).splitlines())) <= 92
    assert wide.sigma_mm[-1] < narrow.sigma_mm[-1] / 3
    R = Rotation.from_matrix(free_session(19, n=25).T[:, :3, :3])
    largest = max((one.inv() * R).magnitude().max() for one in R)
    assert wide.largest_turn_deg == pytest.approx(np.degrees(largest))


@pytest.mark.parametrize("mount", he.MOUNTS)
def test_the_next_pose_is_the_one_that_a_refit_likes_best(mount):
    known = arm_session(20, mount, n=14)
    result = known.part(slice(0, 6)).solve()
    q = known.session.q[6:]
    proposal = he.next_pose(result, q)
    sizes = []
    for index in range(len(q)):
        six = [*range(6), 6 + index]
        sizes.append(he.observability(known.T[six], mount, result.X, result.Y).sigma_mm[-1])
    order = np.argsort(sizes)
    assert proposal.index in order[:2]  # the image's own noise is in one and not in the other
    np.testing.assert_array_equal(proposal.q, q[proposal.index])
    assert proposal.then_mm[proposal.index] < proposal.now_mm
    assert np.isfinite(proposal.then_mm).all()


@pytest.mark.parametrize("mount", he.MOUNTS)
def test_a_proposal_is_within_the_limits_and_sees_the_board(mount):
    arm, known = widowx(), arm_session(21, mount, n=5)
    proposal = he.next_pose(known.solve(), seed=3)
    arm.check(proposal.q)
    assert arm.is_free(proposal.q)
    C = camera_board(proposal.T_base_gripper[None], known.X, known.Y, mount)[0]
    pixels = project(transform_points(C, BOARD.points), LENS.K, LENS.dist)
    assert ((pixels > 0) & (pixels < [639, 479])).all()
    assert C[2, 2] > 0
    assert proposal.then_mm[proposal.index] < 0.8 * proposal.now_mm
    assert max(map(len, repr(proposal).splitlines())) <= 92
    assert he.next_pose(known.solve(), seed=3).index == proposal.index


def test_after_one_axis_the_next_pose_turns_about_another():
    for noise in (2, 3, 4, 9):  # where nothing is known, rounding has either sign
        session, X, Y = degenerate("one axis", noise)
        T, result = session.T_base_gripper, session.solve(guess=X)
        said = repr(result) + result.verdict()
        assert (said.count("unknown in part"), said.count("± over 1000 mm")) == (2, 1)
    middle = Y @ make_transform(np.eye(3), BOARD.points.mean(axis=0))
    orbit = middle @ turned(np.eye(4), np.array([0.35, 0, 0, 0, 0, 0])) @ invert_transform(middle)
    shifted = around(T[12], np.array([[0, 0, 0, 0.02, 0, 0], [0.1, 0, 0, 0, 0, 0]]))
    proposal = he.next_pose(result, np.concatenate([shifted, (orbit @ T[12])[None]]))
    assert proposal.index == 2
    assert proposal.then_mm[2] < 0.1 * proposal.then_mm[:2].min()


def test_the_next_pose_needs_a_candidate():
    known = free_session(22, n=6)
    away = np.tile(make_transform(np.eye(3), [5.0, 0, 0]), (3, 1, 1))
    with pytest.raises(ValueError, match="candidates: got 3, want one where"):
        he.next_pose(known.solve(), away)
    far = replace(known.session, T_base_gripper=make_transform(np.eye(3), [9, 0, 0]) @ known.T)
    with pytest.raises(ValueError, match="arm: reaches none of the poses"):
        he.next_pose(far.solve())
    with pytest.raises(ValueError, match="board, intrinsics: want both"):
        he.next_pose(replace(known.with_poses(), board=None).solve(), away)


test_an_error_study_of_nothing_is_refused = refusals(
    *each("^poses: got 2, want a whole number of at least 3", he.error_study, "poses", (2,)),
    *named(he.error_study, axes=[(1,)], pairs=["some"], ranges_deg=[(0.0,)]),
)
