"""Wire contract of ddakf, shared by server and clients: schema (``ddakf_api.v1``), codecs, packed arrays, errors."""

API_VERSION = "1.0"
"""Version of the contract, "major.minor". Peers with another major version are refused."""
