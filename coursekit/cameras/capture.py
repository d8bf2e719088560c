"""Views of a calibration board, taken by themselves as soon as the board is held still.

`capture` is the whole of it: `guidance` says what a session still lacks and what the next view
should be, a live camera's frames (or the simulated camera, moved) give the views, an `Album` keeps
them, and a `Screen` shows a person what is seen and wanted. A careful session has corners all over
the image, boards tilted about both axes in both directions, near ones and far ones, all of them
sharp. What each of these buys is measured in notebook 03.
"""

from __future__ import annotations

import contextlib
import html
import json
import os
import zlib
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from coursekit import checks, results
from coursekit.arrays import Bools, Floats, Image
from coursekit.boards import Board, BoardNotFound, Detection, Detections, Skipped, detect
from coursekit.boards.board import FEWEST_CORNERS, seen, slide_into_view
from coursekit.boards.detector import SESSION
from coursekit.boards.find import find_corners
from coursekit.cameras.camera import Camera
from coursekit.cameras.frames import CameraError
from coursekit.cameras.simulated import SimulatedCamera
from coursekit.geometry import Intrinsics, make_transform, project
from coursekit.geometry import transform_points as through
from coursekit.words import say

FOLDER = "03_views"
STILL_FRAMES = 5  # over so many frames in a row ...
STILL_SIGMAS = 5.0  # ... the corners moved less than so many times what noise alone makes of them
STILL_LEAST_PX = 0.3  # nobody's hand is steadier
NOISE_PX = 0.1  # of a corner, where a detection does not say
NEW_SHARE = 0.04  # of the image's width: a view that is nearer to another one adds nothing
SHARPEST_BLURS = 1.3  # times the blur of the sharpest still view: this one is blurred, so wait
EXPLAINED_AFTER = 60  # frames in a row without a board
NO_BOARD = "There is no board in the image, or too little of it."
HAND_DEG, HAND_SHARE = 4.0, 0.03  # the simulated hand's std: of its angles, of distance and aim
HAND_TRIES, SEEN_SHARE = 20, 0.4  # it tries again until such a share of the corners is seen

CELLS = (8, 6)  # of the image, across and down
COVERED_SHARE = 0.9  # of the cells: a full session has corners in them
BORDER_WEIGHT = 2.0  # of a cell at the image's border, where distortion is largest
FLAT_DEG, TILTED_DEG = 10.0, 20.0
TILTED_VIEWS = 3  # that many are tilted by TILTED_DEG in each of four directions
DISTANCE_RATIO = 1.5  # of the farthest view's distance to the nearest one's
MEDIAN_BLURS = 1.5  # times the session's median blur: a blurred view

TILTS_DEG = (25.0, 40.0)  # of the views that are proposed; some are flat
ROLLS_DEG = (0.0, 12.0, -12.0)
FILLS = (0.80, 0.60, 0.45)  # of the image, by the board: near, middle, far
PLACES = (0.12, 0.5, 0.88)  # of the width and height: where the board's middle is aimed at
ROOM_PX = 10.0  # a corner nearer to the image's border is not counted on
PROPOSED_SHARE = 0.75  # of a ChArUco board's corners; a checkerboard must be seen whole

AWAY = ("right", "bottom right", "bottom", "bottom left", "left", "top left", "top", "top right")


# Okabe-Ito, in BGR
WANTED_COLOR, SEEN_COLOR, TAKEN_COLOR = (0, 159, 230), (115, 158, 0), (233, 180, 86)
LINE_PX = 2


