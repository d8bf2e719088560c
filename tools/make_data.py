"""Remake the computed files in data/: `.venv/bin/python -m tools.make_data [NAME ...]`."""

from __future__ import annotations

import io
import json
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import nbformat
import numpy as np

import coursekit as ck
from coursekit.boards import Board
from coursekit.boards.board import seen
from coursekit.boards.detector import SESSION
from coursekit.budget.handover import REFERENCE
from coursekit.cameras.capture import session_card
from coursekit.cameras.simulated import SimulatedCamera
from coursekit.hand_eye.poses import MOUNTS
from coursekit.intrinsics import diagnose
from coursekit.intrinsics.diagnosis import POWER_FILE
from coursekit.results import Quantity, write_bytes, write_json
from coursekit.simulation.arm_sessions import session_folder
from coursekit.simulation.corner_sessions import Effects, corner_session, view_poses
from coursekit.specifications import DATA
from coursekit.submission.format import Conclusion, Stack, Submission, bundle_bytes
from coursekit.submission.submit import measured
from tools import build_notebooks, degenerate_poses

BOARD = Board("charuco", (9, 6), 0.025)
SEED, VIEWS = 7, 26
POSES_SEED = 3  # of these corners reach all four corners of the image
NEAREST_M, FARTHEST_M = 0.30, 0.70  # of the board's middle
FEWEST_CORNERS, BORDER_PX = 22, 15.0
ORIGIN = (
    "Rendered by tools/make_data.py: the colour camera of the simulated camera of this device and "
    "seed looks at the board from random places, as a hand would hold it. No real camera took it."
)

HAND_EYE_SEED = 1  # names the arm too: one arm carries both cameras


def readme_picture() -> None:
    """data/readme.png: what the simulated camera sees."""
    with ck.open_camera("simulated") as camera:
        picture = ck.plots.pinhole.frame(camera.frame())
    (DATA / "readme.png").write_bytes(picture.png())


def intrinsics_session() -> None:
    """data/intrinsics_session/: views of a board for notebook 03, and what they are."""
    folder = DATA / "intrinsics_session"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for number, image in enumerate(session_views()):
        write_bytes(folder / f"view_{number:02d}.jpg", image)
    card = session_card(SimulatedCamera(seed=SEED), BOARD) | {"seed": SEED, "origin": ORIGIN}
    write_bytes(folder / SESSION, (json.dumps(card, indent=1) + "\n").encode())


def session_views() -> Iterator[bytes]:
    """The session's images as JPEG, one after the other: the same bytes each time."""
    camera = SimulatedCamera(seed=SEED)
    lens, made = camera.color, 0
    assert lens is not None
    for T in view_poses(BOARD, lens, np.random.default_rng(POSES_SEED), 4 * VIEWS, Effects()):
        if made < VIEWS and _is_fair(T, lens):
            made += 1
            camera.show_board(BOARD, T)
            yield _jpeg(camera.color_image()[..., 0])


def _is_fair(T_camera_board: np.ndarray, lens: ck.geometry.Intrinsics) -> bool:
    """Whether a student would keep the view: not too far, and enough of the board in the image."""
    distance_m = ck.geometry.transform_points(T_camera_board, BOARD.middle)[2]
    near = NEAREST_M <= distance_m <= FARTHEST_M
    return bool(
        near and seen(BOARD.points, T_camera_board, lens, BORDER_PX).sum() >= FEWEST_CORNERS
    )


