"""Calibration boards: what they are, how to print them, where an image shows their corners."""

from __future__ import annotations

from coursekit.boards.board import (
    Board,
    BoardNotFound,
    Detection,
    Detections,
    Skipped,
    caption,
    save_sheet,
)
from coursekit.boards.detector import detect, detect_all
