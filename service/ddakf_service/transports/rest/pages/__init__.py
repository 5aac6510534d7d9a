"""Pages: what a person opens in a browser, the dashboard and the description of the interface."""
