"""Garment constants: topology, rest shape, clusters, patches and aggregates."""
