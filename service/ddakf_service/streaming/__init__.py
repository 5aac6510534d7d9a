"""Streams: frames on their way from a client to the tracker, and answers on their way back."""
