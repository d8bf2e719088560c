"""Search for the poses of sessions that cannot work: what data/degenerate_poses.json holds.

A grid of translations at one orientation, turns about one axis only, turns of a few degrees: what
people do who do not know that a hand-eye calibration needs wide turns about two axes. In each set
the board is in view and the arm is allowed; `coursekit.simulation.arm_poses` reads what is kept.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arrays import ArrayLike, Bools, Floats
from coursekit.geometry import deproject, project
from coursekit.hand_eye.poses import MOUNTS, base_gripper
from coursekit.simulation.arm_poses import DEGENERATE, Setup, random_poses
from coursekit.simulation.arm_sessions import default_setup

ATTEMPTS = 6  # places in the image and ranges that are tried for each pose of a set
ASIDE, NEARER = 0.12, 0.15  # how much these differ: of the image's size, and of the range
POSES, VARIANTS = 25, 4


def store() -> None:
    """data/degenerate_poses.json: four sets of 25 poses of each design, for either mount."""
    sets = {
        mount: {
            name: [
                search(default_setup(mount), np.random.default_rng([variant, 1])).tolist()
                for variant in range(VARIANTS)
            ]
            for name, search in DESIGNS.items()
        }
        for mount in MOUNTS
    }
    text = json.dumps(sets).replace("], [", "],\n[")  # one configuration a line
    DEGENERATE.write_text(text + "\n", encoding="utf-8")


def translation_grid(
    setup: Setup, rng: np.random.Generator, side: int = 5, step_m: float = 0.025
) -> Floats:
    """Joint configurations (side^2, 6), rad: a horizontal grid of positions at one orientation.

    Raises ValueError when no orientation has the whole grid in reach and the board in view.
    """
    offsets = step_m * (np.arange(side) - (side - 1) / 2)
    steps = np.stack([*np.meshgrid(offsets, offsets, indexing="ij"), np.zeros((side, side))], -1)
    for start in np.concatenate([_starts(setup, rng) for _ in range(2)]):
        targets = np.repeat(_aimed(setup, setup.arm.forward(start)[None]), side * side, axis=0)
        targets[:, :3, 3] += steps.reshape(-1, 3)
        q, good = _reach(setup, targets, start)
        if good.all():
            return q
    raise ValueError(
        f"side, step_m: no {side}x{side} grid of {1e3 * step_m:.0f} mm steps is in reach with the "
        "board in view"
    )


def single_axis_poses(setup: Setup, rng: np.random.Generator, n: int = POSES) -> Floats:
    """Joint configurations (n, 6), rad, all turned about the vertical from one orientation.

    The angles are spread evenly over 30 degrees to either side; the positions differ too. Raises
    ValueError when no start has them all in reach and in view.
    """
    turn_rad, axis = np.radians(30), np.array([0.0, 0.0, 1.0])
    angles = np.linspace(-turn_rad, turn_rad, n)
    # The start need not be in the middle of the turns, nor the board upright in all of them.
    shifts = turn_rad * np.array([0.0, 0.5, -0.5, 1.0, -1.0])
    free = replace(setup, turn_rad=np.pi)
    starts = _starts(setup, rng)
    return _turned(free, rng, starts, angles[:, None] * axis, shifts[:, None] * axis)


def small_rotations(setup: Setup, rng: np.random.Generator, n: int = POSES) -> Floats:
    """Joint configurations (n, 6), rad, about all axes but by no more than 3 degrees from one.

    The positions differ too. Raises ValueError as `single_axis_poses` does.
    """
    vectors = rng.normal(size=(n, 3))
    length = np.radians(3) * np.cbrt(rng.random((n, 1)))  # even over the ball
    vectors = length * vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return _turned(setup, rng, _starts(setup, rng), vectors, np.zeros((1, 3)))


def _turned(
    setup: Setup, rng: np.random.Generator, starts: Floats, vectors: Floats, shifts: Floats
) -> Floats:
    """Joint configurations (n, 6) with orientations exp(vectors) exp(shift) of a start's."""
    turns = Rotation.from_rotvec(vectors).as_matrix()
    for start in starts:
        for shift in Rotation.from_rotvec(shifts).as_matrix():
            targets = np.repeat(setup.arm.forward(start)[None], len(turns), axis=0)
            targets[:, :3, :3] = turns @ (shift @ targets[0, :3, :3])
            _, good = _reach(setup, _aimed(setup, targets[[0, -1]]), start)
            if not good.all():  # the outermost two decide mostly, and cheaply
                continue
            q = _scattered(setup, rng, start, targets)
            if q is not None:
                return q
    raise ValueError("turn_rad: no such poses are in reach with the board in view")


