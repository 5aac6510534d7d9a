"""Responses of sessions: to the client, to watchers, and again to a client that comes back."""
