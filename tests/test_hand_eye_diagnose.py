"""`diagnose` on hand-eye sessions with a known mistake, and the parts that it is made of.

Thresholds were set on sessions with the seeds 0 to 99; the tests use seeds from 100,000 on, and
nothing was tuned on those. COURSEKIT_NIGHTLY=1 runs 100 sessions a mistake and 200 healthy ones.
"""

from collections import Counter
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from common import EXPECTED, NIGHTLY, check_named
from scipy.spatial.transform import Rotation

from coursekit.arm import ArmErrors, pose_difference, widowx
from coursekit.causes import CauseSearch, search
from coursekit.geometry import invert_transform, make_transform
from coursekit.hand_eye import causes, misread
from coursekit.hand_eye.causes import MendedPairs, PosePairs
from coursekit.hand_eye.diagnosis import diagnose
from coursekit.hand_eye.session import HandEyeSession
from coursekit.simulation.arm_sessions import HandEyeMistakes as M
from coursekit.simulation.arm_sessions import HandEyeTruth, hand_eye_session

FIRST_SEED = 100_000
CLASSES = {
    label: (name, M(**fields)) for label, (name, fields) in EXPECTED["hand_eye_classes"].items()
}


@lru_cache
def session(seed: int, mistakes: M, **options) -> tuple[HandEyeSession, HandEyeTruth]:
    """Both mounts, arms with and without errors, and 15 to 30 poses in turn.

    Of a design that hides X there are at most 25.
    """
    mount = ("eye_in_hand", "eye_to_hand")[seed % 2]
    errors = ArmErrors() if (seed // 2) % 2 else None
    most = 30 if mistakes.design == M().design else 25
    options = {"n": 15 + seed % (most - 14), "arm_errors": errors} | options
    return hand_eye_session(mount, seed, mistakes=mistakes, **options)


# --- the mistakes are named ---


@pytest.mark.parametrize("label", CLASSES)
def test_a_mistake_is_named(label: str) -> None:
    """At least 95 of 100 named, at most 5 with a wrong name besides (nightly).

    By day one, of either mount in turn, with and without errors of the arm: what names 80 % of all
    passes the 19 with 1 %.
    """
    name, mistakes = CLASSES[label]
    first = FIRST_SEED if NIGHTLY else FIRST_SEED + [*CLASSES].index(label)
    seeds = range(first, first + (100 if NIGHTLY else 1))
    found = Counter(diagnose(session(seed, mistakes)[0]).names for seed in seeds)
    check_named(found, name, label)


def test_healthy_sessions_get_no_finding() -> None:
    """At most 4 of 200 (nightly); of 4 none: a rate of 25 % passes with 32 %, and with 1 % here, in
    test_hand_eye_readings.py and in test_ordinary_sessions.py together.
    """
    count, most = (200, 4) if NIGHTLY else (4, 0)
    found: Counter[tuple[str, ...]] = Counter()
    for seed in range(FIRST_SEED + 1000, FIRST_SEED + 1000 + count):
        healthy, _ = session(seed, M(moving=(seed // 4) % 2 == 1))
        if seed % 3 == 0:
            healthy = replace(healthy, q=None, dq=None)
        found[diagnose(healthy).names] += 1
    print("healthy", dict(found))
    assert sum(n for names, n in found.items() if names) <= most


def test_sizes_come_out() -> None:
    """Each size in the evidence is the one that was put in, in the fit behind it."""
    late, _ = session(FIRST_SEED, M(late_s=0.05))
    assert search_of(late).model.delay_s == pytest.approx(0.05, abs=0.002)
    scaled, _ = session(FIRST_SEED, M(square_scale=1.05))
    found = search_of(scaled)
    assert found.model.scale == pytest.approx(1.05, abs=0.002)
    assert "26.2" in diagnose(scaled)[0].evidence
    [step] = found.of(causes.SCALE)
    assert step.before is found.start
    assert causes.SCALE not in [rival.cause for rival in step.rivals]
    zero, truth = session(FIRST_SEED, M(joint_offset_deg=2.0))
    offsets = np.degrees(search_of(zero).model.offsets)
    assert truth.joint is not None
    # read = true + offset: what has to be added to the readings is its negative
    assert offsets[truth.joint] == pytest.approx(-2.0, abs=0.1)
    assert np.abs(np.delete(offsets, truth.joint)).max() == 0.0
    slipped, truth = session(FIRST_SEED, M(slip_m=0.01, slip_deg=1.5))
    [slip] = search_of(slipped).accepted
    assert slip.test.at == truth.slipped_at
    assert causes.turn_and_shift(slip.test)[1] == pytest.approx(0.01, abs=5e-4)
    odd, truth = session(FIRST_SEED, M(outliers=2))
    found = search_of(odd)
    views = [step.before.fit.pairs.view[step.test.at] for step in found.accepted]
    assert sorted(views) == list(truth.outliers)
    assert found.model.odd == 2


def search_of(given: HandEyeSession) -> CauseSearch[MendedPairs]:
    velocity = None
    if given.dq is not None:
        velocity = (widowx().jacobian(given.q) @ given.dq[..., None])[..., 0]
    model = MendedPairs(widowx(), given.q, velocity, PosePairs.of(given).fit)
    return search(model, causes.PAIRS_LEVEL)


def test_two_mistakes_are_both_named() -> None:
    both, _ = session(FIRST_SEED, M(millimetres="arm", square_scale=1.05))
    assert diagnose(both).names == ("millimetres", "wrong_square_size")
    both, _ = session(FIRST_SEED + 2, M(shifted_by=1, outliers=1))
    assert diagnose(both).names == ("off_by_one", "outlier_pose")


CANDIDATES = ("inverted_poses", "inverted_detections", "wrong_mount")


@pytest.mark.parametrize(("seed", "kind"), list(enumerate(CANDIDATES, start=FIRST_SEED)))
def test_candidates_are_listed_and_the_true_one_has_the_true_X(seed: int, kind: str) -> None:
    given, truth = session(seed, M(**{kind: True}), arm_errors=None)
    [finding] = diagnose(given)
    words = dict(zip(CANDIDATES, ("arm poses", "board poses", "another mount"), strict=True))
    for number, name in enumerate(words.values(), 1):
        assert f"({number}) {name}" in finding.evidence
    inverted = invert_transform(given.T_base_gripper)
    fit = replace(PosePairs.of(given), T_base_gripper=inverted).fit
    options = misread.candidates(fit, given, "inverted")
    [mine] = [option for option in options if option.name.startswith(words[kind])]
    assert mine.mount == truth.setup.mount
    assert not mine.against
    off = pose_difference(truth.X, mine.X)
    assert np.abs(off[3:]).max() < 5e-4
    assert np.abs(off[:3]).max() < np.radians(0.1)


def test_two_inversions_that_cancel_are_named_by_what_they_imply() -> None:
    given, truth = session(FIRST_SEED, M(inverted_poses=True, inverted_detections=True))
    assert PosePairs.of(given).fit.shift_m < 0.005  # the equation is obeyed
    [finding] = diagnose(given)
    assert finding.name == "inconsistent_convention"
    assert "arm poses and board poses both inverted" in finding.evidence
    assert truth.setup.mount == "eye_in_hand"


ALL_WAYS = [(order, way) for order in ("xyz", "XYZ", "zyx") for way in ("degrees", "radians")]


# Angles about fixed axes in the order zyx are those about the body's own in the order XYZ.
@pytest.mark.parametrize(("order", "way"), ALL_WAYS if NIGHTLY else ALL_WAYS[::5])
def test_euler_angles_in_the_wrong_unit(order: str, way: str) -> None:
    given, _ = session(FIRST_SEED + 1, M())
    T = given.T_base_gripper.copy()
    angles = Rotation.from_matrix(T[:, :3, :3]).as_euler(order)
    factor = np.degrees(1.0) if way == "degrees" else np.radians(1.0)
    T[:, :3, :3] = Rotation.from_euler(order, factor * angles).as_matrix()
    assert diagnose(replace(given, T_base_gripper=T, q=None)).names == ("degrees",)


def test_quaternion_order_is_named() -> None:
    given, _ = session(FIRST_SEED, M())
    T = given.T_base_gripper.copy()
    quaternions = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    T[:, :3, :3] = Rotation.from_quat(quaternions[:, [3, 0, 1, 2]]).as_matrix()
    [finding] = diagnose(replace(given, T_base_gripper=T, q=None))
    assert finding.name == "inconsistent_convention"
    assert "quaternions (w, x, y, z) read as" in finding.evidence


# --- what it takes and says ---


def test_poses_do_as_well_as_detections() -> None:
    given, _ = session(FIRST_SEED, M(square_scale=1.05))
    findings = diagnose(HandEyeSession(given.mount, given.T_base_gripper, given.T_camera_board))
    assert findings.names == ("wrong_square_size",)
    assert any("joint angles" in reason for reason in findings.not_tested)


def test_what_cannot_be_tested_is_said() -> None:
    still, _ = session(FIRST_SEED, M())
    assert any("late time stamps" in reason for reason in diagnose(still).not_tested)
    moving, _ = session(FIRST_SEED, M(moving=True))
    assert diagnose(moving).not_tested == ()
    grid, _ = session(FIRST_SEED, M(design="grid"))
    assert any("leave X free" in reason for reason in diagnose(grid).not_tested)
    few = still.pick(range(5))
    assert diagnose(few).names == ()
    assert any("6 pairs or more" in reason for reason in diagnose(few).not_tested)


def test_two_pairs_are_too_few() -> None:
    given, _ = session(FIRST_SEED, M())
    with pytest.raises(ValueError, match="session: got 2, want at least 3 pairs"):
        diagnose(given.pick([0, 1]))


def test_velocities_come_from_the_times_of_small_steps() -> None:
    """A video of a moving arm: no joint velocities, ten images a second, poses 50 ms late."""
    arm = widowx()
    times = 0.1 * np.arange(60)
    swing = np.array([0.5, 0.15, 0.15, 0.5, 0.5, 0.7]) * np.sin(
        np.outer(times, [0.9, 1.1, 1.3, 0.8, 1.2, 1.0]))  # fmt: skip
    q = np.array([0.0, 1.2, 1.0, 0.2, 0.0, 0.0]) + swing
    shifted = np.array([np.interp(times + 0.05, times, column) for column in q.T]).T
    X, Y = arm.T_gripper_camera, make_transform(np.diag([1.0, -1.0, -1.0]), [0.35, 0.0, 0.0])
    seen = invert_transform(X) @ invert_transform(arm.forward(q)) @ Y
    rng = np.random.default_rng(0)
    seen[:, :3, 3] += 2e-4 * rng.normal(size=(60, 3))
    video = HandEyeSession("eye_in_hand", arm.forward(shifted), seen, times=times)
    [finding] = diagnose(video)
    assert finding.name == "late_time_stamps"
    delay = float(finding.evidence.split()[0])
    assert delay == pytest.approx(50, abs=4)
