"""Garment tracking as a service: sessions over gRPC, REST and WebSocket, tracked in worker processes."""

import os

# gRPC would write lines of its own to the standard error, one for each broken TLS handshake. It reads this at its import.
os.environ.setdefault("GRPC_VERBOSITY", "NONE")
