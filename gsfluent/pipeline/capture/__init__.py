"""What a capture says before anything is learned: views, hull, which way is up."""
