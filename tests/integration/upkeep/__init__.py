"""Maps that are kept up, on small places."""
