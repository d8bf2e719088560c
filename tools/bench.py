"""`python3 course.py bench`: every speed this project claims, as ratios measured in one run.

Absolute times depend on the machine and the minute; two things timed in turn, many times over,
give a ratio that means something. Medians are printed, with the quartiles behind them.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from coursekit import (
    boards,
    budget,
    geometry,
    intrinsics,
    simulation,
    specifications,
    stereo,
)
from coursekit.cameras.librealsense import LibraryMissing, load_librealsense
from coursekit.geometry import Intrinsics
from coursekit.simulation.arm_sessions import hand_eye_session
from coursekit.simulation.corner_sessions import corner_session
from coursekit.submission.batch import grade_folder
from coursekit.submission.format import Stack, Submission, bundle_bytes, read_bundle
from coursekit.submission.report import grade_file

ROUNDS = 300
CAMERA = Intrinsics(848, 480, 431.1, 431.1, 436.6, 242.4)


@dataclass(frozen=True)
class Row:
    """One comparison: the times in s of ours and of the yardstick, taken in turn."""

    what: str
    against: str
    times: tuple[list[float], list[float]]
    wanted: str = ""

    def __str__(self) -> str:
        ours, theirs = self.times
        return (
            f"{self.what:26} {_time(ours)}   {self.against:24} {_time(theirs)}"
            f"   ratio {np.median(ours) / np.median(theirs):5.2f}  {self.wanted}"
        )


def _time(seconds: list[float]) -> str:
    low, middle, high = 1000 * np.quantile(seconds, [0.25, 0.5, 0.75])
    return f"{middle:8.3f} ms ({low:.3f}-{high:.3f})"


def in_turn(
    rounds: int, ours: Callable[[], object], theirs: Callable[[], object]
) -> tuple[list[float], list[float]]:
    """The times of two calls, made in turn, after three rounds that are not counted."""
    times: tuple[list[float], list[float]] = ([], [])
    for index in range(-3, rounds):
        for call, kept in zip((ours, theirs), times, strict=True):
            start = time.perf_counter()
            call()
            if index >= 0:
                kept.append(time.perf_counter() - start)
    return times


def depth_image() -> np.ndarray:
    """A depth image with a tenth of its pixels invalid, uint16 in mm."""
    rng = np.random.default_rng(0)
    depth = rng.integers(300, 2000, (480, 848)).astype(np.uint16)
    depth[rng.random(depth.shape) < 0.1] = 0
    return depth


def one_liner(depth: np.ndarray) -> np.ndarray:
    """What most people write."""
    z = np.where(depth > 0, depth * np.float32(0.001), np.float32(np.nan))
    v, u = np.indices(depth.shape, dtype=np.float32)
    return np.stack([(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z], axis=-1)


def bench_deproject() -> list[Row]:
    """A full frame to points: ours, librealsense's point cloud, the NumPy one-liner."""
    depth = depth_image()

    def ours() -> np.ndarray:
        return geometry.deproject_image(depth, CAMERA)

    name = "deproject_image, 848x480"
    try:
        vendor = vendor_point_cloud(depth)
    except LibraryMissing:
        print("pyrealsense2 is not installed: no comparison with librealsense")
        return [Row(name, "NumPy one-liner", in_turn(ROUNDS, ours, lambda: one_liner(depth)))]
    # In pairs: between two calls the one-liner's garbage would be in everybody's way.
    return [
        Row(name, "rs.pointcloud.calculate", in_turn(ROUNDS, ours, vendor), "wanted: at most 1.00"),
        Row(name, "NumPy one-liner", in_turn(ROUNDS, ours, lambda: one_liner(depth))),
    ]


