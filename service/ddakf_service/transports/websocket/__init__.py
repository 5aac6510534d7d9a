"""Streams and watchers over WebSocket."""
