"""Whole sessions, rendered and matched, against the truth that the simulated camera hides."""

from __future__ import annotations

import os

import numpy as np
import pytest

from coursekit import stereo
from coursekit.cameras.simulated import SimulatedCamera

NIGHTLY = os.environ.get("COURSEKIT_NIGHTLY") == "1"
DISTANCES = (0.30, 0.45, 0.60)
CALIPER_M, TAPE_M, TAPE_ZERO_M = 0.060, 0.001, 0.002


def session(seed: int, frames: int) -> tuple[stereo.BiasFit, SimulatedCamera]:
    """The studio exercise by somebody with a tape that reads 1 mm wrong now and then."""
    camera = SimulatedCamera(seed=seed, depth_scale_m=0.0001)
    tape = np.random.default_rng([seed, 1])
    zero_m = tape.normal(0, TAPE_ZERO_M)
    faces = []
    for distance in DISTANCES:
        camera.place("60 mm block", distance)
        shots = camera.frames(frames, progress=False)
        faces.append(stereo.block_face(shots, width_m=CALIPER_M))
    read = [z - zero_m + tape.normal(0, TAPE_M) for z in DISTANCES]
    fit = stereo.fit_bias(
        read, camera.depth.fx, camera.baseline_m,
        [f.depth_m for f in faces], [f.depth_error_m for f in faces],
        [f.width_m for f in faces], [f.width_error_m for f in faces],
        CALIPER_M, TAPE_M, stereo.BiasPriors(tape_zero_m=TAPE_ZERO_M, drift_px=0.02),
    )  # fmt: skip
    return fit, camera


@pytest.mark.parametrize("seeds", [range(1000, 1020) if NIGHTLY else range(1000, 1003)])
def test_the_intervals_of_rendered_sessions_hold_the_hidden_truth(seeds: range) -> None:
    """At least 17 of 20 intervals of each value (nightly); all but one of three otherwise."""
    held = {"scale error": 0, "disparity offset": 0}
    for seed in seeds:
        fit, camera = session(seed, frames=25 if NIGHTLY else 8)
        truth = camera.reveal()
        low, high = fit.scale_error_interval
        held["scale error"] += low <= truth.scale_error <= high
        low, high = fit.interval("disparity_offset_px")
        held["disparity offset"] += low <= truth.disparity_offset_px <= high
    print(held)
    assert min(held.values()) >= (17 if NIGHTLY else 2)
