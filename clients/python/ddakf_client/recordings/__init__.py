"""Recordings of sessions; they need mcap, ``pip install 'ddakf-client[recording]'``."""

from ddakf_client.recordings.recording import Recording, load, record, replay

__all__ = ["Recording", "load", "record", "replay"]
