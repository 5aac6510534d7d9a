"""Files of the store: checkpoints, the data folder, permissions."""
