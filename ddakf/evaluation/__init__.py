"""Measuring: virtual sensors, recordings, metrics, pictures. Sits on top of the tracker, which never imports it."""
