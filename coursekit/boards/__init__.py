"""Calibration boards: what they are, how to print them, where an image shows their corners."""

from coursekit.boards.board import DICTIONARIES, Board
from coursekit.boards.detect import detect
from coursekit.boards.detection import BoardNotFound, Detection, Detections, Skipped
from coursekit.boards.folder import detect_all
from coursekit.boards.sheet import save_sheet

__all__ = [
    "DICTIONARIES",
    "Board",
    "BoardNotFound",
    "Detection",
    "Detections",
    "Skipped",
    "detect",
    "detect_all",
    "save_sheet",
]
