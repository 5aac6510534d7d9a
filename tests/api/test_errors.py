"""Errors: the table is complete, and errors survive the wire."""

import pickle

import grpc
import pytest
from ddakf_api import errors
from ddakf_api.errors import ERRORS, ServiceError, class_of, from_detail, from_rpc_error, to_detail, to_metadata
from ddakf_api.v1 import tracking_pb2 as pb

import ddakf.errors as library


class Refused(grpc.RpcError):
    """A failed call as gRPC raises it."""

    def __init__(self, code, details="", metadata=()):
        self.code, self.details, self.trailing_metadata = lambda: code, lambda: details, lambda: metadata


@pytest.mark.parametrize("name", ERRORS)
def test_every_name_has_a_class_and_codes(name):
    cls = ERRORS[name]
    assert getattr(errors, name) is cls
    assert cls.__name__ == name
    assert isinstance(cls.status, grpc.StatusCode)
    assert cls.status is not grpc.StatusCode.OK
    assert 400 <= cls.http_status < 600
    assert isinstance(cls.retryable, bool)
    assert cls.__doc__


def test_every_class_is_in_the_table():
    classes = {v for v in vars(errors).values() if isinstance(v, type) and issubclass(v, ServiceError)}
    assert classes - {ServiceError} == set(ERRORS.values())


def test_codes_of_the_two_protocols_agree():
    by_status = {}
    for cls in ERRORS.values():
        by_status.setdefault(cls.status, set()).add(cls.http_status // 100)
    assert all(len(classes) == 1 for classes in by_status.values()), by_status
    assert all(cls.http_status in (429, 503) for cls in ERRORS.values() if cls.retryable)


@pytest.mark.parametrize("name", ERRORS)
def test_errors_survive_the_wire_and_pickling(name):
    error = ERRORS[name]("one sentence", field="a.b", expected="x", got="y", retry_after=2.5)
    metadata = to_metadata(to_detail(error))
    for back in (from_rpc_error(Refused(error.status, metadata=metadata)), pickle.loads(pickle.dumps(error))):
        assert type(back) is type(error)
        assert (str(back), back.field, back.expected, back.got) == ("one sentence", "a.b", "x", "y")
        assert back.retry_after == 2.5


def test_an_error_with_any_text_can_be_sent():
    for text in ("\ud800", "long " * 100_000):
        detail = to_detail(library.InvalidConfig(text, text, text))
        assert detail.name == "InvalidConfig"
        assert len(detail.SerializeToString()) < 20_000
        assert len(to_detail(errors.InvalidArgument(text)).message) < 5000


def test_the_default_message_contains_field_expected_and_got():
    assert str(errors.InvalidMesh(field="faces", expected="three", got="two")) == "faces: expected three, got two"


@pytest.mark.parametrize("name", [n for n, c in vars(library).items() if isinstance(c, type) and n.startswith("Inv")])
def test_errors_of_the_library_travel_under_their_own_names(name):
    raised = getattr(library, name)("points", "numbers", "words")
    back = from_detail(to_detail(raised))
    assert type(back) is ERRORS[name]
    assert (back.field, back.expected, back.got) == ("points", "numbers", "words")
    assert str(back) == str(raised)


def test_unexpected_errors_reveal_only_their_type():
    detail = to_detail(KeyError("/etc/secret"))
    assert detail.name == "Internal"
    assert "secret" not in str(detail)
    assert class_of(KeyError()) is errors.Internal


@pytest.mark.parametrize("code", [c for c in grpc.StatusCode if c is not grpc.StatusCode.OK])
def test_a_status_without_detail_gives_the_general_class_of_its_code(code):
    error = from_rpc_error(Refused(code, "said by a proxy"))
    assert str(error) == "said by a proxy"
    known = {each.status for each in ERRORS.values()}
    assert error.status is (code if code in known else errors.Internal.status)


@pytest.mark.parametrize("side", ["CLIENT: Sent", "SERVER: Received", "Received"])
def test_a_message_that_grpc_refuses_is_too_large_and_not_to_be_sent_again(side):
    said = f"{side} message larger than max (1200044 vs. 200000)"
    error = from_rpc_error(Refused(grpc.StatusCode.RESOURCE_EXHAUSTED, said))
    assert (type(error), str(error), error.retryable) == (errors.MessageTooLarge, said, False)
    assert (error.field, error.expected, error.got) == ("message", "at most 200000 bytes", "1200044 bytes")


def test_names_of_later_versions_are_still_errors():
    error = from_detail(pb.ErrorDetail(name="FromTheFuture", message="unheard of"))
    assert type(error) is ServiceError
    assert str(error) == "unheard of"
