"""Certificate: the end of its validity, from its DER encoding (X.509), which no standard module reads."""

from __future__ import annotations

import calendar
import re
import ssl
import time
from collections.abc import Iterator
from typing import NamedTuple

_PEM = re.compile(r"-----BEGIN CERTIFICATE-----.+?-----END CERTIFICATE-----", re.DOTALL)
_VERSION, _UTC_TIME = 0xA0, 0x17  # tags
_VALIDITY = 3  # place among the fields after the version
_LONG_LENGTH = 0x80


class _Element(NamedTuple):
    tag: int
    content: bytes


def expiry(pem: str) -> float:
    """The end of the validity of the first certificate of a chain, seconds since 1970.

    Raises:
        ValueError: there is none.
    """
    found = _PEM.search(pem)
    if found is None:
        raise ValueError("no PEM certificate")
    try:
        (certificate,) = _elements(ssl.PEM_cert_to_DER_cert(found[0]))
        fields = list(_elements(next(_elements(certificate.content)).content))
        validity = fields[_VALIDITY + (fields[0].tag == _VERSION)]
        _, end = _elements(validity.content)
        form = "%y%m%d%H%M%SZ" if end.tag == _UTC_TIME else "%Y%m%d%H%M%SZ"
        return float(calendar.timegm(time.strptime(end.content.decode("ascii"), form)))
    except (IndexError, StopIteration):
        raise ValueError("a certificate that is cut off") from None


def _elements(data: bytes) -> Iterator[_Element]:
    """The elements of a DER sequence. Raises IndexError for data that is cut off."""
    at = 0
    while at < len(data):
        tag, length, at = data[at], data[at + 1], at + 2
        if length & _LONG_LENGTH:
            digits = length & ~_LONG_LENGTH
            length, at = int.from_bytes(data[at : at + digits], "big"), at + digits
        if at + length > len(data):
            raise IndexError
        yield _Element(tag, data[at : at + length])
        at += length