def _scattered(
    setup: Setup, rng: np.random.Generator, start: Floats, targets: Floats
) -> Floats | None:
    """Configurations (n, 6) for the orientations of targets, places differing, if all exist."""
    q, missing = np.empty((len(targets), 6)), np.arange(len(targets))
    for attempt in range(ATTEMPTS):
        width = 1 - attempt / ATTEMPTS  # ask for less as it goes on
        aside = width * rng.uniform(-ASIDE, ASIDE, (len(missing), 2))
        nearness = 1 + width * rng.uniform(-NEARER, NEARER, len(missing))
        aimed = _aimed(setup, targets[missing], aside, nearness)
        found, good = _reach(setup, aimed, start, elsewhere=True)
        q[missing[good]] = found[good]
        missing = missing[~good]
        if not missing.size:
            return q
    return None


def _aimed(
    setup: Setup, T_base_gripper: Floats, aside: ArrayLike = (0.0, 0.0), nearness: ArrayLike = 1.0
) -> Floats:
    """Gripper poses (n, 4, 4) of the same orientations with the board's middle at a chosen pixel.

    aside (n, 2): from the image's middle, or with a fixed camera from where the first pose has
    it, as parts of width and height. nearness (n,): times the range that the first pose has.
    """
    lens = setup.intrinsics
    T = setup.T_camera_board(T_base_gripper)
    first = T[0, :3, :3] @ setup.board.middle + T[0, :3, 3]
    # a camera on the arm can look anywhere; in front of a fixed one the arm's reach comes first
    on_arm = setup.mount == "eye_in_hand"
    around = 0.5 * np.array(lens.size) - 0.5 if on_arm else project(first, lens.K, lens.dist)
    pixels = around + np.asarray(aside) * lens.size
    wanted = deproject(pixels, first[2] * np.asarray(nearness), lens.K, lens.dist)
    T[:, :3, 3] = wanted - T[:, :3, :3] @ setup.board.middle
    return base_gripper(T, setup.X, setup.Y, setup.mount)


def _starts(setup: Setup, rng: np.random.Generator) -> Floats:
    """Configurations (60, 6) to begin from: straight on and far from the joints' limits first."""
    q = random_poses(setup, rng, 60)
    low, high = setup.arm.limits.T
    room = np.minimum(q - low, high - q).min(axis=1)
    T = setup.T_camera_board(setup.arm.forward(q))
    return q[np.argsort(-room - setup.upright(T) / 2)]


def _reach(
    setup: Setup, targets: Floats, start: Floats, elsewhere: bool = False
) -> tuple[Floats, Bools]:
    """Joint configurations (n, 6) for gripper poses, and whether each is found and allowed.

    elsewhere: also try to get there by configurations that are far from `start`.
    """
    q, good = np.tile(start, (len(targets), 1)), setup.sees(targets)
    q[good], reached = setup.arm.inverse(targets[good], start, elsewhere)
    good[good] = reached & setup.allows(q[good])
    return q, good


DESIGNS: dict[str, Callable[[Setup, np.random.Generator], Floats]] = {
    "grid": translation_grid,
    "single_axis": single_axis_poses,
    "small_rotations": small_rotations,
}
