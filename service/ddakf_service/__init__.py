"""Garment tracking as a service: sessions over gRPC, REST and WebSocket, tracked in worker processes."""
