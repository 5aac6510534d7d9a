"""Requests that create the sessions of leases."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"


def upgrade() -> None:
    op.add_column("leases", sa.Column("request", sa.String(321)))
    op.create_index("leases_of_request", "leases", ["request"], unique=True)
