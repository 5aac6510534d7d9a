"""Sessions: creation, catalog, end, and recovery from the loss of a worker or of the process."""
