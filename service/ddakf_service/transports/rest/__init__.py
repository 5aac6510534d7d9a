"""The contract over REST."""
