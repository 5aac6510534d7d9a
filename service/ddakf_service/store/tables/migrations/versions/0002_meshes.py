"""Uploaded meshes."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    op.create_table(
        "meshes",
        sa.Column("id", sa.String(64), primary_key=True),
        sa.Column("owner", sa.String(64), primary_key=True),
        *(sa.Column(name, sa.Integer, nullable=False) for name in ("vertex_count", "face_count")),
        sa.Column("size", sa.BigInteger, nullable=False),
        sa.Column("create_time", sa.Double, nullable=False),
    )
    op.create_index("meshes_by_owner", "meshes", ["owner", "create_time"])
