"""Transports: the contract over gRPC, REST and WebSocket."""
