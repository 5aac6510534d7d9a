"""The commands ``ddakf serve``, ``ddakf keys`` and ``ddakf demo``."""
