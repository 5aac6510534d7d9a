"""REST: session calls as JSON, health, metrics and the OpenAPI document."""
