"""Observability: logs, Prometheus metrics and OpenTelemetry spans."""
