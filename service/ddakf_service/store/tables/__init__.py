"""Tables of the store: database, migrations, registry and history of sessions."""
