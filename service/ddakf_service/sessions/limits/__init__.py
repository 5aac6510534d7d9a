"""Limits of sessions: admission of new ones, penalties for costly ones."""
