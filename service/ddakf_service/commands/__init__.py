"""Commands: ``ddakf serve``, ``ddakf keys``, ``ddakf demo``."""