def _jpeg(image: np.ndarray, quality: int = 95) -> bytes:
    # Optimised and progressive: the same pixels in a tenth less space.
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    options += [cv2.IMWRITE_JPEG_OPTIMIZE, 1, cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    return cv2.imencode(".jpg", image, options)[1].tobytes()


POWER_SEEDS = range(5000, 5100)  # neither those of development nor those of the tests
POWER_SIZES = {  # the unit, the effect of so many of it, how many
    "bowed_board": (
        "mm",
        lambda size: Effects(bow_m=size / 1e3),
        (0.05, 0.08, 0.1, 0.12, 0.15, 0.2, 0.3),
    ),
    "focus_drift": (
        "%",
        lambda size: Effects(focus_drift=size / 1e2),
        (0.3, 0.5, 0.8, 1.0, 1.3, 1.6, 2.0),
    ),
    "rolling_shutter": (
        "m/s at 20 ms",
        lambda size: Effects(readout_s=0.02, speed_m_s=size),
        (0.01, 0.02, 0.03, 0.04, 0.06, 0.1),
    ),
}


def diagnosis_power() -> None:
    """data/diagnosis_power.json: in how many simulated sessions a cause of some size is named."""
    causes = {}
    for cause, (unit, _, sizes) in POWER_SIZES.items():
        named = [times_named(cause, size) for size in sizes]
        causes[cause] = {"unit": unit, "sizes": sizes, "named": named, "sessions": len(POWER_SEEDS)}
    origin = (
        "Measured by tools/make_data.py: sessions of 28 views simulated at the corners, 0.08 px of "
        "noise, the course's ChArUco board, the factory lens of the simulated D435's colour camera."
    )
    write_json(POWER_FILE, {"origin": origin, "causes": causes})


def times_named(cause: str, size: float, seeds: Sequence[int] = POWER_SEEDS) -> int:
    """In how many of the sessions with these seeds `diagnose` names a cause of this size.

    Each size gets the same seeds, and so the same poses and noise; about 0.2 s a session.
    """
    lens = ck.specifications.device("D435").unit.color
    effects = POWER_SIZES[cause][1](size)
    sessions = (corner_session(BOARD, lens, seed, effects=effects)[0] for seed in seeds)
    return sum(cause in diagnose(session, BOARD).names for session in sessions)


def hand_eye_sessions() -> None:
    """data/hand_eye_in_hand/, data/hand_eye_to_hand/: the sessions of notebook 04, without X."""
    for mount in MOUNTS:
        shutil.rmtree(DATA / f"hand_{mount}", ignore_errors=True)
        made = session_folder(mount, HAND_EYE_SEED, DATA)
        made.rename(DATA / f"hand_{mount}")


SAMPLES = DATA / "sample_bundles"
SAMPLE_MADE = "2026-03-02T10:00:00+00:00"
SAMPLE_PX = 20  # a side of the windows: small files
SAMPLE_WORDS = (
    "I will mount the camera at 0.45 m and can average ten frames there. What repeats in every "
    "frame is then larger than what is left of the noise, so a calibration helps and more frames "
    "do not."
)


def reference_results() -> None:
    """data/reference_results/: what notebooks 1 to 4 find on the simulated camera and arm."""
    with tempfile.TemporaryDirectory() as scratch:
        environment = build_notebooks.kernel_environment(Path(scratch))
        for path in build_notebooks.find([])[:4]:
            notebook = nbformat.read(path, as_version=4)
            build_notebooks.execute(notebook, path.stem, path.parent, environment)
            result = Path(scratch) / "results" / f"{path.stem}.json"
            write_bytes(REFERENCE / result.name, result.read_bytes())


def sample_bundles() -> None:
    """data/sample_bundles/: what students hand in, for tests and for a first try of the grader."""
    shutil.rmtree(SAMPLES, ignore_errors=True)
    ada, cleo = _finished("Ada Honest", 21), _finished("Cleo Wrong", 23)
    for name, submission in (
        ("ada_good", ada),
        ("ben_weak", _weak(_finished("Ben Weak", 22))),
        ("cleo_wrong", _wrong(cleo)),
        ("dan_copied", _copied(ada, "Dan Copied")),
        ("eve_formula", replace(ada, student='=HYPERLINK("x")<script>alert(1)</script>')),
    ):
        write_bytes(SAMPLES / f"{name}.zip", bundle_bytes(submission))
    whole = bundle_bytes(ada)
    write_bytes(SAMPLES / "hostile_truncated.zip", whole[: len(whole) // 2])
    write_bytes(SAMPLES / "hostile_bomb.zip", _zip({"depth_0.npy": bytes(30_000_000)}))
    write_bytes(SAMPLES / "hostile_path.zip", _zip({"../../outside.json": b"{}"}))
    write_bytes(SAMPLES / "not_a_bundle.zip", b"My camera broke, sorry.\n")


def _finished(student: str, seed: int) -> Submission:
    """What an honest student hands in: the block at three distances before a simulated unit."""
    camera = SimulatedCamera(seed=seed)
    camera.set(depth_scale_m=0.0001)
    stacks = []
    for distance_m in (0.30, 0.45, 0.60):
        camera.place("60 mm block", distance_m)
        frames = camera.frames(100, progress=False)
        left, top, width, height = ck.stereo.block_face(frames).window
        left, top = left + (width - SAMPLE_PX) // 2, top + (height - SAMPLE_PX) // 2
        window = (left, top, SAMPLE_PX, SAMPLE_PX)
        stacks.append(ck.submission.stack(frames, window, distance_m))
    found, law, own = _table(camera, stacks)
    predicted_mm = 1000 * law.std_m([stack.distance_m for stack in stacks])[0]
    whole = measured(camera, stacks, found, law, predicted_mm.tolist(), 0.0, 0.060, own)
    return replace(
        whole,
        claims=replace(whole.claims, mismatches="left out"),
        student=student,
        made=SAMPLE_MADE,
        versions={"coursekit": "0.1.0"},
        conclusion=Conclusion(0.45, 10, "bias", SAMPLE_WORDS),
    )


def _table(
    camera: ck.cameras.Camera, stacks: Sequence[Stack]
) -> tuple[dict[str, Quantity], ck.stereo.NoiseFit, dict[float, Any]]:
    """What notebook 02 measures, its fit, and a student's own table of the same."""
    found, own, seen = {}, {}, []
    for stack in stacks:
        window = (0, 0, SAMPLE_PX, SAMPLE_PX)
        stats = ck.stereo.window_stats(stack.counts, window, camera.depth_scale_m)
        seen.append(stats)
        at = f"at_{1000 * stack.distance_m:.0f}_mm"
        bias_mm = 1000 * (stats.depth_m - stack.distance_m)
        std_mm, std_se_mm = 1000 * stats.pixel_std_m, 1000 * stats.pixel_std_error_m
        found[f"depth_std_{at}"] = Quantity(std_mm, "mm", std_se_mm, "noise")
        errors = 1000 * stats.depth_error_m, std_se_mm
        own[stack.distance_m] = (bias_mm, errors[0], std_mm, errors[1], stats.invalid_fraction)
    law = ck.stereo.fit_noise(
        [stack.distance_m for stack in stacks],
        [stats.pixel_std_m for stats in seen],
        [stats.pixel_dof for stats in seen],
        camera.depth.fx,
        camera.baseline_m,
        camera.depth_scale_m,
        exponent=2,
    )
    return found, law, own


def _weak(whole: Submission) -> Submission:
    """Too few frames at one distance, a standard error left out, no paragraph."""
    *others, last = whole.stacks
    short = replace(last, counts=last.counts[:84], times_s=last.times_s[:84])
    first, *rest = whole.claims.rows
    rows = (replace(first, depth_bias_se_mm=None), *rest)
    return replace(
        whole,
        stacks=(*others, short),
        claims=replace(whole.claims, rows=rows),
        conclusion=replace(whole.conclusion, paragraph=""),
    )


def _wrong(whole: Submission) -> Submission:
    """Biases with the sign turned, a standard error for a std, noise said to dominate."""
    rows = tuple(
        replace(row, depth_bias_mm=-row.depth_bias_mm, depth_std_mm=row.depth_std_mm / 10)
        for row in whole.claims.rows
        if row.depth_bias_mm is not None and row.depth_std_mm is not None
    )
    conclusion = replace(whole.conclusion, dominates="noise")
    return replace(whole, claims=replace(whole.claims, rows=rows), conclusion=conclusion)


def _copied(whole: Submission, student: str) -> Submission:
    """The raw depths of somebody else with a count added or taken away at random."""
    rng = np.random.default_rng(1)
    stacks = []
    for stack in whole.stacks:
        off = rng.integers(-1, 2, stack.counts.shape)
        counts = np.where(stack.counts > 0, stack.counts + off, 0).astype(np.uint16)
        stacks.append(replace(stack, counts=counts))
    return replace(whole, student=student, stacks=tuple(stacks))


def _zip(members: dict[str, bytes]) -> bytes:
    """A zip with these members, of whatever names and sizes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def vendor_models() -> None:
    """What librealsense does with each distortion model, measured here."""
    note = f"coursekit.cameras.conventions, pyrealsense2 {version('pyrealsense2')}"
    rows = [asdict(row) for row in ck.cameras.conventions.measure()]
    rows = [{k: v for k, v in row.items() if v is not None} for row in rows]
    write_json(DATA / "vendor_models.json", {"source": note, "rows": rows})


MAKERS = {
    "vendor_models.json": vendor_models,
    "readme.png": readme_picture,
    "intrinsics_session": intrinsics_session,
    "diagnosis_power.json": diagnosis_power,
    "degenerate_poses.json": degenerate_poses.store,
    "hand_eye_sessions": hand_eye_sessions,
    "reference_results": reference_results,  # of the sessions, so after them
    "sample_bundles": sample_bundles,
}


if __name__ == "__main__":
    names = sys.argv[1:] or list(MAKERS)
    if unknown := [name for name in names if name not in MAKERS]:
        sys.exit(f"there is no {unknown[0]!r}; there are {', '.join(MAKERS)}")
    for name in names:
        print(f"data/{name} ...", flush=True)
        MAKERS[name]()
