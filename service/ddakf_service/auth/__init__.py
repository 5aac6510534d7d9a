"""Authentication and authorisation: keys with scopes, the guard before every call, TLS."""
