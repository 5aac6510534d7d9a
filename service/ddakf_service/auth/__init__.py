"""Authentication and authorisation: keys with scopes, the guard of every call, TLS."""
