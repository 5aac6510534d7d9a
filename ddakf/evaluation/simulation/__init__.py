"""Simulation of garments on a moving body, from CC0 parts: CLOTH3D-like recordings that anyone can make and share."""