def vendor_point_cloud(depth: np.ndarray) -> Callable[[], object]:
    """A call of `pyrealsense2.pointcloud.calculate` on the same image, in a frame of its own."""
    from coursekit.cameras.recording import realsense_intrinsics

    rs = load_librealsense()
    device = rs.software_device()
    sensor = device.add_sensor("depth")
    stream = rs.video_stream()
    stream.type, stream.fmt, stream.bpp, stream.fps = rs.stream.depth, rs.format.z16, 2, 30
    stream.width, stream.height = CAMERA.size
    stream.intrinsics = realsense_intrinsics(rs, CAMERA)
    profile = sensor.add_video_stream(stream)
    sensor.add_read_only_option(rs.option.depth_units, 0.001)
    queue = rs.frame_queue(1)
    sensor.open(profile)
    sensor.start(queue)
    image = rs.software_video_frame()
    image.pixels, image.stride, image.bpp = depth, 2 * CAMERA.width, 2
    image.timestamp, image.frame_number = 0.0, 1
    image.profile = profile.as_video_stream_profile()
    image.depth_units = 0.001
    sensor.on_video_frame(image)
    frame = queue.wait_for_frame().as_depth_frame()
    cloud = rs.pointcloud()

    def calculate(keep: tuple[object, ...] = (device, sensor, queue)) -> object:
        return cloud.calculate(frame)

    check_agreement(calculate(), geometry.deproject_image(depth, CAMERA))
    return calculate


def check_agreement(theirs: object, ours: np.ndarray) -> None:
    """Both must have computed the same thing, or the ratio would mean nothing."""
    vertices = np.asarray(theirs.get_vertices()).view(np.float32)  # type: ignore[attr-defined]
    difference = np.abs(vertices.reshape(ours.shape) - ours)[np.isfinite(ours)]
    if difference.max() > 1e-5:
        raise RuntimeError(f"the point clouds differ by {difference.max():.2e} m")


def bench_stereo() -> list[Row]:
    """A simulated frame from photons to z16, its matching against OpenCV's, and the first frame."""
    unit = specifications.device("D435").unit
    view = simulation.Rig(unit.depth, unit.baseline_m).look_at(simulation.tabletop())
    rng = np.random.default_rng(0)
    left, right = view.images(rng)
    block = cv2.StereoBM.create(128, 11)  # as it comes: no uniqueness or left-right gate to pay for

    def frame() -> np.ndarray:
        return view.depth(view.frame(rng))

    def ours() -> np.ndarray:
        return simulation.match(left, right)

    def theirs() -> object:
        return block.compute(left, right)

    whole = in_turn(100, frame, ours)
    rate = 1 / np.median(whole[0])
    open_and_shoot = "import coursekit as ck; ck.open_camera('simulated').frame()"
    first = in_turn(5, python(open_and_shoot), python("import coursekit"))
    seconds = np.median(first[0]) - np.median(first[1])
    return [
        Row("simulated frame", "match() alone", whole, f"{rate:.0f} frames/s, wanted: at least 30"),
        Row("match(), 11x11, 127", "cv2.StereoBM, 11, 128", in_turn(100, ours, theirs),
            "wanted: at most 1.00"),
        Row("open_camera to first frame", "import coursekit", first,
            f"{seconds:.1f} s, wanted: below 5"),
    ]  # fmt: skip


def bench_intrinsics() -> list[Row]:
    """A calibration of 30 views against OpenCV alone, and all uncertainty that follows from it."""
    board = boards.Board("charuco", (9, 6), 0.025)
    lens = Intrinsics(640, 480, 612.0, 610.0, 322.0, 238.0, "brown_conrady", (0.08, -0.18, 0, 0, 0))
    detections, _ = corner_session(board, lens, seed=0, views=30)
    points = [board.points[view.ids].astype(np.float32) for view in detections]
    pixels = [view.pixels.astype(np.float32) for view in detections]
    cv2.setNumThreads(1)  # as calibrate does, so that neither has more

    def ours() -> intrinsics.IntrinsicsResult:
        return intrinsics.calibrate(detections, board)

    def bare() -> object:
        return cv2.calibrateCameraExtended(points, pixels, lens.size, None, None)  # type: ignore[call-overload]

    def with_uncertainty() -> object:
        result = ours()
        return result.covariance, result.uncertainty_map(0.45, (30, 40))

    whole = in_turn(30, with_uncertainty, ours)
    seconds = np.median(whole[0]) - np.median(whole[1])
    return [
        Row("calibrate(), 30 views", "calibrateCameraExtended", in_turn(30, ours, bare),
            "wanted: at most 1.50"),
        Row("  with covariance and map", "calibrate() alone", whole,
            f"{1000 * seconds:+.1f} ms, wanted: below +2000"),
    ]  # fmt: skip


