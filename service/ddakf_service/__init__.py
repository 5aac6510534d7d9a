"""Garment tracking as a service: sessions over gRPC and REST, computed in worker processes."""
