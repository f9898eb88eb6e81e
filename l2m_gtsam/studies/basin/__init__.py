"""How far off a guess may be: success against the initial offset."""
