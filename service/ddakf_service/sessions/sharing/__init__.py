"""Sharing: sessions that any gateway may serve, one at a time, through leases in PostgreSQL and common checkpoints."""
