"""Views of a calibration board, taken by themselves as soon as the board is held still."""

from __future__ import annotations

import contextlib
import json
import os
import zlib
from collections.abc import Generator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from coursekit import results
from coursekit.boards import Board, BoardNotFound, Detection, Detections, Skipped, detect
from coursekit.boards.detector import FEWEST_CORNERS, SESSION
from coursekit.boards.find import find
from coursekit.cameras.camera import Camera, CameraError, check_count
from coursekit.cameras.guidance import guidance, middle_of
from coursekit.cameras.live_view import Screen, screen_for
from coursekit.cameras.simulated import SimulatedCamera
from coursekit.geometry import Intrinsics, make_transform, transform_points

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Shot = tuple[NDArray[np.uint8], Detection]

FOLDER = "03_views"
STILL_FRAMES = 5  # over so many frames in a row ...
STILL_SIGMAS = 5.0  # ... the corners moved less than so many times what noise alone makes of them
STILL_LEAST_PX = 0.3  # nobody's hand is steadier
NOISE_PX = 0.1  # of a corner, where a detection does not say
NEW_SHARE = 0.04  # of the image's width: a view that is nearer to another one adds nothing
BLUR_RATIO = 1.3  # times the sharpest still view: this one is blurred, so wait
EXPLAINED_AFTER = 60  # frames in a row without a board
NO_BOARD = "There is no board in the image, or too little of it."
HAND_DEG, HAND_SHARE = 4.0, 0.03  # the simulated hand's std: of its angles, of distance and aim
TRIES, LEAST_SHARE = 20, 0.4  # of the simulated hand; of the board's corners, or it tries again


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
    check_count("views", views)
    if not isinstance(board, Board):
        raise ValueError(f"board: got {type(board).__name__}, want a boards.Board")
    if not timeout_s > 0:
        raise ValueError(f"timeout_s: got {timeout_s!r}, want a positive number of seconds")
    lens = camera.color
    if lens is None:
        raise CameraError(f"the {camera.name} has no colour stream to calibrate")
    album = Album(results.folder() / FOLDER if folder is None else folder, camera, board, overwrite)
    before = len(album.views)
    if before < views:
        try:
            with screen_for(board, lens, views) as screen:
                _fill(album, _shots(camera, lens, board, album, timeout_s, screen), views)
        except KeyboardInterrupt:
            if not album.views:
                raise
    print(_summary(camera, album, views, before))
    return Detections(album.views, album.skipped)


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


def _fill(album: Album, shots: Generator[Shot, None, None], views: int) -> None:
    """Save shots until there are so many views; what stops them says what is kept."""
    try:
        with contextlib.closing(shots):
            while len(album.views) < views:
                shot = next(shots, None)
                if shot is None:
                    return
                album.add(*shot)
    except CameraError as error:
        kept = f"{len(album.views)} views are kept in {album.folder}; capture goes on from them"
        raise CameraError(f"{error}. {kept}", error.frames) from error


def _summary(camera: Camera, album: Album, views: int, before: int) -> str:
    if len(album.views) == before:
        return (
            f"{before} views of the {camera.name} were in {album.folder.name} already, none was "
            "taken: ask for more, or start again with overwrite=True."
        )
    count = f"{len(album.views)} views"
    if len(album.views) < views:
        count = f"{len(album.views)} of {views} views"
    moved = isinstance(camera, SimulatedCamera)
    how = ": there is no board to hold, so the simulated camera was moved" if moved else ""
    return f"{count} of the {camera.name} in {album.folder.name}{how}."


# --- where views come from ---


def _shots(
    camera: Camera,
    lens: Intrinsics,
    board: Board,
    album: Album,
    timeout_s: float,
    screen: Screen,
) -> Generator[Shot, None, None]:
    if isinstance(camera, SimulatedCamera):
        yield from _moved(camera, lens, board, album, screen)
    else:
        screen.say(camera.lock())
        yield from _held(camera, lens, board, album, timeout_s, screen)


def _moved(
    camera: SimulatedCamera, lens: Intrinsics, board: Board, album: Album, screen: Screen
) -> Generator[Shot, None, None]:
    """Views of the simulated camera, moved to where the guidance wants it."""
    while True:
        wanted = guidance(album.views, board, lens.size, lens)
        rng = np.random.default_rng([zlib.crc32(camera.serial.encode()), len(album.views)])
        for _ in range(TRIES):
            camera.show_board(board, _by_hand(wanted.target, board, rng))
            image = camera.color_image()[..., 0]
            detection = see(image, board)
            if detection is None or len(detection) < LEAST_SHARE * len(board.points):
                continue
            screen.show(image, detection, wanted, album.views)
            yield image, detection
            break
        else:
            raise CameraError(f"the {camera.name} does not see the board at any of {TRIES} tries")


