"""Durable state: sessions, history and keys in a database, checkpoints in files or objects."""
