"""Evaluation: virtual sensors, data sets, metrics, baselines, studies and their report. The tracker never imports it.

Folders, each of which imports only those before it: ``sensors``, ``datasets`` and ``metrics`` and ``drawing``, ``simulation`` and
``tracking``, ``baselines``, ``trials``, ``studies``, ``reporting``.
"""
