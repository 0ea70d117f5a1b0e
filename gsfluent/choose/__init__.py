"""The cheapest setting that meets an error."""
