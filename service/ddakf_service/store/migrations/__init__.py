"""Migrations of the tables, run at every start. A change of ``tables.py`` needs a new file in ``versions``."""