def bench_hand_eye() -> list[Row]:
    """X refined on reprojection errors, with its covariance, against one of OpenCV's solvers."""
    session, _ = hand_eye_session("eye_in_hand", seed=0)
    poses = replace(session, seen=session.T_camera_board)

    def refined() -> object:
        return replace(session).solve()  # a new session: it keeps its board poses

    def park() -> object:
        return replace(poses).solve("park")

    times = in_turn(20, refined, park)
    seconds = f"{1000 * np.median(times[0]):.0f} ms, wanted: below 2000"
    return [Row(f"X refined, {len(session)} poses", "OpenCV's Park", times, seconds)]


def bench_budget() -> list[Row]:
    """A million samples of the whole chain, against drawing that many random numbers."""
    view = budget.lesson_view()
    twist = np.diag([1e-5] * 3 + [1e-6] * 3)
    covariances = budget.Covariances(np.eye(2), 7e-4, np.eye(4), hand_eye=twist, arm=twist)
    n = 1_000_000

    def samples() -> object:
        return budget.monte_carlo(budget.Chain(view), covariances, n, seed=0)

    def numbers() -> object:
        return np.random.default_rng(0).standard_normal((19, n))

    times = in_turn(5, samples, numbers)
    seconds = f"{np.median(times[0]):.2f} s, wanted: below 2"
    return [Row("Monte Carlo, 1e6 samples", "19e6 normal numbers", times, seconds)]


def bench_grading() -> list[Row]:
    """A bundle graded, with its page, against the statistics in it; and a folder of them."""
    whole = full_size_submission()
    data = bundle_bytes(whole)
    window, unit = (0, 0, 40, 40), whole.camera.depth_scale_m

    def statistics() -> object:
        return [stereo.window_stats(stack.counts, window, unit) for stack in whole.stacks]

    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch, "bundles")
        folder.mkdir()
        paths = [folder / f"{i:02d}.zip" for i in range(50)]
        for path in paths:
            path.write_bytes(data)

        def one() -> object:
            return grade_file(str(paths[0]), "00.zip")

        def graded_by(workers: int) -> object:
            out = Path(tempfile.mkdtemp(dir=scratch))
            return grade_folder(folder, out, workers, progress=False)

        batch = in_turn(3, lambda: graded_by(2), lambda: graded_by(1))
        return [
            Row("grade a bundle", "its window_stats() alone", in_turn(50, one, statistics)),
            Row("50 bundles, 2 processes", "one process", batch,
                f"{20 * np.median(batch[0]):.0f} s a thousand, wanted: below 60"),
        ]  # fmt: skip


def full_size_submission() -> Submission:
    """Three distances, 100 frames of 40 x 40 px each, of noise that neighbours share."""
    sample = read_bundle(specifications.DATA / "sample_bundles" / "ada_good.zip")
    rng = np.random.default_rng(0)
    stacks = []
    for stack in sample.stacks:
        noise = cv2.blur(rng.normal(0, 9, (40, 40, 100)), (9, 9)).transpose(2, 0, 1)
        z = stack.distance_m
        counts = np.rint(z / sample.camera.depth_scale_m + 30 * z**2 * noise).astype(np.uint16)
        stacks.append(Stack(z, (*stack.window[:2], 40, 40), counts, stack.times_s))
    return replace(sample, stacks=tuple(stacks))


def bench_import() -> Row:
    """`import coursekit` over a bare interpreter."""
    times = in_turn(15, python("import coursekit"), python("pass"))
    extra = 1000 * (np.median(times[0]) - np.median(times[1]))
    wanted = f"{extra:+.0f} ms, wanted: below +150"
    return Row("import coursekit", "bare interpreter", times, wanted)


def python(code: str) -> Callable[[], object]:
    """A call that runs code in an interpreter of its own."""
    command = [sys.executable, "-c", code]
    return lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def main() -> None:
    """Print one table."""
    print(f"{os.cpu_count()} cores, Python {sys.version.split()[0]}; medians (quartiles)")
    for row in [
        *bench_deproject(),
        *bench_stereo(),
        *bench_intrinsics(),
        *bench_hand_eye(),
        *bench_budget(),
        *bench_grading(),
        bench_import(),
    ]:
        print(row)


if __name__ == "__main__":
    main()
