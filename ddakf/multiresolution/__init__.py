"""Passes before the full resolution: rigid clusters."""
