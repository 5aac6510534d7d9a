"""Certificates from files, read again when they change: new connections get the new ones, open ones go on."""

from __future__ import annotations

import asyncio
import logging
import ssl
from pathlib import Path
from typing import NamedTuple

import grpc

from ddakf.errors import InvalidConfig

log = logging.getLogger(__name__)

_INTERVAL = 1.0  # seconds between looks at the files


class Tls(NamedTuple):
    """Files of PEM; with ``client_ca`` a client needs a certificate that it has signed."""

    certificate: Path
    key: Path
    client_ca: Path | None = None

    @classmethod
    def of(cls, certificate: str, key: str, client_ca: str) -> Tls | None:
        """From settings, empty ones left out; None: no encryption.

        Raises:
            InvalidConfig: one is given without the other, cannot be read, or they do not fit together.
        """
        if not (certificate or key or client_ca):
            return None
        for name, value in (("tls_certificate", certificate), ("tls_key", key)):
            if not value:
                raise InvalidConfig(name, "a PEM file, as the other settings of TLS are given", "nothing")
        tls = cls(Path(certificate), Path(key), Path(client_ca) if client_ca else None)
        tls.context()
        return tls

    def context(self) -> ssl.SSLContext:
        """Of an HTTP server, from the files as they are now.

        Raises:
            InvalidConfig: a file cannot be used.
        """
        for name, path in zip(("tls_certificate", "tls_key", "tls_client_ca"), self, strict=True):
            if path is not None and not _readable(path):
                raise InvalidConfig(name, "a readable PEM file", str(path))
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        try:
            context.load_cert_chain(self.certificate, self.key)
        except (ssl.SSLError, OSError) as error:
            got = f"{self.certificate}: {_reason(error)}"
            raise InvalidConfig("tls_certificate", "a PEM certificate with its key", got) from None
        if self.client_ca:
            context.verify_mode = ssl.CERT_REQUIRED
            # No session is resumed: one brings no certificate, so the clients of an authority that is gone would come in for
            # hours. Of TLS 1.2 that cannot be had.
            context.minimum_version = ssl.TLSVersion.TLSv1_3
            context.num_tickets = 0
            try:
                context.load_verify_locations(self.client_ca)
            except (ssl.SSLError, OSError) as error:
                got = f"{self.client_ca}: {_reason(error)}"
                raise InvalidConfig("tls_client_ca", "PEM certificates", got) from None
        return context

    def modification_times(self) -> tuple[int, ...]:
        """Changes when a file does."""
        return tuple(path.stat().st_mtime_ns for path in self if path is not None)

    def grpc_credentials(self) -> grpc.ServerCredentials:
        """That look at the files at every handshake."""
        seen = [self.modification_times()]

        def fetch() -> grpc.ServerCertificateConfiguration | None:
            try:
                now = self.modification_times()
                if now == seen[0]:
                    return None
                self.context()  # a half-written pair is not taken
                changed = self._grpc_configuration()
                seen[0] = now
                return changed
            except (InvalidConfig, OSError):
                return None

        return grpc.dynamic_ssl_server_credentials(self._grpc_configuration(), fetch, self.client_ca is not None)

    async def follow(self, context: ssl.SSLContext) -> None:
        """Makes the context of a listening server answer as the files are; runs until it is cancelled.

        A context only ever gains authorities, so that another one takes its place at each handshake.
        """
        current, seen, told = [context], self.modification_times(), ""
        context.sni_callback = lambda connection, *_: setattr(connection, "context", current[0])
        while True:
            await asyncio.sleep(_INTERVAL)
            try:
                now = await asyncio.to_thread(self.modification_times)
                if now == seen:
                    told = ""
                    continue
                current[0] = await asyncio.to_thread(self.context)
            except (InvalidConfig, OSError) as error:
                if str(error) != told:  # a broken file may stay for days
                    told = str(error)
                    log.warning("the changed certificate is not used: %s", error)
                continue
            seen, told = now, ""
            log.info("the certificate was read again", extra={"certificate": str(self.certificate)})

    def _grpc_configuration(self) -> grpc.ServerCertificateConfiguration:
        authority = self.client_ca.read_bytes() if self.client_ca else None
        return grpc.ssl_server_certificate_configuration([(self.key.read_bytes(), self.certificate.read_bytes())], authority)


def _readable(path: Path) -> bool:
    try:
        with path.open("rb"):
            return True
    except OSError:
        return False


def _reason(error: Exception) -> str:
    return getattr(error, "reason", None) or type(error).__name__
