"""Filters over time: per vertex, of particles, and DD-AKF as printed."""
