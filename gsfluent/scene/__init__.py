"""What is simulated: bodies, things that move by themselves, events."""
