"""Answers: the newest of a session's lossless streams, repeated to a client that comes back without them."""

from __future__ import annotations

from collections.abc import Iterable

from ddakf_api.v1 import tracking_pb2 as pb

from .response import Response


class Answers:
    """Results and refusals of frames, in the order in which they were made."""

    def __init__(self):
        self._responses: list[Response] = []

    def add(self, response: Response, capacity: int) -> None:
        """Adds an answer; the oldest beyond ``capacity`` go."""
        self._responses = [*self._responses, response][-capacity:]

    def after(self, number: int, last: int) -> list[Response]:
        """The answers to frames above ``number`` and up to ``last``, that of the last applied frame; all others are dropped.

        Frames above it are not known to the tracker; their client sends them again.
        """
        self._responses = [response for response in self._responses if number < response.sequence_number <= last]
        return list(self._responses)

    def clear(self) -> None:
        self._responses = []

    def serialised(self) -> list[bytes]:
        """Each as a serialised TrackResponse."""
        return [response.serialised() for response in self._responses]

    def load(self, serialised: Iterable[bytes]) -> None:
        """The inverse of :meth:`serialised`."""
        self._responses = [Response(pb.TrackResponse.FromString(data)) for data in serialised]
