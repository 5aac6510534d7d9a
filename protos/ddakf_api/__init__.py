"""The ddakf wire contract: schema (``ddakf_api.v1``), codecs, packed arrays and errors, shared by server and clients."""

API_VERSION = "1.0"
"""Version of the contract, "major.minor": a peer of another major version is refused."""
