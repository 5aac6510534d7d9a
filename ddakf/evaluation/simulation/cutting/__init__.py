"""Cutting of garments around the resting body."""
