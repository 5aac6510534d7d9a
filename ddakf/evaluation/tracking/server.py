"""Server: the address of a ddakf server, with what it takes to connect to it."""

from __future__ import annotations

from typing import NamedTuple

from ddakf.errors import SERVICE_PACKAGES, MissingDependency

SYSTEM = "system"  # the public authorities that gRPC brings


class Server(NamedTuple):
    """Address and credentials of a server.

    Attributes:
        target: "host:port" of gRPC, or several of servers that share their sessions, with commas between them.
        api_key: None: no key.
        tls_ca: PEM file with the authorities of the server's certificate, or "system"; None: no encryption, unless there is a
            certificate.
        tls_certificate, tls_key: PEM files of the client's own certificate; None: none.
    """

    target: str
    api_key: str | None = None
    tls_ca: str | None = None
    tls_certificate: str | None = None
    tls_key: str | None = None

    def connect(self):
        """A client of the server, to be closed.

        Raises:
            MissingDependency: the client is not installed.
            ddakf_client.ServiceError: the server does not answer, or a file is invalid.
        """
        client = client_package()
        files = {"ca": self.tls_ca, "certificate": self.tls_certificate, "key": self.tls_key}
        given = {name: file for name, file in files.items() if file is not None}
        options = {"credentials": client.tls_credentials(**given)} if given else {}
        return client.connect(self.target, api_key=self.api_key, **options)


def client_package(needing: str = "--server"):
    """The package of the client, imported when asked for.

    Raises:
        MissingDependency: it is not installed; ``needing`` names what needs it.
    """
    try:
        import ddakf_client
    except ModuleNotFoundError as error:
        raise MissingDependency(f"{needing} needs the client, which is not installed; {SERVICE_PACKAGES}") from error
    return ddakf_client
