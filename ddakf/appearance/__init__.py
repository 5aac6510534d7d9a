"""Appearance: what colours say about where the cloth is."""
