"""A session that one can poke while it runs."""
