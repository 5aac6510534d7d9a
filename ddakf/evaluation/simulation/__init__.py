"""Garments simulated on a moving body, all from CC0 parts: CLOTH3D-like recordings that anyone can make and share."""
