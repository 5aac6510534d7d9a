"""Computation in a worker process: main program, lanes, trackers, warm-up."""
