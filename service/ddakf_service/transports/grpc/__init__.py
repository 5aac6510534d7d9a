"""gRPC: session calls, the Track stream, health and reflection."""
