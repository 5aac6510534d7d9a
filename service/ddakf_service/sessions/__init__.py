"""Sessions: their life from creation to end, and what survives a worker or the process."""
