"""The body under the garment: closest points, contact, and the garment's place on it."""
