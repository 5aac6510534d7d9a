"""Tables of the database. Times are seconds since 1970 (UTC). A session's ``uid`` is never used again, unlike its id."""

from __future__ import annotations

from sqlalchemy import JSON, BigInteger, Boolean, Column, Double, Index, Integer, LargeBinary, MetaData, String, Table, false

metadata = MetaData()

# Live and past sessions. `message` is the ddakf_api.v1.Session without meshes, `reason` the ErrorDetail of its end, `epoch` that
# of the lease under which the row was written; the other columns repeat searched fields.
sessions = Table(
    "sessions",
    metadata,
    Column("uid", BigInteger, primary_key=True, autoincrement=False),
    Column("id", String(63), nullable=False),
    Column("server_id", String(255), nullable=False),
    Column("request_id", String(256), nullable=False),
    Column("owner", String(64)),
    Column("state", Integer, nullable=False),
    Column("labels", JSON, nullable=False),
    Column("create_time", Double, nullable=False),
    Column("expire_time", Double),
    Column("end_time", Double),
    Column("message", LargeBinary, nullable=False),
    Column("reason", LargeBinary),
    Column("epoch", BigInteger, nullable=False, server_default="0"),
    Index("sessions_by_id", "id", "create_time"),
    Index("sessions_of_server", "server_id", "end_time"),
)

# Creation requests of live sessions with their meshes; a table of its own, because they are large and never change.
requests = Table(
    "requests",
    metadata,
    Column("uid", BigInteger, primary_key=True, autoincrement=False),
    Column("request", LargeBinary, nullable=False),
)

# Leases of live sessions, where servers share them: the gateway that serves each session, or nothing. The epoch grows with each
# change of the gateway. `request` is the key and the request id of the creation, if it has one. `wanted_by` is a gateway that
# asks for the session, `takeover` whether it may end a stream.
leases = Table(
    "leases",
    metadata,
    Column("id", String(63), primary_key=True),
    Column("uid", BigInteger, nullable=False),
    Column("owner", String(64)),
    Column("gateway", String(255), nullable=False),
    Column("epoch", BigInteger, nullable=False),
    Column("wanted_by", String(255), nullable=False, server_default=""),
    Column("takeover", Boolean, nullable=False, server_default=false()),
    Column("request", String(321)),
    Index("leases_of_gateway", "gateway"),
    Index("leases_of_request", "request", unique=True),
    Index("leases_by_uid", "uid"),
)

# Servers that share sessions. All leases of a gateway expire with its row, at `expire_time` of the database's clock.
gateways = Table(
    "gateways",
    metadata,
    Column("id", String(255), primary_key=True),
    Column("address", String(255), nullable=False),
    Column("expire_time", Double, nullable=False),
    Column("draining", Boolean, nullable=False),
)

# One row per session and second with frames. Sums over the applied frames, so that rows can be added.
history = Table(
    "history",
    metadata,
    Column("uid", BigInteger, primary_key=True, autoincrement=False),
    Column("second", BigInteger, primary_key=True, autoincrement=False),
    Column("applied", Integer, nullable=False),
    Column("dropped", Integer, nullable=False),
    Column("late", Integer, nullable=False),
    Column("rejected", Integer, nullable=False),
    Column("reliability_sum", Double, nullable=False),
    Column("least_reliability", Double, nullable=False),
    Column("paper_score_sum", Double, nullable=False),
    Column("coverage_sum", Double, nullable=False),
    Column("latency_sum", Double, nullable=False),
    Column("greatest_latency", Double, nullable=False),
    Index("history_by_second", "second"),
    sqlite_with_rowid=False,
)

state_changes = Table(
    "state_changes",
    metadata,
    Column("uid", BigInteger, primary_key=True, autoincrement=False),
    Column("time", Double, primary_key=True, autoincrement=False),
    Column("state", Integer, nullable=False),
    Index("state_changes_by_time", "time"),
    sqlite_with_rowid=False,
)

# Uploaded meshes by content and key; `owner` is empty where no key was needed. The contents are files or objects.
meshes = Table(
    "meshes",
    metadata,
    Column("id", String(64), primary_key=True),
    Column("owner", String(64), primary_key=True),
    Column("vertex_count", Integer, nullable=False),
    Column("face_count", Integer, nullable=False),
    Column("size", BigInteger, nullable=False),
    Column("create_time", Double, nullable=False),
    Index("meshes_by_owner", "owner", "create_time"),
)

# Keys of clients: only the SHA-256 of a key, and its first characters, by which a person recognises it.
api_keys = Table(
    "api_keys",
    metadata,
    Column("hash", LargeBinary, primary_key=True),
    Column("prefix", String(32), nullable=False),
    Column("name", String(256), nullable=False),
    Column("scopes", String(256), nullable=False),  # of stream, read, admin; separated by spaces
    Column("max_sessions", Integer, nullable=False),  # at a time; 0: the server's setting
    Column("create_time", Double, nullable=False),
    Column("revoke_time", Double),
    Column("expire_time", Double),
    Column("frames_per_second", Double, nullable=False, server_default="0"),  # 0: not limited
    Column("requests_per_minute", Double, nullable=False, server_default="0"),
    Index("api_keys_by_prefix", "prefix"),
)
