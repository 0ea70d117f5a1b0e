"""A volume grown from patches of exemplars."""
