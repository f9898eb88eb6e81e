"""The sensors of a mapping suite, from their own drive through a field that nobody knows yet."""
