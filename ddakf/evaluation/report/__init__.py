"""The paper's tables and figures, drawn from the results of studies; see ``ddakf report``."""
