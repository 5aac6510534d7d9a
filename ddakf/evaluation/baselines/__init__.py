"""Baselines: the methods that the tracker is compared with, one module each, behind :class:`.baseline.Baseline`."""
