"""Which causes the simulation lacks: found, named, added, measured."""
