"""What every problem runs in: bodies, engine, driver, registry."""
