"""A collector of OpenTelemetry spans: OTLP over HTTP on a real socket."""

from __future__ import annotations

import gzip
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest


class Collector:
    """Listens from construction to ``close``.

    Attributes:
        endpoint: for ``OTEL_EXPORTER_OTLP_ENDPOINT``.
    """

    def __init__(self):
        self._requests: list[ExportTraceServiceRequest] = []
        self._arrived = threading.Condition()
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
        self.endpoint = f"http://127.0.0.1:{self._server.server_port}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def wait_for(self, enough, timeout: float) -> bool:
        """Whether ``enough(spans)`` becomes true."""
        with self._arrived:
            return self._arrived.wait_for(lambda: enough(self.spans()), timeout)

    def spans(self) -> list:
        return [s for r in self._requests for resource in r.resource_spans for scope in resource.scope_spans for s in scope.spans]

    def resource(self) -> dict[str, str]:
        """Resource attributes of the first spans."""
        attributes = self._requests[0].resource_spans[0].resource.attributes
        return {attribute.key: attribute.value.string_value for attribute in attributes}

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()

    def _handler(collector) -> type[BaseHTTPRequestHandler]:
        class Handler(BaseHTTPRequestHandler):
            def do_POST(self):
                body = self.rfile.read(int(self.headers["Content-Length"]))
                if self.headers.get("Content-Encoding") == "gzip":
                    body = gzip.decompress(body)
                assert self.path == "/v1/traces"
                with collector._arrived:
                    collector._requests.append(ExportTraceServiceRequest.FromString(body))
                    collector._arrived.notify_all()
                self.send_response(200)
                self.end_headers()

            def log_message(self, *_):
                pass

        return Handler


def attributes_of(span) -> dict:
    """Attributes of a span as plain values."""
    return {a.key: getattr(a.value, a.value.WhichOneof("value")) for a in span.attributes}
