"""The joint refinement: its minimum, its derivatives, and whether its intervals are honest.

COURSEKIT_NIGHTLY=1 repeats the statistics over 1,000 sessions in place of 40.
"""

from __future__ import annotations

import os
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import least_squares
from simulated_hand_eye import BOARD, LENS, arm_session, free_session

import coursekit.hand_eye as he
from coursekit.arm import ArmErrors, pose_difference, widowx
from coursekit.boards import Board, Detections
from coursekit.geometry import invert_transform, project
from coursekit.hand_eye.poses import camera_board, turned
from coursekit.hand_eye.refinement import PixelViews, PoseViews, by_arm_twist, by_X_and_Y
from coursekit.hand_eye.result import board_gap

NIGHTLY = os.environ.get("COURSEKIT_NIGHTLY") == "1"
SESSIONS = 1000 if NIGHTLY else 40
HELD = slice(25, 45)


def solve(session, method="refine", **options):
    return he.solve(
        session.T_base_gripper, session.detections, session.mount, method,
        board=BOARD, intrinsics=LENS, **options,
    )  # fmt: skip


# --- the minimum ---


@pytest.mark.parametrize("mount", he.MOUNTS)
def test_the_minimum_is_that_of_scipy(mount):
    """Residuals written anew with `project` alone; SciPy differentiates them numerically."""
    session = free_session(1, mount, n=6)
    pixels = np.stack([d.pixels for d in session.detections])

    def residuals(x):
        X, Y = turned(session.X, x[:6]), turned(session.Y, x[6:])
        T = session.T_base_gripper
        link = T if mount == "eye_to_hand" else invert_transform(T)
        C = invert_transform(X) @ link @ Y
        at = BOARD.points @ np.swapaxes(C[:, :3, :3], 1, 2) + C[:, None, :3, 3]
        return (project(at, LENS.K, LENS.dist) - pixels).ravel()

    fit = least_squares(residuals, np.zeros(12), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    result = solve(session)
    np.testing.assert_allclose(pose_difference(session.X, result.X), fit.x[:6], atol=2e-7)
    np.testing.assert_allclose(pose_difference(session.Y, result.Y), fit.x[6:], atol=2e-7)
    covariance = 2 * fit.cost / (pixels.size - 12) * np.linalg.inv(fit.jac.T @ fit.jac)
    sigma = np.sqrt(np.diag(covariance))
    scaled = (result.covariance - covariance) / np.outer(sigma, sigma)
    assert np.abs(scaled).max() < 0.01
    assert result.refined.converged


@pytest.mark.parametrize("mount", he.MOUNTS)
def test_the_minimum_with_an_erring_arm_is_that_of_scipy(mount):
    """The whole dense problem: X, Y, the unit's errors and those of each pose, 55 + 6 n + 12."""
    session = arm_session(2, mount, n=6, errors=ArmErrors())
    result = solve(session, fk=session.fk)
    problem = result.refined.problem
    views, own_root = problem.views, problem._own_root
    shared = session.fk.shared * session.fk.sigma

    def residuals(x):
        s, u = x[12:67], x[67:].reshape(6, 6)
        T = turned(session.T_base_gripper, shared @ s + np.einsum("nij,nj->ni", own_root, u))
        C = camera_board(T, turned(session.X, x[:6]), turned(session.Y, x[6:12]), mount)
        return np.concatenate([views.residuals(C).ravel() / views.sigma_px, x[12:]])

    fit = least_squares(residuals, np.zeros(12 + 55 + 36), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    sigma = np.sqrt(np.diag(result.covariance))
    found = np.concatenate([
        pose_difference(session.X, result.X), pose_difference(session.Y, result.Y)
    ])  # fmt: skip
    np.testing.assert_allclose(found / sigma, fit.x[:12] / sigma, atol=2e-3)
    assert result.refined.squares == pytest.approx(2 * fit.cost, rel=1e-6)
    covariance = np.linalg.inv(fit.jac.T @ fit.jac)[:12, :12]
    assert np.abs((result.covariance - covariance) / np.outer(sigma, sigma)).max() < 0.01


@pytest.mark.parametrize("mount", he.MOUNTS)
def test_derivatives_are_those_of_finite_differences(mount):
    session = free_session(3, mount, n=4)
    T, X, Y = session.T_base_gripper, session.X, session.Y
    by_both, by_arm = by_X_and_Y(T, X, Y, mount), by_arm_twist(T, X, Y, mount)
    step = 1e-6
    for k in range(6):
        twist = step * np.eye(6)[k]
        for columns, both in (
            (by_both[..., k], [(T, turned(X, s * twist), Y) for s in (-1, 1)]),
            (by_both[..., 6 + k], [(T, X, turned(Y, s * twist)) for s in (-1, 1)]),
            (by_arm[..., k], [(turned(T, np.tile(s * twist, (4, 1))), X, Y) for s in (-1, 1)]),
        ):
            low, high = (camera_board(*one, mount) for one in both)
            np.testing.assert_allclose(columns, pose_difference(low, high) / 2 / step, atol=1e-8)


@pytest.mark.parametrize("kind", ["pixels", "poses"])
def test_the_gradient_of_the_views_is_that_of_their_squares(kind):
    session = free_session(4, n=3)
    C = turned(camera_board(session.T_base_gripper, session.X, session.Y, "eye_in_hand"),
               1e-3 * np.random.default_rng(5).normal(size=(3, 6)))  # fmt: skip
    views = PixelViews.of(session.detections, BOARD, LENS, 0.1)
    if kind == "poses":
        seen = camera_board(session.T_base_gripper, session.X, session.Y, "eye_in_hand")
        views = PoseViews(seen, np.tile(np.diag([1e6, 2e6, 3e6, 4e6, 5e6, 6e6]), (3, 1, 1)))
    _, gradient, information = views.linear(C, 1.01)
    assert np.linalg.eigvalsh(information[:, :6, :6]).min() > 0
    for k in range(7):
        twist, scale = (1e-6 * np.eye(7)[k])[:6], 1e-6 * (k == 6)
        low, high = (
            views.linear(turned(C, np.tile(s * twist, (3, 1))), 1.01 * np.exp(s * scale))[0]
            for s in (-1, 1)
        )
        slope = -(high - low) / 4e-6
        np.testing.assert_allclose(gradient[:, k], slope, rtol=1e-4, atol=1e-3 * abs(slope).max())


# --- what else is unknown ---


def test_the_size_of_the_board_comes_out_too():
    session = arm_session(6)
    claimed = Board("checkerboard", (10, 7), 0.02 / 1.05)
    fixed, free = (
        he.solve(session.T_base_gripper, session.detections, "eye_in_hand", board=claimed,
                 intrinsics=LENS, free_scale=free)
        for free in (False, True)
    )  # fmt: skip
    low, high = free.scale - 3 * free.sigma("scale"), free.scale + 3 * free.sigma("scale")
    assert low < 1.05 < high
    assert free.sigma("scale") < 5e-4
    assert free.rms_px < 0.1 * fixed.rms_px
    assert free.holds(session.X, 0.999).all()
    assert f"\nscale = {free.scale:.5f} ± 0.000" in repr(free)
    poses = [pose.T_camera_board for pose in he.board_poses(session.detections, claimed, LENS)]
    of_poses = he.solve(session.T_base_gripper, poses, "eye_in_hand", free_scale=True)
    assert of_poses.scale == pytest.approx(1.05, abs=2e-3)
    assert of_poses.spread_board_mm < 0.5


@pytest.mark.parametrize("mount", he.MOUNTS)
def test_joint_offsets_come_out_where_the_poses_show_them(mount):
    """joint_0 turns the whole base, joint_5 the hand: X or Y imitate them, and sigma says so."""
    arm, session = widowx(), arm_session(7, mount, n=25)
    offsets = np.radians([0.5, -0.8, 0.6, 0.9, -0.7, 0.4])
    reported = session.q - offsets
    T = arm.forward(reported)
    result = he.solve(T, session.detections, mount, board=BOARD, intrinsics=LENS,
                      arm=arm, q=reported)  # fmt: skip
    off = result.joint_offsets_rad - offsets
    sigma = np.array([result.sigma(f"offset_{joint}") for joint in range(6)])
    assert (np.abs(off) < 4 * sigma).all()
    assert sigma[1:5].max() < np.radians(0.05)
    assert sigma[[0, 5]].max() > np.radians(1.0)
    plain = he.solve(T, session.detections, mount, board=BOARD, intrinsics=LENS)
    assert result.rms_px < 0.2
    assert plain.rms_px > 3.0
    with pytest.raises(ValueError, match=r"q: got shape \(5, 6\), want finite \(25, 6\)"):
        he.solve(T, session.detections, mount, board=BOARD, intrinsics=LENS, arm=arm,
                 q=reported[:5])  # fmt: skip


def test_offsets_and_stated_errors_are_not_counted_twice():
    session = arm_session(8, n=12, errors=ArmErrors())
    result = solve(session, fk=session.fk, arm=widowx(), q=session.q)
    assert sum(name.startswith("offset") for name in result.names) == 6
    alone = solve(session, fk=session.fk)
    assert sum(name.startswith("offset") for name in alone.names) == 6
    np.testing.assert_allclose(
        pose_difference(alone.X, result.X), 0, atol=0.1 * np.sqrt(alone.covariance[3, 3])
    )
    np.testing.assert_allclose(result.sigma_mm, alone.sigma_mm, rtol=0.05)
    seen = camera_board(session.T_base_gripper, session.X, session.Y, "eye_in_hand")
    with pytest.raises(ValueError, match="fk: got poses"):
        he.solve(session.T_base_gripper, seen, "eye_in_hand", fk=session.fk)
    with pytest.raises(ValueError, match="guess: park starts from nothing"):
        solve(session, "park", guess=session.X)
    with pytest.raises(ValueError, match=r"fk: has \(12, 6, 6\), want \(11, 6, 6\)"):
        he.solve(session.T_base_gripper[:11], session.detections[:11], "eye_in_hand",
                 board=BOARD, intrinsics=LENS, fk=session.fk)  # fmt: skip


def test_the_levels_of_pose_noise_come_out():
    session = free_session(9, n=60)
    sizes = np.repeat([np.radians(0.3), 0.8e-3], 3)
    seen = camera_board(session.T_base_gripper, session.X, session.Y, "eye_in_hand")
    seen = turned(seen, sizes * np.random.default_rng(10).normal(size=(60, 6)))
    result = he.solve(session.T_base_gripper, seen, "eye_in_hand")
    assert result.refined.levels["rotation_rad"] == pytest.approx(np.radians(0.3), rel=0.2)
    assert result.refined.levels["position_m"] == pytest.approx(0.8e-3, rel=0.2)
    with pytest.raises(ValueError, match="no residuals in px"):
        result.rms_px  # noqa: B018


def test_an_ambiguous_board_takes_the_pose_that_fits_the_arm():
    small = Board("checkerboard", (5, 4), 0.006)
    session = free_session(11, n=20)
    seen = camera_board(session.T_base_gripper, session.X, session.Y, "eye_in_hand")
    rng = np.random.default_rng(12)
    at = small.points @ np.swapaxes(seen[:, :3, :3], 1, 2) + seen[:, None, :3, 3]
    pixels = project(at, LENS.K, LENS.dist) + 0.15 * rng.normal(size=(20, 12, 2))
    views = Detections([
        replace(d, ids=np.arange(12), pixels=uv)
        for d, uv in zip(session.detections, pixels, strict=True)
    ])  # fmt: skip
    poses = he.board_poses(views, small, LENS)
    assert sum(pose.ambiguous for pose in poses) >= 2
    result = he.solve(session.T_base_gripper, views, "eye_in_hand", board=small, intrinsics=LENS)
    alone = np.stack([pose.T_camera_board for pose in poses])
    swapped = np.flatnonzero((alone != result.data.T_camera_board).any(axis=(1, 2)))
    assert len(swapped) >= 1
    mirrored = board_gap(alone, result.T_camera_board, small, 1.0)
    assert (result.gap_m[swapped] < mirrored[swapped]).all()
    assert result.holds(session.X, 0.9999).all()
    assert result.rms_px == pytest.approx(0.15 * np.sqrt(2), rel=0.1)


# --- what a result says ---


def test_a_result_reads_like_one():
    session = arm_session(13)
    result = solve(session)
    text = repr(result)
    assert max(map(len, text.splitlines())) <= 92
    assert text.splitlines()[0] == "eye_in_hand, refine, 25 poses, 1350 corners"
    assert "T_gripper_camera: (" in text
    assert result.verdict().startswith("Good: ")
    low, high = result.interval("tx")
    assert (low + high) / 2 == pytest.approx(result.X[0, 3])
    assert high - low == pytest.approx(2 * 1.961 * result.sigma("tx"), rel=1e-3)
    low, high = result.interval("rx", 0.5)
    assert low == -high
    assert high == pytest.approx(0.6747 * result.sigma("rx"), rel=1e-3)
    assert result.sigma_deg[0] == pytest.approx(np.degrees(result.sigma("X.rx")))
    with pytest.raises(ValueError, match="name: got 'x'"):
        result.sigma("x")
    with pytest.raises(ValueError, match="level: got 2"):
        result.interval("tx", 2)
    assert len(result.residuals) == 25
    assert result.residuals[0].shape == (54, 2)
    assert result.rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.06)


def test_an_arm_that_errs_is_seen_from_the_residuals_alone():
    session = arm_session(14, errors=ArmErrors())
    verdict = solve(session).verdict()
    assert "the arm errs, which was taken as exact" in verdict.replace("\n  ", " ")
    weighed = solve(session, fk=session.fk)
    assert "errs" not in weighed.verdict()
    assert weighed.excess < 4
    assert solve(session).excess > 100
    assert weighed.sigma_mm.max() > 5 * solve(session).sigma_mm.max()


def test_corners_behind_the_camera_do_not_pass():
    session = free_session(15, n=4)
    views = PixelViews.of(session.detections, BOARD, LENS)
    C = camera_board(session.T_base_gripper, session.X, session.Y, "eye_in_hand")
    C[1, 2, 3] -= 1.0
    squares = views.linear(C, 1.0)[0]
    np.testing.assert_array_equal(np.isinf(squares), [False, True, False, False])
    assert np.isinf(views.residuals(C)[54:108]).all()


def test_held_out_poses_are_judged_in_px_and_mm():
    session = arm_session(16, n=45)
    result = solve(session.part(slice(0, 25)))
    other = session.part(HELD)
    gap = he.held_out(result, other.T_base_gripper, other.detections)
    assert gap.rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.06)
    np.testing.assert_allclose(gap.gap_m**2, gap.along_m**2 + gap.across_m**2)
    moved = turned(other.T_base_gripper, np.tile([0, 0, 0, 0.003, 0, 0], (20, 1)))
    off = he.held_out(result, moved, other.detections)
    assert off.rms_mm == pytest.approx(3.0, rel=0.03)
    assert "20 poses held out: " in repr(off)
    one = he.held_out(result, other.T_base_gripper[:1], other.detections[:1])
    assert len(one.gap_m) == 1


