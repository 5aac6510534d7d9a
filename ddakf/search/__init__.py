"""Relocalization: a garment without a track is found in the cloud."""
