"""Migrations of the tables, run at every start. A change of ``tables.py`` requires a new file in ``versions``."""
