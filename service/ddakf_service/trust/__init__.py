"""Who may do what: keys with scopes, a guard before every call of every transport, TLS."""

from .principal import ANONYMOUS, Principal, Scope, current_principal

__all__ = ["ANONYMOUS", "Principal", "Scope", "current_principal"]