# --- a thousand sessions ---


@cache
def statistics(mount):
    """What intervals hold and which solver predicts best, over SESSIONS sessions of each kind."""
    noise, hidden, stated, best, ratio, at_its_word = [], [], [], [], [], []
    for seed in range(SESSIONS):
        session = arm_session(1000 + seed, mount, 45)
        fit, other = session.part(slice(0, 25)), session.part(HELD)
        result = solve(fit)
        noise.append(result.holds(session.X))
        best.append(held_px(result, other) < min(closed_forms_px(fit, other)))

        session = arm_session(1000 + seed, mount, 45, errors=ArmErrors())
        fit, other = session.part(slice(0, 25)), session.part(HELD)
        plain, weighed = solve(fit), solve(fit, fk=fit.fk)
        hidden.append(plain.holds(session.X))
        stated.append(weighed.holds(session.X))
        others = [*closed_forms_px(fit, other), held_px(plain, other)]
        put_right = he.held_out(weighed, other.T_base_gripper, other.detections, fk=other.fk)
        ratio.append(put_right.rms_px / min(others))
        at_its_word.append(held_px(weighed, other) / min(others))
    return {
        "noise only": np.array(noise), "hidden": np.array(hidden), "stated": np.array(stated),
        "best": np.array(best), "ratio": np.array(ratio), "at its word": np.array(at_its_word),
    }  # fmt: skip


