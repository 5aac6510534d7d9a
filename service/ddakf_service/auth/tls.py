"""TLS: certificates from files, read again after a change; open connections continue."""

from __future__ import annotations

import asyncio
import logging
import ssl
from pathlib import Path
from typing import NamedTuple

import grpc

from ddakf.errors import InvalidConfig

from ..store.files.permissions import SHARED_FILE, exposure

log = logging.getLogger(__name__)

_INTERVAL = 1.0  # seconds between checks of the files


class Tls(NamedTuple):
    """PEM files. With ``client_ca`` a client needs a certificate signed by it."""

    certificate: Path
    key: Path
    client_ca: Path | None = None

    @classmethod
    def of(cls, certificate: str, key: str, client_ca: str) -> Tls | None:
        """From settings, where an empty text means not given. None: no encryption.

        Raises:
            InvalidConfig: a file is missing, cannot be read, or does not match the others.
        """
        if not (certificate or key or client_ca):
            return None
        for name, value in (("tls_certificate", certificate), ("tls_key", key)):
            if not value:
                raise InvalidConfig(name, "a PEM file, as the other settings of TLS are given", "nothing")
        tls = cls(Path(certificate), Path(key), Path(client_ca) if client_ca else None)
        tls.context()
        if sentence := exposure(tls.key, SHARED_FILE):
            log.warning(sentence)
        return tls

    def context(self) -> ssl.SSLContext:
        """TLS context of an HTTP server, from the present files.

        Raises:
            InvalidConfig: a file is invalid.
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
            # No session resumption: it carries no certificate, so clients of a removed authority would be admitted for hours.
            # TLS 1.2 cannot disable it.
            context.minimum_version = ssl.TLSVersion.TLSv1_3
            context.num_tickets = 0
            try:
                context.load_verify_locations(self.client_ca)
            except (ssl.SSLError, OSError) as error:
                got = f"{self.client_ca}: {_reason(error)}"
                raise InvalidConfig("tls_client_ca", "PEM certificates", got) from None
        return context

    def modification_times(self) -> tuple[int, ...]:
        """Modification times of the files; 0 of one that is not there, which reading them names."""
        return tuple(_modified(path) for path in self if path is not None)

    def grpc_credentials(self) -> grpc.ServerCredentials:
        """gRPC credentials that check the files at every handshake."""
        last_times, reported = self.modification_times(), ""

        def fetch() -> grpc.ServerCertificateConfiguration | None:
            nonlocal last_times, reported
            try:
                times = self.modification_times()
                if times == last_times:
                    reported = ""
                    return None
                self.context()  # raises for a half-written pair
                changed = self._grpc_configuration()
            except (InvalidConfig, OSError) as error:
                if str(error) != reported:  # logged once per error, as below: each handshake comes here
                    reported = str(error)
                    log.warning("gRPC does not use the changed certificate: %s", error)
                return None
            last_times, reported = times, ""
            return changed

        return grpc.dynamic_ssl_server_credentials(self._grpc_configuration(), fetch, self.client_ca is not None)

    async def follow(self, context: ssl.SSLContext) -> None:
        """Keeps the context of a listening server up to date with the files; runs until it is cancelled.

        Authorities cannot be removed from a context, so each handshake gets the newest context.
        """
        current, last_times, reported = [context], self.modification_times(), ""
        context.sni_callback = lambda connection, *_: setattr(connection, "context", current[0])
        while True:
            await asyncio.sleep(_INTERVAL)
            try:
                times = await asyncio.to_thread(self.modification_times)
                if times == last_times:
                    reported = ""
                    continue
                current[0] = await asyncio.to_thread(self.context)
            except (InvalidConfig, OSError) as error:
                if str(error) != reported:  # logged once per error: a broken file may stay for days
                    reported = str(error)
                    log.warning("the changed certificate is not used: %s", error)
                continue
            last_times, reported = times, ""
            log.info("the certificate was read again", extra={"certificate": str(self.certificate)})

    def _grpc_configuration(self) -> grpc.ServerCertificateConfiguration:
        authority = self.client_ca.read_bytes() if self.client_ca else None
        return grpc.ssl_server_certificate_configuration([(self.key.read_bytes(), self.certificate.read_bytes())], authority)


def _modified(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def _readable(path: Path) -> bool:
    try:
        with path.open("rb"):
            return True
    except OSError:
        return False


def _reason(error: Exception) -> str:
    return getattr(error, "reason", None) or type(error).__name__