def _by_hand(
    T_camera_board: NDArray[np.float64], board: Board, rng: np.random.Generator
) -> NDArray[np.float64]:
    """A pose nearby: nobody holds a board exactly as asked."""
    middle = middle_of(board)
    at = transform_points(T_camera_board, middle)
    turn = Rotation.from_rotvec(np.radians(HAND_DEG) * rng.standard_normal(3))
    R = turn.as_matrix() @ T_camera_board[:3, :3]
    at = at + HAND_SHARE * at[2] * rng.standard_normal(3)
    return make_transform(R, at - R @ middle)


def _held(
    camera: Camera,
    lens: Intrinsics,
    board: Board,
    album: Album,
    timeout_s: float,
    screen: Screen,
) -> Generator[Shot, None, None]:
    """Views of a board that somebody holds, each as soon as it is still, new and sharp."""
    waiting = _Waiting(board, timeout_s)
    wanted = guidance(album.views, board, lens.size, lens)
    with contextlib.closing(camera._stream()) as stream:
        for frame in stream:
            if frame.color is None:
                raise CameraError(f"the {camera.name} gave an image without colour")
            image = np.asarray(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), np.uint8)
            detection = see(image, board)
            why = waiting.look(image, detection, frame.time_s)
            screen.show(image, detection, wanted, album.views, why)
            if detection is not None and waiting.is_over(detection, album.views):
                yield image, detection
                waiting.start_again(frame.time_s)
                wanted = guidance(album.views, board, lens.size, lens)


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

    def look(self, image: NDArray[np.uint8], detection: Detection | None, time_s: float) -> str:
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
                self._why = _reason(image, self._board)
        if time_s - self._since_s > self._timeout_s:
            raise CameraError(
                f"no still, new and sharp view of the board within {self._timeout_s:g} s: "
                + (self._why or "hold it still where the live image asks for it, in good light")
            )
        return self._why or NO_BOARD * (detection is None)

    def is_over(self, detection: Detection, taken: Sequence[Detection]) -> bool:
        """Whether this view is the one that was waited for."""
        if not (is_still(self._run) and is_new(detection, taken)):
            return False
        blur = detection.blur_px or 0.0
        self._sharpest = min(self._sharpest, blur)
        return blur <= BLUR_RATIO * self._sharpest


def _reason(image: NDArray[np.uint8], board: Board) -> str:
    """Why `detect` finds no board in this image."""
    try:
        detect(image, board)
    except BoardNotFound as error:
        return str(error)
    return ""


def see(image: NDArray[np.uint8], board: Board) -> Detection | None:
    """The board in a grey image, or None; unlike `detect`, without looking for the reason why."""
    found = find(image, board)
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
        self.folder, self._board = Path(folder), board
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
            raise ValueError(
                f"folder: {self.folder} holds {len(images)} views of {whose}, not of "
                f"{self._session['camera']}, {self._session['board']}: name another folder, or "
                "overwrite=True to delete them"
            )
        for path in images:
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            try:
                if image is None:
                    raise BoardNotFound("the file holds no image")
                self.views.append(detect(np.asarray(image, np.uint8), self._board, path.name))
            except BoardNotFound as error:
                self.skipped.append(Skipped(path.name, str(error)))

    def add(self, image: NDArray[np.uint8], detection: Detection) -> None:
        """Save an image (H, W) under the next name; a reader sees all of it or nothing."""
        if self._next == 0:
            results.write_bytes(self.folder / SESSION, json.dumps(self._session, indent=1).encode())
        path = self.folder / f"view_{self._next:03d}.png"
        results.write_bytes(path, cv2.imencode(".png", image)[1].tobytes())
        self._next += 1
        self.views.append(replace(detection, name=path.name))


def session_card(camera: Camera, board: Board) -> dict[str, object]:
    """What session.json says: which camera took the views, and of which board."""
    return {
        "camera": camera.name,
        "serial": camera.serial,
        "source": camera.source,
        "size": list(camera.color.size) if camera.color else None,
        "board": asdict(board) | {"squares": list(board.squares)},
    }
