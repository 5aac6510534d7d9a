"""Observability: logs, Prometheus metrics, OpenTelemetry spans."""
