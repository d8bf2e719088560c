"""Whose fault a missed grasp is: decided with a test from repeated misses, and kept in a ledger."""

from __future__ import annotations

from coursekit.attribution.ledger import Entry, Ledger
from coursekit.attribution.verdict import Attribution, attribute, four_sets, simulate_misses
