"""Trials: single runs of a method on a recording, scored against the truth."""
