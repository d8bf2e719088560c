"""Boards, the bounds of counted shares and the form of refusals that many test modules share."""

import os

import pytest
from scipy.stats import binom

from coursekit.boards import Board

NIGHTLY = os.environ.get("COURSEKIT_NIGHTLY") == "1"
CHARUCO = Board("charuco", (9, 6), 0.025)
CHECKERBOARD = Board("checkerboard", (10, 7), 0.025)  # 9 x 6 inner corners


def most(share, of):
    """What a share of so many may be if it is at most this; chance exceeds it once in 1,000."""
    return binom.ppf(0.999, of, share) / of


def least(share, of):
    """What a share of so many must be if it is at least this; chance misses it once in 1,000."""
    return binom.ppf(0.001, of, share) / of


def refusals(*cases):
    """The test of a table of (message, call): each call raises ValueError with such a message."""

    @pytest.mark.parametrize(("message", "call"), cases)
    def test(message, call):
        with pytest.raises(ValueError, match=message):
            call()

    return test


def each(message, call, name, *values):
    """Cases of refusals that differ in what one argument is."""
    return [(message, lambda value=value: call(**{name: value})) for value in values]
