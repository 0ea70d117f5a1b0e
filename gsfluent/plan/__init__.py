"""What a shot will cost, before anything runs."""
