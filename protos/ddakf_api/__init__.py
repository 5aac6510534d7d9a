"""The ddakf wire contract, shared by server and clients: schema (``ddakf_api.v1``), codecs, packed arrays, errors."""

API_VERSION = "1.0"
"""Version of the contract, "major.minor": a peer of another major version is refused."""
