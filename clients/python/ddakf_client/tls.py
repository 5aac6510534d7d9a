"""TLS: credentials of a connection from PEM files."""

from __future__ import annotations

import ssl
from os import PathLike
from pathlib import Path

import grpc
from ddakf_api.errors import InvalidArgument

SYSTEM = "system"

File = str | PathLike[str]


def tls_credentials(ca: File = SYSTEM, certificate: File | None = None, key: File | None = None) -> grpc.ChannelCredentials:
    """Credentials for :func:`~ddakf_client.connect`.

    Args:
        ca: PEM file with the authorities of the server's certificate; "system": those that gRPC trusts by itself.
        certificate: PEM file with the client's certificate chain, for a server that asks for one.
        key: PEM file with its private key.

    Raises:
        InvalidArgument: names ``tls_ca``, ``tls_certificate`` or ``tls_key``: a file is missing or invalid, or they do not match.
    """
    for name, present, other in (("tls_certificate", certificate, key), ("tls_key", key, certificate)):
        if other is not None and present is None:
            raise InvalidArgument(field=name, expected="a PEM file, as its counterpart is given", got="nothing")
    authorities = None if ca == SYSTEM else _authorities(ca)
    if certificate is None or key is None:
        return grpc.ssl_channel_credentials(authorities)
    return grpc.ssl_channel_credentials(authorities, *_key_and_chain(certificate, key))


def _authorities(ca: File) -> bytes:
    content = _read("tls_ca", ca)
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(cadata=content.decode("ascii"))
    except (ssl.SSLError, ValueError):
        raise InvalidArgument(field="tls_ca", expected="a PEM file with certificates", got=str(ca)) from None
    return content


def _key_and_chain(certificate: File, key: File) -> tuple[bytes, bytes]:
    chain, private = _read("tls_certificate", certificate), _read("tls_key", key)
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_cert_chain(certificate, key, password="")
    except (ssl.SSLError, ValueError):
        expected = "a PEM file with the key of tls_certificate, not encrypted"
        raise InvalidArgument(field="tls_key", expected=expected, got=str(key)) from None
    return private, chain


def _read(name: str, path: File) -> bytes:
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise InvalidArgument(field=name, expected="a readable PEM file", got=f"{path}: {error.strerror}") from None
