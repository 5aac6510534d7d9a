"""The garment: its topology, rest shape, clusters and decimated levels."""
