"""Search for a garment without a track: rigid relocalization, then non-rigid registration."""