def capture(
    camera: Camera,
    board: Board,
    views: int = 28,
    folder: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    timeout_s: float = 120.0,
) -> Detections:
    """Take views of a board for a calibration, and return what was seen in them.

    A live camera's exposure and focus are locked as far as it allows. Then a live image says what
    is still missing and what the next view should be, and a view is taken when the board is held
    still, is sharp, and is elsewhere than before. The simulated camera is moved instead: each view
    is the one that the guidance asks for, as a hand would hold it. A recording gives the views of
    a still board that it holds.

    Each view is saved at once as a grey PNG in `folder` (None: `results/03_views`), so Ctrl-C,
    which returns the views so far, and a camera that fails lose nothing: the views in the folder
    count when capture is called again, unless `overwrite` deletes them, and
    `boards.detect_all(folder, board)` finds the same corners. timeout_s: for the next view, on the
    camera's clock.
    Raises ValueError for bad arguments and for a folder with views of another camera or board, and
    CameraError when the camera fails, has no colour, or sees no new view in time.
    """
    checks.whole("views", views)
    checks.instance("board", board, Board)
    checks.positive("timeout_s", timeout_s, "a positive number of seconds")
    if camera.color is None:
        raise CameraError(f"the {camera.name} has no colour stream to calibrate")
    album = Album(results.folder() / FOLDER if folder is None else folder, camera, board, overwrite)
    before = len(album.views)
    if before < views:
        try:
            with _screen(board, camera.color, views) as screen:
                if isinstance(camera, SimulatedCamera):
                    shots = _moved(camera, camera.color, album, screen)
                else:
                    shots = _held(camera, camera.color, album, screen, timeout_s)
                with contextlib.closing(shots):
                    while len(album.views) < views and (shot := next(shots, None)):
                        album.add(shot)
        except KeyboardInterrupt:
            if not album.views:
                raise
        except CameraError as error:
            count, folder = len(album.views), album.folder
            kept = say("cameras.views_kept", error=error, count=count, folder=folder)
            raise CameraError(kept, error.frames) from error
    print(_summary(camera, album, views, before))
    return Detections(album.views, album.skipped)


class Shot(NamedTuple):
    """A view: its image (H, W), grey, and what is seen in it."""

    image: Image
    detection: Detection


def _summary(camera: Camera, album: Album, views: int, before: int) -> str:
    have, about = len(album.views), {"name": camera.name, "folder": album.folder.name}
    if have == before:
        return say("cameras.none_taken", before=before, **about)
    count = f"{have} views" if have >= views else f"{have} of {views} views"
    how = say("cameras.moved") if isinstance(camera, SimulatedCamera) else ""
    return say("cameras.taken", count=count, how=how, **about)


# --- where views come from ---


def _moved(
    camera: SimulatedCamera, lens: Intrinsics, album: Album, screen: Screen
) -> Generator[Shot, None, None]:
    """Views of the simulated camera, moved to where the guidance wants it."""
    board = album.board
    while True:
        wanted = guidance(album.views, board, lens)
        rng = np.random.default_rng([zlib.crc32(camera.serial.encode()), len(album.views)])
        for _ in range(HAND_TRIES):
            camera.show_board(board, _by_hand(wanted.target, board, rng))
            image = camera.color_image()[..., 0]
            detection = see(image, board)
            if detection is not None and len(detection) >= SEEN_SHARE * len(board.points):
                break
        else:
            tries = f"at any of {HAND_TRIES} tries"
            raise CameraError(f"the {camera.name} does not see the board {tries}")
        screen.show(Sight(image, detection, wanted, album.views))
        yield Shot(image, detection)


def _by_hand(T_camera_board: Floats, board: Board, rng: np.random.Generator) -> Floats:
    """A pose nearby: nobody holds a board exactly as asked."""
    at = through(T_camera_board, board.middle)
    turn = Rotation.from_rotvec(np.radians(HAND_DEG) * rng.standard_normal(3))
    R = turn.as_matrix() @ T_camera_board[:3, :3]
    at = at + HAND_SHARE * at[2] * rng.standard_normal(3)
    return make_transform(R, at - R @ board.middle)


