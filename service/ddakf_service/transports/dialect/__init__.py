"""Dialect: the JSON of REST and WebSocket, the protobuf JSON mapping of the contract's messages."""
