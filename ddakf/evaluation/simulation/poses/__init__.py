"""Poses over time, of which motions consist."""