def _held(
    camera: Camera, lens: Intrinsics, album: Album, screen: Screen, timeout_s: float
) -> Generator[Shot, None, None]:
    """Views of a board that somebody holds, each as soon as it is still, new and sharp."""
    screen.say(camera.lock())
    board = album.board
    waiting = _Waiting(board, timeout_s)
    wanted = guidance(album.views, board, lens)
    with contextlib.closing(camera.stream()) as stream:
        for frame in stream:
            if frame.color is None:
                raise CameraError(f"the {camera.name} gave an image without colour")
            image = np.asarray(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), np.uint8)
            detection = see(image, board)
            why = waiting.look(image, detection, frame.time_s)
            screen.show(Sight(image, detection, wanted, album.views, why))
            if detection is not None and waiting.is_over(detection, album.views):
                yield Shot(image, detection)
                waiting.start_again(frame.time_s)
                wanted = guidance(album.views, board, lens)


def is_still(run: Sequence[Detection]) -> bool:
    """Whether the last STILL_FRAMES detections show a board that is held still.

    Since the first of them the corners moved, root mean square over the corners, by less than
    STILL_SIGMAS times what their noise explains, or than STILL_LEAST_PX.
    """
    if len(run) < STILL_FRAMES:
        return False
    first, *later = run[-STILL_FRAMES:]
    noise_px = np.mean([view.noise_px or NOISE_PX for view in run[-STILL_FRAMES:]])
    allowed = max(STILL_LEAST_PX, STILL_SIGMAS * 2 * float(noise_px))  # u and v of two images
    return all(_moved_px(first, view) < allowed for view in later)


def is_new(view: Detection, others: Sequence[Detection]) -> bool:
    """Whether the board is elsewhere, by NEW_SHARE of the image's width, than in all others."""
    return all(_moved_px(view, other) > NEW_SHARE * view.size[0] for other in others)


def _moved_px(one: Detection, other: Detection) -> float:
    """How far the corners that both views show are apart, root mean square; infinite for none."""
    _, here, there = np.intersect1d(one.ids, other.ids, return_indices=True)
    if not len(here):
        return np.inf
    apart = one.pixels[here] - other.pixels[there]
    return float(np.sqrt((apart**2).sum(axis=1).mean()))


class _Waiting:
    """What was seen since the last view: the frames in a row that show the board, or none of it."""

    def __init__(self, board: Board, timeout_s: float) -> None:
        self._board, self._timeout_s = board, timeout_s
        self._since_s: float | None = None
        self._run: list[Detection] = []
        self._without, self._why = 0, ""
        self._sharpest = np.inf

    def start_again(self, time_s: float) -> None:
        self._since_s = time_s
        self._run.clear()

    def look(self, image: Image, detection: Detection | None, time_s: float) -> str:
        """Count this frame; why no board is seen, if none is. CameraError when it takes too long.

        The reason takes seconds to find: once, when there was no board in many frames.
        """
        self._since_s = time_s if self._since_s is None else self._since_s
        if detection is not None:
            self._run.append(detection)
            self._without, self._why = 0, ""
        else:
            self._run.clear()
            self._without += 1
            if self._without == EXPLAINED_AFTER:
                try:
                    detect(image, self._board)
                except BoardNotFound as error:
                    self._why = str(error)
        if time_s - self._since_s > self._timeout_s:
            why = self._why or say("cameras.hold_still")
            raise CameraError(say("cameras.too_long", timeout_s=self._timeout_s, why=why))
        return self._why or NO_BOARD * (detection is None)

    def is_over(self, detection: Detection, taken: Sequence[Detection]) -> bool:
        """Whether this view is the one that was waited for."""
        if not (is_still(self._run) and is_new(detection, taken)):
            return False
        blur = detection.blur_px or 0.0
        self._sharpest = min(self._sharpest, blur)
        return blur <= SHARPEST_BLURS * self._sharpest


def see(image: Image, board: Board) -> Detection | None:
    """The board in a grey image, or None; unlike `detect`, without looking for the reason why."""
    found = find_corners(image, board)
    if found is None or len(found[0]) < FEWEST_CORNERS:
        return None
    try:
        return detect(image, board)
    except BoardNotFound:  # too few of its corners could be refined
        return None


