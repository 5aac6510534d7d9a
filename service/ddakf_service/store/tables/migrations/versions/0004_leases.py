"""Leases of sessions that several servers share, and their gateways."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    op.add_column("sessions", sa.Column("epoch", sa.BigInteger, nullable=False, server_default="0"))
    op.create_table(
        "leases",
        sa.Column("id", sa.String(63), primary_key=True),
        sa.Column("uid", sa.BigInteger, nullable=False),
        sa.Column("owner", sa.String(64)),
        sa.Column("gateway", sa.String(255), nullable=False),
        sa.Column("epoch", sa.BigInteger, nullable=False),
        sa.Column("wanted_by", sa.String(255), nullable=False, server_default=""),
        sa.Column("takeover", sa.Boolean, nullable=False, server_default=sa.false()),
    )
    op.create_index("leases_of_gateway", "leases", ["gateway"])
    op.create_index("leases_by_uid", "leases", ["uid"])
    op.create_table(
        "gateways",
        sa.Column("id", sa.String(255), primary_key=True),
        sa.Column("address", sa.String(255), nullable=False),
        sa.Column("expire_time", sa.Double, nullable=False),
        sa.Column("draining", sa.Boolean, nullable=False),
    )
