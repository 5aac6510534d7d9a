"""WebSocket: streams and watchers for browsers and scripts."""
