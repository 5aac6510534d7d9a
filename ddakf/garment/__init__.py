"""Garment constants: topology, rest shape, clusters, patches, aggregates and decimated levels."""
