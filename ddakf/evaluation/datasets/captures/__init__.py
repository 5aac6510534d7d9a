"""Captures: recordings of real sensors, without ground truth of the mesh."""
