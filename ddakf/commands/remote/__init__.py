"""Commands that call a server: sessions, recordings, and the options of a connection."""
