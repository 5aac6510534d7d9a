"""Stages of the method (paper, sections 2.1 to 2.7), one module each."""
