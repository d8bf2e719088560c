"""Figures of the notebooks, one module a notebook; functions return a figure, none shows it."""

from __future__ import annotations

from coursekit.plots import depth_noise, error_budget, hand_eye, intrinsics, pinhole
from coursekit.plots.style import COLORS, LessonFigure, drag, figure
