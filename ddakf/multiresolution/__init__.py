"""Passes before the full resolution: rigid clusters, then a pyramid of decimated meshes."""
