"""Transports: the service's contract over gRPC, REST and WebSocket."""
