"""Tracking runs: their sources, replay in this process or on a server, and the scores of one run."""
