"""Whose fault a missed grasp is: decided with a test from repeated misses, and kept in a ledger."""

from coursekit.attribution.attribute import Attribution, attribute
from coursekit.attribution.decision import Verdict
from coursekit.attribution.ledger import Entry, Ledger
from coursekit.attribution.simulate import SimulatedMisses, four_sets, simulate_misses

__all__ = [
    "Attribution",
    "Entry",
    "Ledger",
    "SimulatedMisses",
    "Verdict",
    "attribute",
    "four_sets",
    "simulate_misses",
]
