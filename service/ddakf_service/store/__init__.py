"""Store: the durable state of a server. Sessions, history and keys in a database, checkpoints in files or objects."""
