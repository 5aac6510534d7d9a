"""Recovery of sessions after the loss of a worker or of the server: checkpoints, registry, restores."""
