"""Responses: the two parts of a result are one TrackResponse on the wire."""

import pytest
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.sessions.responses.response import Response

NUMBERS = pb.Result(sequence_number=3, state=pb.TRACKER_STATE_TRACKING, reliability=0.5, timings={"total": 0.01, "fuse": 0.002})


@pytest.mark.parametrize("size", [0, 1, 100, 127, 128, 16_383, 16_384, 1 << 21])
def test_a_result_in_two_parts_is_one_response(size):
    arrays = pb.Result(vertices=pb.PackedArray(encoding=1, data=bytes(size)), observed=pb.PackedArray(encoding=8, data=b"\1"))
    response = Response.of_result(NUMBERS.SerializeToString(), memoryview(arrays.SerializeToString()))
    response.message.result.frames_applied = 9
    expected = pb.TrackResponse(result=NUMBERS)
    expected.result.frames_applied = 9
    assert response.without_arrays().whole_message() == expected
    expected.result.MergeFrom(arrays)
    assert pb.TrackResponse.FromString(response.serialised()) == response.whole_message() == expected


def test_other_responses_are_their_messages():
    message = pb.TrackResponse(pong=pb.Pong(token=4))
    response = Response(message)
    assert response.has("pong")
    assert response.without_arrays() == response
    assert response.serialised() == message.SerializeToString()
    assert response.whole_message() == message