# --- where views are kept ---


class Album:
    """A folder of views: what it holds already, and what is added, one file at a time.

    views: what was seen in them; skipped: the images in which no board is found. Raises ValueError
    when the folder holds views of another camera or board, or images of nobody knows what, and
    `overwrite` is not given.
    """

    def __init__(
        self, folder: str | os.PathLike[str], camera: Camera, board: Board, overwrite: bool = False
    ) -> None:
        self.folder, self.board = Path(folder), board
        self.views: list[Detection] = []
        self.skipped: list[Skipped] = []
        self.folder.mkdir(parents=True, exist_ok=True)
        self._session = session_card(camera, board)
        images = sorted(self.folder.glob("view_*.png"))
        if overwrite:
            for path in (*images, self.folder / SESSION):
                path.unlink(missing_ok=True)
        elif images:
            self._read(images)
        self._next = 0 if overwrite or not images else 1 + int(images[-1].stem.split("_")[1])

    def _read(self, images: list[Path]) -> None:
        path = self.folder / SESSION
        known = json.loads(path.read_text("utf-8")) if path.exists() else None
        if known != self._session:
            whose = "nobody knows what" if known is None else f"{known['camera']}, {known['board']}"
            held = {"folder": self.folder, "count": len(images), "whose": whose}
            raise ValueError(say("cameras.other_views", card=self._session, **held))
        for path in images:
            data = np.fromfile(path, np.uint8)  # imread takes no accents on Windows
            image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
            try:
                if image is None:
                    raise BoardNotFound("the file holds no image")
                self.views.append(detect(np.asarray(image, np.uint8), self.board, path.name))
            except BoardNotFound as error:
                self.skipped.append(Skipped(path.name, str(error)))

    def add(self, shot: Shot) -> None:
        """Save a view under the next name; a reader sees all of it or nothing."""
        if self._next == 0:
            results.write_bytes(self.folder / SESSION, json.dumps(self._session, indent=1).encode())
        path = self.folder / f"view_{self._next:03d}.png"
        results.write_bytes(path, cv2.imencode(".png", shot.image)[1].tobytes())
        self._next += 1
        self.views.append(replace(shot.detection, name=path.name))


def session_card(camera: Camera, board: Board) -> dict[str, object]:
    """What session.json says: which camera took the views, and of which board."""
    return {
        "camera": camera.name,
        "serial": camera.serial,
        "source": camera.source,
        "size": list(camera.color.size) if camera.color else None,
        "board": asdict(board) | {"squares": list(board.squares)},
    }


# --- what a session lacks, and what would add most ---


@dataclass(frozen=True, eq=False)
class Guidance:
    """What a session still lacks, a phrase each; the next view in words and as a pose.

    target (4, 4): T_camera_board of the next view, m.
    """

    missing: tuple[str, ...]
    next: str
    target: Floats

    def __repr__(self) -> str:
        return f"Still missing: {'; '.join(self.missing) or 'nothing'}.\nNext: {self.next}."


@dataclass(frozen=True, eq=False)
class _View:
    """A view as the guidance sees it: cells (6, 8), where there are corners; normal (3,), of the
    board away from the camera; distance of its middle, m; its middle in the image, px."""

    T_camera_board: Floats
    cells: Bools
    normal: Floats
    distance_m: float
    middle_px: Floats

    @property
    def tilt_deg(self) -> float:
        return float(np.degrees(np.arctan2(np.hypot(*self.normal[:2]), self.normal[2])))

    @property
    def away(self) -> int:
        """Which edge or corner of the board, of AWAY, is farthest from the camera."""
        return round(np.arctan2(-self.normal[1], -self.normal[0]) / (np.pi / 4)) % 8

    @property
    def tilt(self) -> tuple[int, int]:
        """Views with equal ones are tilted alike: how much, and which way."""
        steep = self.tilt_deg > sum(TILTS_DEG) / 2
        return (0, 0) if self.tilt_deg < FLAT_DEG else (1 + steep, self.away)


