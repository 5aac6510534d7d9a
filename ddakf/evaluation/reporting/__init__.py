"""The report: the paper's tables and figures from the results of studies."""
