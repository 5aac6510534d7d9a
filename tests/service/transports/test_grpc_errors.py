"""gRPC errors as clients of any language read them."""

from __future__ import annotations

import logging

import grpc
import pytest
from ddakf_api.errors import (
    ERROR_METADATA_KEY,
    ERRORS,
    InvalidArgument,
    ResourceExhausted,
    Unavailable,
    from_rpc_error,
    to_detail,
)
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.transports.grpc.errors import abort, rich_status, shortened, trailers
from google.rpc import error_details_pb2
from grpc._cython import cygrpc
from grpc_status import rpc_status

from ..conftest import TIMEOUT, make_sheet
from .test_bad_input import create_request

MOST_BYTES = 8192  # of the headers of an answer, which is where gRPC stops
SERVICE = pb.DESCRIPTOR.services_by_name["TrackingService"]
KINDS = (error_details_pb2.ErrorInfo, error_details_pb2.BadRequest, error_details_pb2.RetryInfo)


def details_of(status) -> dict:
    """The details of a status by their kind."""
    found = {}
    for packed in status.details:
        message = next(kind() for kind in KINDS if packed.Is(kind.DESCRIPTOR))
        packed.Unpack(message)
        found[type(message).__name__] = message
    return found


def refusal(api, method: str, request) -> grpc.RpcError:
    with pytest.raises(grpc.RpcError) as caught:
        getattr(api.stub, method)(request, timeout=TIMEOUT)
    return caught.value


def test_a_bad_field_is_a_field_violation(api):
    mesh = make_sheet()
    error = refusal(api, "CreateSession", create_request(mesh._replace(vertices=mesh.vertices * 0)))
    status = rpc_status.from_call(error)
    details = details_of(status)
    ours = from_rpc_error(error)
    assert (status.code, status.message) == (grpc.StatusCode.INVALID_ARGUMENT.value[0], error.details())
    (violation,) = details["BadRequest"].field_violations
    assert (violation.field, violation.description) == ("garment", ours.message)
    info = details["ErrorInfo"]
    assert (info.reason, info.domain) == ("INVALID_MESH", "ddakf")
    assert dict(info.metadata) == {"field": ours.field, "expected": ours.expected, "got": ours.got}


@pytest.mark.parametrize("method", [method.name for method in SERVICE.methods])
def test_bytes_of_another_kind_are_an_invalid_argument(api, method):
    """In a unary call, and as the first message of a stream."""
    described = SERVICE.methods_by_name[method]
    call = api.channel.stream_stream(f"/{SERVICE.full_name}/{method}")
    with pytest.raises(grpc.RpcError) as caught:
        list(call(iter([b"\xff\xff\xff"]), timeout=TIMEOUT))
    error = from_rpc_error(caught.value)
    assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT
    assert str(error) == f"message: expected a serialised {described.input_type.name}, got 3 bytes of another kind"


def test_bytes_of_another_kind_end_a_stream(api, session):
    begin = pb.TrackRequest(start=pb.Start(name=session, api_version="1.0"))
    ping = pb.TrackRequest(ping=pb.Ping(token=1))
    requests = [begin.SerializeToString(), ping.SerializeToString(), b"\xff\xff\xff"]
    call = api.channel.stream_stream(f"/{SERVICE.full_name}/Track")
    with pytest.raises(grpc.RpcError) as caught:
        list(call(iter(requests), timeout=TIMEOUT))
    assert str(from_rpc_error(caught.value)).startswith("message: expected a serialised TrackRequest")


def test_a_missing_session_is_no_fault_of_a_field(api):
    error = refusal(api, "GetSession", pb.GetSessionRequest(name="sessions/none"))
    assert error.code() is grpc.StatusCode.NOT_FOUND
    details = details_of(rpc_status.from_call(error))
    assert set(details) == {"ErrorInfo"}
    assert details["ErrorInfo"].reason == "SESSION_NOT_FOUND"


def test_retry_info_says_when():
    error = ResourceExhausted("full", retry_after=2.5)
    details = details_of(rich_status(to_detail(error), ResourceExhausted))
    assert details["RetryInfo"].retry_delay.ToMilliseconds() == 2500


@pytest.mark.parametrize("name", ERRORS)
def test_every_error_has_a_reason_of_its_own(name):
    reasons = {other: details_of(rich_status(to_detail(cls("x")), cls))["ErrorInfo"].reason for other, cls in ERRORS.items()}
    assert len(set(reasons.values())) == len(ERRORS)
    assert reasons[name].replace("_", "").lower() == name.lower()


@pytest.mark.parametrize("letter", ["a", "é", "衣", "👕"])
def test_the_longest_texts_fit_into_the_headers(letter):
    long = letter * 5000
    error = InvalidArgument(long, field=long, expected=long, got=long, retry_after=1e6)
    detail = shortened(to_detail(error))
    headers = [("grpc-status", b"3"), ("grpc-message", b"%FF" * len(detail.message.encode())), *trailers(detail, InvalidArgument)]
    # HPACK counts 32 bytes per header beside its name and value; values of -bin are base64.
    size = sum(len(key) + 32 + (len(value) if key == "grpc-message" else 4 * (len(value) // 3 + 1)) for key, value in headers)
    assert size < MOST_BYTES


def test_the_longest_texts_arrive(api):
    """Unicode in a client's field comes back in the message, and the client still gets the error's details."""
    request = create_request(make_sheet())
    request.session.config_json = '{"' + "衣" * 5000 + '": {}}'
    error = refusal(api, "CreateSession", request)
    assert ERROR_METADATA_KEY in dict(error.trailing_metadata())
    assert type(from_rpc_error(error)).__name__ == "InvalidConfig"
    assert details_of(rpc_status.from_call(error))["ErrorInfo"].reason == "INVALID_CONFIG"


class Cut:
    """The context of a call whose client cuts it off at the moment of its abort."""

    async def abort(self, *_):
        raise cygrpc.ExecuteBatchError("the status cannot be sent")


@pytest.mark.parametrize("kind", ["unary_unary", "stream_stream"])
async def test_a_call_that_its_client_cuts_off_is_not_logged_as_a_defect(kind, caplog):
    left = []

    async def unary_unary(request, context):
        left.append("aborted")
        await abort(Cut(), Unavailable("too late"))
        left.append("went on")

    async def stream_stream(requests, context):
        await unary_unary(requests, context)
        yield b""

    handler = {"unary_unary": grpc.unary_unary_rpc_method_handler, "stream_stream": grpc.stream_stream_rpc_method_handler}
    method = handler[kind]({"unary_unary": unary_unary, "stream_stream": stream_stream}[kind])
    server = grpc.aio.server(handlers=[grpc.method_handlers_generic_handler("some", {"Method": method})])
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
        call = getattr(channel, kind)("/some/Method")(b"" if kind == "unary_unary" else iter([b""]), timeout=0.3)
        with pytest.raises(grpc.RpcError):
            await (call if kind == "unary_unary" else call.read())
    await server.stop(0)
    assert left == ["aborted"]
    assert [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR] == []