def closed_forms_px(fit, other):
    seen = [pose.T_camera_board for pose in he.board_poses(fit.detections, BOARD, LENS)]
    return [
        held_px(he.solve(fit.T_base_gripper, seen, fit.mount, method), other)
        for method in he.CLOSED_FORMS
    ]


def held_px(result, other):
    """`held_out(...).rms_px` without the poses that it also fits."""
    C = camera_board(other.T_base_gripper, result.X, result.Y, result.mount)
    rows = PixelViews.of(other.detections, BOARD, LENS).residuals(C)
    return np.sqrt(np.mean(np.sum(rows**2, axis=1)))


SLACK = 0.0 if NIGHTLY else 0.04  # of a share over 40 sessions


@pytest.mark.parametrize("mount", he.MOUNTS)
def test_with_corner_noise_alone_the_intervals_hold(mount):
    held = statistics(mount)["noise only"]
    assert 0.93 - SLACK <= held.mean() <= 0.97 + SLACK
    if NIGHTLY:
        assert ((held.mean(axis=0) >= 0.93) & (held.mean(axis=0) <= 0.97)).all()


@pytest.mark.parametrize("mount", he.MOUNTS)
def test_an_arm_that_errs_unstated_breaks_the_intervals(mount):
    assert statistics(mount)["hidden"].mean() < 0.3


@pytest.mark.parametrize("mount", he.MOUNTS)
def test_with_the_arms_errors_stated_the_intervals_hold_again(mount):
    held = statistics(mount)["stated"]
    assert 0.90 - SLACK <= held.mean() <= 0.98 + SLACK / 2
    if NIGHTLY:
        assert ((held.mean(axis=0) >= 0.90) & (held.mean(axis=0) <= 0.98)).all()


@pytest.mark.parametrize("mount", he.MOUNTS)
def test_the_refinement_predicts_held_out_pixels_better_than_every_closed_form(mount):
    assert statistics(mount)["best"].mean() >= 0.9


@pytest.mark.parametrize("mount", he.MOUNTS)
def test_with_an_erring_arm_the_weighed_refinement_is_best_once_it_may_correct_the_arm(mount):
    """Its X is the camera's; an arm that is taken at its word wants an X that is wrong with it."""
    found = statistics(mount)
    assert np.median(found["ratio"]) <= 1.02
    assert np.median(found["at its word"]) > 1.02