def guidance(detections: Sequence[Detection], board: Board, lens: Intrinsics) -> Guidance:
    """What these views still lack, and the view that would add most to them.

    lens: roughly the camera's, such as the factory's. The same arguments give the same answer.
    Raises ValueError when the board does not fit into the image at any distance.
    """
    views = [_seen(detection, board, lens) for detection in detections]
    best = _most_useful(views, _proposals(board, lens))
    missing = [_coverage_lack(views), *_tilt_lacks(views), _distance_lack(views)]
    missing.append(_sharpness_lack(detections))
    return Guidance(tuple(filter(None, missing)), _in_words(best, lens.size), best.T_camera_board)


def outline(board: Board, T_camera_board: Floats, lens: Intrinsics) -> Floats:
    """The pattern's outer corners in the image, (4, 2) px, clockwise from its top left one.

    They are NaN where they are behind the camera.
    """
    return project(through(T_camera_board, board.outline), lens.K, lens.dist)


def _coverage_lack(views: Sequence[_View]) -> str:
    across, down = CELLS
    empty = ~np.any([view.cells for view in views], axis=0) if views else np.ones((down, across))
    if empty.mean() <= 1 - COVERED_SHARE:
        return ""
    rows, columns = np.nonzero(empty)
    thirds = Counter(zip(3 * rows // down, 3 * columns // across, strict=True))
    row, column = max(thirds, key=lambda third: (thirds[third], third))
    place = _place(int(row), int(column))
    return f"coverage: {int(empty.sum())} of {across * down} parts of the image, most {place}"


def _tilt_lacks(views: Sequence[_View]) -> list[str]:
    sine = np.sin(np.radians(TILTED_DEG))
    across, down = np.array([view.normal[:2] for view in views]).reshape(-1, 2).T
    slopes = {"left": across, "right": -across, "top": down, "bottom": -down}
    have = {edge: int((slope > sine).sum()) for edge, slope in slopes.items()}
    few = {edge: n for edge, n in have.items() if n < TILTED_VIEWS}
    return [f"tilt: {edge} edge away, {n} of {TILTED_VIEWS} views" for edge, n in few.items()]


def _distance_lack(views: Sequence[_View]) -> str:
    distances = [view.distance_m for view in views]
    if len(distances) < 2 or max(distances) >= DISTANCE_RATIO * min(distances):
        return "" if len(distances) >= 2 else "distance: near and far views"
    return f"distance: all views between {min(distances):.2f} and {max(distances):.2f} m"


def _sharpness_lack(detections: Sequence[Detection]) -> str:
    blurs = [view.blur_px for view in detections if view.blur_px is not None]
    blurred = sum(blur > MEDIAN_BLURS * np.median(blurs) for blur in blurs)
    return f"sharpness: {blurred} of {len(detections)} views are blurred" if blurred else ""


def _most_useful(views: Sequence[_View], proposals: Sequence[_View]) -> _View:
    """The proposal whose cells, tilt and distance the views have least of."""
    down, across = np.ogrid[: CELLS[1], : CELLS[0]]
    border = (down % (CELLS[1] - 1) == 0) | (across % (CELLS[0] - 1) == 0)
    worth = np.where(border, BORDER_WEIGHT, 1.0)
    worth = worth / (1 + np.sum([view.cells for view in views], axis=0)) ** 2
    tilts = Counter(view.tilt for view in views)
    fills = Counter(_fill(view, proposals) for view in views)

    def gain(view: _View) -> float:
        tilt, fill = 1 + tilts[view.tilt], 1 + fills[_fill(view, proposals)]
        return float(worth[view.cells].sum()) / 8 + 1 / tilt + 0.5 / fill

    return max(proposals, key=gain)


def _fill(view: _View, proposals: Sequence[_View]) -> int:
    """Which of FILLS the view's distance is nearest to."""
    distances = sorted({round(proposal.distance_m, 6) for proposal in proposals})
    return int(np.argmin(np.abs(np.log(np.array(distances) / view.distance_m))))


@lru_cache(maxsize=8)
def _proposals(board: Board, lens: Intrinsics) -> tuple[_View, ...]:
    """Views to choose from: all places, distances and tilts that show enough of the board."""
    wide, high = board.size_m
    views = []
    for number, tilt in enumerate((0.0, *(t for t in TILTS_DEG for _ in AWAY))):
        turn = np.radians(45.0 * number)
        facing = Rotation.from_rotvec(np.radians(tilt) * np.array([np.cos(turn), np.sin(turn), 0]))
        facing *= Rotation.from_euler("z", ROLLS_DEG[number % len(ROLLS_DEG)], degrees=True)
        for fill in FILLS:
            near = max(lens.fx * wide / lens.width, lens.fy * high / lens.height) / fill
            for aim in np.stack(np.meshgrid(PLACES, PLACES), axis=-1).reshape(-1, 2):
                view = _aimed(board, lens, facing, near, aim * lens.size)
                if view is not None:
                    views.append(view)
    checks.refuse(not views, f"board: no view of {wide:g} x {high:g} m fits into {lens.size} px")
    return tuple(views)


def _aimed(
    board: Board, lens: Intrinsics, facing: Rotation, distance_m: float, aim_px: Floats
) -> _View | None:
    """The view nearest to this aim of the board's middle that shows enough of the board."""
    needed = PROPOSED_SHARE if board.kind == "charuco" else 1.0

    def shown(T: Floats) -> Floats:
        return board.points[seen(board.points, T, lens, ROOM_PX)]

    def enough(T: Floats) -> bool:
        return len(shown(T)) / len(board.points) >= needed

    R = facing.as_matrix() @ board.T_board_sheet[:3, :3].T
    T = slide_into_view(aim_px, distance_m, R, board.middle, lens, enough, 11)
    if T is None:
        return None
    return _view(T, project(through(T, shown(T)), lens.K, lens.dist), board, lens)


def _seen(detection: Detection, board: Board, lens: Intrinsics) -> _View:
    _, turn, shift = cv2.solvePnP(
        board.points[detection.ids], detection.pixels, lens.K, lens.dist, flags=cv2.SOLVEPNP_IPPE
    )
    T = make_transform(Rotation.from_rotvec(turn.ravel()), shift.ravel())
    return _view(T, detection.pixels, board, lens)


def _view(T: Floats, pixels: Floats, board: Board, lens: Intrinsics) -> _View:
    across, down = CELLS
    column, row = (pixels * [across, down] // lens.size).astype(int).T
    cells = np.zeros((down, across), bool)
    cells[np.clip(row, 0, down - 1), np.clip(column, 0, across - 1)] = True
    middle = through(T, board.middle)
    normal = (T @ board.T_board_sheet)[:3, 2]
    return _View(T, cells, normal, float(middle[2]), project(middle, lens.K, lens.dist))


def _in_words(view: _View, size: tuple[int, int]) -> str:
    column, row = np.clip(3 * view.middle_px // size, 0, 2).astype(int)
    tilt = "square to the camera"
    if view.tilt_deg >= FLAT_DEG:
        part = "corner" if view.away % 2 else "edge"
        tilt = f"its {AWAY[view.away]} {part} turned away by {view.tilt_deg:.0f} degrees"
    return f"the board {_place(row, column)}, {view.distance_m:.2f} m from the camera, {tilt}"


def _place(row: int, column: int) -> str:
    """Where a ninth of the image is."""
    if (row, column) == (1, 1):
        return "in the middle"
    side = " ".join(filter(None, (("top", "", "bottom")[row], ("left", "", "right")[column])))
    return f"at the {side}"


# --- what a person sees meanwhile ---


class Sight(NamedTuple):
    """What a `Screen` shows of one moment of a session.

    image (H, W): grey. detection: what is seen in it; None for nothing, and `why`. taken: the
    views so far.
    """

    image: Image
    detection: Detection | None
    wanted: Guidance
    taken: Sequence[Detection]
    why: str = ""


class Screen:
    """A progress bar on standard error with the next view's description."""

    def __init__(self, views: int) -> None:
        from tqdm import tqdm

        self._bar = tqdm(total=views, unit="view", leave=False)

    def say(self, text: str) -> None:
        """One sentence, once."""
        self._bar.set_postfix_str(text)

    def show(self, sight: Sight) -> None:
        """What is seen and wanted now."""
        self._bar.n = len(sight.taken)
        self._bar.set_postfix_str(sight.why or f"next: {sight.wanted.next}")

    def close(self) -> None:
        """Take the bar away."""
        self._bar.close()


class LiveImage(Screen):
    """A widget: the image with what is seen, taken and wanted drawn into it, and words above."""

    def __init__(self, board: Board, lens: Intrinsics, views: int) -> None:
        import ipywidgets

        self._board, self._lens, self._views = board, lens, views
        self._said = ""
        self._image = ipywidgets.Image(format="jpeg", value=_jpeg(np.zeros((48, 64, 3), np.uint8)))
        self._image.layout.max_width = "100%"
        self._words = ipywidgets.HTML("Waiting for the first image ...")
        self._box = ipywidgets.VBox([self._words, self._image])

    def say(self, text: str) -> None:
        self._said = text

    def show(self, sight: Sight) -> None:
        ring = outline(self._board, sight.wanted.target, self._lens)
        self._image.value = _jpeg(draw(sight, ring))
        count = f"<b>{len(sight.taken)} of {self._views} views.</b> {html.escape(self._said)}"
        lines = [count, f"<b>Next:</b> {html.escape(sight.wanted.next)}."]
        lines += [html.escape(f"Missing: {text}") for text in sight.wanted.missing]
        if sight.detection is None:
            lines.append(f"<i>{html.escape(sight.why)}</i>")
        self._words.value = "<br>".join(lines)

    def close(self) -> None:
        """The last image stays."""
        legend = "The last image. Rings: the board; dots: views before; outline: what was wanted."
        self._words.value = f"{html.escape(self._said)} {legend}"

    def __repr__(self) -> str:
        return "The live image appears here while the cell runs."

    def _repr_mimebundle_(self, **kwargs: Any) -> dict[str, Any]:
        """The widget, and a text that is the same at each run where widgets are not shown."""
        return self._box._repr_mimebundle_(**kwargs) | {"text/plain": repr(self)}


@contextlib.contextmanager
def _screen(board: Board, lens: Intrinsics, views: int) -> Iterator[Screen]:
    """A live image where a notebook's kernel runs, else a progress bar."""
    from IPython import display, get_ipython

    if getattr(get_ipython(), "kernel", None) is None:
        screen = Screen(views)
    else:
        screen = LiveImage(board, lens, views)
        display.display(screen)
    with contextlib.closing(screen):
        yield screen


def draw(sight: Sight, ring: Floats) -> Image:
    """The image in colour (H, W, 3), BGR, with the corners that were taken, those that are seen,
    and the outline (4, 2) px that is wanted."""
    canvas = np.repeat(sight.image[..., None], 3, axis=2)
    dots = [(view, 1, TAKEN_COLOR, -1) for view in sight.taken]
    dots += [(sight.detection, 4, SEEN_COLOR, LINE_PX)] if sight.detection is not None else []
    for view, radius_px, color, width in dots:
        for u, v in np.rint(view.pixels).astype(int).tolist():
            cv2.circle(canvas, (u, v), radius_px, color, width)
    if np.isfinite(ring).all():
        cv2.polylines(canvas, [np.rint(ring).astype(np.int32)], True, WANTED_COLOR, LINE_PX)
    return canvas


def _jpeg(image: Image) -> bytes:
    return cv2.imencode(".jpg", image)[1].tobytes()
