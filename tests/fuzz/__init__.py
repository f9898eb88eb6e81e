"""Files changed at random, given to every command: seeded, so that each case can be repeated."""
