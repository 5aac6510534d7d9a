"""Expiry and rates of keys."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    op.add_column("api_keys", sa.Column("expire_time", sa.Double))
    for name in ("frames_per_second", "requests_per_minute"):
        op.add_column("api_keys", sa.Column(name, sa.Double, nullable=False, server_default="0"))
