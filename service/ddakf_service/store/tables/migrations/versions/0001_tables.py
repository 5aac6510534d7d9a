"""Sessions, their creation requests, history, state changes and keys."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None


def upgrade() -> None:
    op.create_table(
        "sessions",
        sa.Column("uid", sa.BigInteger, primary_key=True, autoincrement=False),
        sa.Column("id", sa.String(63), nullable=False),
        sa.Column("server_id", sa.String(255), nullable=False),
        sa.Column("request_id", sa.String(256), nullable=False),
        sa.Column("owner", sa.String(64)),
        sa.Column("state", sa.Integer, nullable=False),
        sa.Column("labels", sa.JSON, nullable=False),
        sa.Column("create_time", sa.Double, nullable=False),
        sa.Column("expire_time", sa.Double),
        sa.Column("end_time", sa.Double),
        sa.Column("message", sa.LargeBinary, nullable=False),
        sa.Column("reason", sa.LargeBinary),
    )
    op.create_index("sessions_by_id", "sessions", ["id", "create_time"])
    op.create_index("sessions_of_server", "sessions", ["server_id", "end_time"])
    op.create_table(
        "requests",
        sa.Column("uid", sa.BigInteger, primary_key=True, autoincrement=False),
        sa.Column("request", sa.LargeBinary, nullable=False),
    )
    op.create_table(
        "history",
        sa.Column("uid", sa.BigInteger, primary_key=True, autoincrement=False),
        sa.Column("second", sa.BigInteger, primary_key=True, autoincrement=False),
        *(sa.Column(name, sa.Integer, nullable=False) for name in ("applied", "dropped", "late", "rejected")),
        *(sa.Column(name, sa.Double, nullable=False) for name in ("reliability_sum", "least_reliability")),
        *(sa.Column(name, sa.Double, nullable=False) for name in ("paper_score_sum", "coverage_sum")),
        *(sa.Column(name, sa.Double, nullable=False) for name in ("latency_sum", "greatest_latency")),
        sqlite_with_rowid=False,
    )
    op.create_index("history_by_second", "history", ["second"])
    op.create_table(
        "state_changes",
        sa.Column("uid", sa.BigInteger, primary_key=True, autoincrement=False),
        sa.Column("time", sa.Double, primary_key=True, autoincrement=False),
        sa.Column("state", sa.Integer, nullable=False),
        sqlite_with_rowid=False,
    )
    op.create_index("state_changes_by_time", "state_changes", ["time"])
    op.create_table(
        "api_keys",
        sa.Column("hash", sa.LargeBinary, primary_key=True),
        sa.Column("prefix", sa.String(32), nullable=False),
        sa.Column("name", sa.String(256), nullable=False),
        sa.Column("scopes", sa.String(256), nullable=False),
        sa.Column("max_sessions", sa.Integer, nullable=False),
        sa.Column("create_time", sa.Double, nullable=False),
        sa.Column("revoke_time", sa.Double),
    )
    op.create_index("api_keys_by_prefix", "api_keys", ["prefix"])
