"""Plausibility of the input: refusals, the side that a cloud was seen from, and warnings."""
